#!/usr/bin/env bash
# Install the CPU build of the pinned torch from its own index. If that index has none, print a line and leave torch to the
# requirements; that build may be a CUDA build of some gigabytes.
#
#   tools/install_torch.sh PYTHON [INDEX]
set -euo pipefail
python=$1
index=${2:-https://download.pytorch.org/whl/cpu}
repository=$(cd "$(dirname "$0")/.." && pwd)
pinned=$(grep -m1 -oE '^torch==[0-9.]+' "$repository/requirements-torch.txt")

if "$python" -c 'import sys, importlib.metadata as m; sys.exit(m.version("torch").split("+")[0] != sys.argv[1])' \
  "${pinned#torch==}" 2>/dev/null; then
  exit 0
fi
# --no-deps: the CPU index lacks some requirements of torch; the usual index has them
if ! "$python" -m pip install --quiet --no-compile --disable-pip-version-check --retries 1 --timeout 15 --no-deps \
  --index-url "$index" "$pinned" 2>/dev/null; then
  echo "No CPU build of $pinned from $index (set TORCH_INDEX): torch comes from the usual index, possibly a build of 5 GB" >&2
fi
