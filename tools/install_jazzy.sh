#!/usr/bin/env bash
# Install umf_ros beside an installed ROS 2 Jazzy on Ubuntu 24.04 (x86-64 or aarch64) and check it:
#
#   source /opt/ros/jazzy/setup.bash
#   src/umf_ros/tools/install_jazzy.sh [WORKSPACE]
#
# WORKSPACE is the colcon workspace that holds src/umf_ros (default: two folders above this repository). Python
# packages go to WORKSPACE/venv, which uses the system's packages and does not change them.
set -euo pipefail
repository=$(cd "$(dirname "$0")/.." && pwd)
workspace=$(cd "${1:-$repository/../..}" && pwd)
torch_index=${TORCH_INDEX:-https://download.pytorch.org/whl/cpu}

fail() { echo "install_jazzy: $*" >&2; exit 1; }
[ "${ROS_DISTRO:-}" = jazzy ] || fail "source /opt/ros/jazzy/setup.bash first (ROS_DISTRO is '${ROS_DISTRO:-unset}')"
python3 -c 'import sys; sys.exit(sys.version_info[:2] != (3, 12))' || fail "Python 3.12 is needed, as Ubuntu 24.04 has it"
command -v colcon >/dev/null || fail "colcon is missing: sudo apt install python3-colcon-common-extensions"

missing=()
for package in g++ python3-dev python3-venv ros-jazzy-common-interfaces ros-jazzy-lifecycle-msgs ros-jazzy-tf2-ros-py ros-jazzy-ros2launch; do
  [ "$(dpkg-query -W -f='${db:Status-Status}' "$package" 2>/dev/null)" = installed ] || missing+=("$package")
done
if [ ${#missing[@]} -gt 0 ]; then
  sudo=(); [ "$(id -u)" -eq 0 ] || sudo=(sudo)
  echo "Installing ${missing[*]}"
  "${sudo[@]}" apt-get update -qq
  "${sudo[@]}" apt-get install -y -qq --no-install-recommends "${missing[@]}" >/dev/null
fi

venv=$workspace/venv
[ -x "$venv/bin/python" ] || python3 -m venv --system-site-packages "$venv"
touch "$venv/COLCON_IGNORE"
requirements=$repository/requirements-jazzy.txt
glibc=$(getconf GNU_LIBC_VERSION | cut -d' ' -f2)
if [ "$(printf '%s\n' 2.35 "$glibc" | sort -V | head -1)" != 2.35 ]; then
  echo "glibc $glibc is older than 2.35: without openvino, torch runs the network"
  requirements=$(mktemp)
  trap 'rm -f "$requirements"' EXIT
  grep -v '^openvino' "$repository/requirements-jazzy.txt" >"$requirements"
  "$repository/tools/install_torch.sh" "$venv/bin/python" "$torch_index"
  cat "$repository/requirements-torch.txt" >>"$requirements"
fi
echo "Installing the Python packages into $venv (some minutes the first time)"
"$venv/bin/python" -m pip install --quiet --quiet --disable-pip-version-check -r "$requirements"

cd "$workspace"
# shellcheck disable=SC1091
source "$venv/bin/activate"
# the executables use the first Python on the PATH: that of the venv
colcon build --packages-select umf_ros
set +u
# shellcheck disable=SC1091
source install/setup.bash
set -u
umf doctor
cat <<END

In every new terminal:
  source /opt/ros/jazzy/setup.bash && source $venv/bin/activate && source $workspace/install/setup.bash
  ros2 launch umf_ros loop_closure.launch.py params_file:=my_rover.yaml
END
