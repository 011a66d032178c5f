#!/usr/bin/env bash
# Install the wheel into a bare venv and run the notebook there on a recording; fail without the compiled part or closures.
#
#   make wheel && tools/try_wheel.sh [RECORDING]      (default: 70 s are simulated with the package in .venv)
set -euo pipefail
cd "$(dirname "$0")/.."
recording=${1:-data/wheel.mcap}
[ -f "$recording" ] || .venv/bin/umf simulate "$recording" --duration 70
recording=$(realpath "$recording")
wheel=$(realpath "$(ls -t dist/umf_ros-*.whl | head -1)")
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
.venv/bin/python -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --quiet --disable-pip-version-check --no-compile "$wheel"
cp examples/first_run.ipynb tools/run_notebook.py "$folder"
cd "$folder" # not the checkout: its package would be imported
export PATH="$folder/venv/bin:$PATH"
python -c 'import sys, umf_ros.scan._kernels as part; sys.exit(not part.__file__.startswith(sys.prefix))'
RECORDING=$recording python run_notebook.py first_run.ipynb
python - results/latest/summary.json <<'END'
import json, sys
closures = json.load(open(sys.argv[1]))["closures_published"]
sys.exit(None if closures else "the wheel finds no closure")
END
du -sh venv
