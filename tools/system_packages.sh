#!/usr/bin/env bash
# Install the compiler that builds umf_ros/scan/_kernels, and the system libraries that the lab's wheels need but do not
# contain: open3d loads libusb-1.0 and libGL. With --browser also Chromium, in which tests open the report.
set -eu
missing=()
command -v c++ >/dev/null || missing+=(g++)
python=$(command -v "${PYTHON:-python3}" || true)
headers='import os, sys, sysconfig; sys.exit(not os.path.exists(sysconfig.get_paths()["include"] + "/Python.h"))'
[ -z "$python" ] || "$python" -c "$headers" || missing+=("$("$python" -c 'import sys; print("python%d.%d-dev" % sys.version_info[:2])')")
known=$(ldconfig -p 2>/dev/null || /sbin/ldconfig -p)
grep -q 'libusb-1\.0\.so' <<<"$known" || missing+=(libusb-1.0-0)
grep -q 'libGL\.so\.1' <<<"$known" || missing+=(libgl1)
grep -q 'libEGL\.so\.1' <<<"$known" || missing+=(libegl1)
grep -q 'libgomp\.so\.1' <<<"$known" || missing+=(libgomp1)
grep -q 'libX11\.so\.6' <<<"$known" || missing+=(libx11-6)
if [ "${1:-}" = --browser ]; then
  command -v chromium >/dev/null || command -v chromium-browser >/dev/null || command -v google-chrome >/dev/null ||
    missing+=(chromium)
fi
[ ${#missing[@]} -eq 0 ] && exit 0

install="apt-get install -y --no-install-recommends ${missing[*]}"
if ! command -v apt-get >/dev/null; then
  echo "make: these system libraries are missing, install them and run make again: ${missing[*]}" >&2
  exit 1
fi
if [ "$(id -u)" -eq 0 ]; then as_root=(); elif sudo -n true 2>/dev/null; then as_root=(sudo); else
  echo "make: system libraries are missing; run this once, then make again:  sudo $install" >&2
  exit 1
fi
echo "Installing system libraries: ${missing[*]}"
# shellcheck disable=SC2086
"${as_root[@]}" $install >/dev/null 2>&1 || { "${as_root[@]}" apt-get update -qq && "${as_root[@]}" $install >/dev/null; }
