#!/usr/bin/env bash
# Screenshots of a report in Chromium: desktop and telephone width, light and dark.
#   tools/report_screens.sh results/latest/report.html results/screens
set -euo pipefail
report=$(readlink -f "$1"); out=${2:-results/screens}; height=${3:-3600}
browser=$(command -v chromium || command -v chromium-browser || command -v google-chrome) || { echo "no Chromium here" >&2; exit 1; }
work=$(mktemp -d); trap 'rm -rf "$work"' EXIT; mkdir -p "$out"
shoot() { # page width name scheme (0 dark, 1 light)
  "$browser" --headless --no-sandbox --disable-gpu --hide-scrollbars --user-data-dir="$work/profile" \
    --virtual-time-budget=8000 --window-size="$2,$height" --blink-settings=preferredColorScheme="$4" \
    --screenshot="$out/$3.png" "file://$1" > "$work/log" 2>&1
  echo "$out/$3.png"
}
# Chromium's window has a minimum width above a telephone's; a frame has none
printf '<body style="margin:0"><iframe style="border:0" width=390 height=%s src="file://%s"></iframe>' "$height" "$report" > "$work/narrow.html"
shoot "$report" 1280 wide_light 1; shoot "$report" 1280 wide_dark 0
shoot "$work/narrow.html" 500 narrow_light 1; shoot "$work/narrow.html" 500 narrow_dark 0
