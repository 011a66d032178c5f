#!/usr/bin/env bash
# What a new user gets wrong in the first hour: 80 wrong inputs, and for each the line, the exit status and the time.
# Ends with 1 when one of them is not one line, not refused, slow where it could be known at once, or a traceback.
set -uo pipefail
cd "$(dirname "$0")/.."
export OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}"
UMF=${UMF:-.venv/bin/umf}
AT_ONCE_S=${AT_ONCE_S:-1.0}
T=$(mktemp -d); trap 'rm -rf "$T"' EXIT
count=0 wrong=0

printf 'these are notes\n' > "$T/notes.txt"; : > "$T/empty.mcap"; mkdir "$T/folder" "$T/run"
printf '\x89MCAP0\r\nbroken' > "$T/broken.mcap"; printf 'SQLite format 3\0broken' > "$T/broken.db3"
printf '#ROSBAG V2.0\nbroken' > "$T/broken.bag"; head -c 4096 /dev/urandom > "$T/noise.mcap"
printf 'loop: {topk: 3}\n' > "$T/unknown.yaml"; printf 'loop: {top_k: many}\n' > "$T/type.yaml"
printf 'loop: {top_k: 0}\n' > "$T/range.yaml"; printf 'loop: [\n' > "$T/syntax.yaml"
printf 'loop: {top_k: 3}\nloop: {top_k: 4}\n' > "$T/twice.yaml"; printf '{"frames": 3}' > "$T/run/summary.json"
printf 'a,b\n1,2\n' > "$T/pairs.csv"; printf 'VERTEX_SE3:QUAT x\n' > "$T/wrong.g2o"; printf '1 2 3\n' > "$T/short.tum"
printf '# .PCD v0.7\nFIELDS a b\n' > "$T/wrong.pcd"

mkdir "$T/set"; { printf 'P5 4 4 255\n'; head -c 16 /dev/zero; } > "$T/set/0.pgm"; printf '0.pgm 1600000000.5\n' > "$T/set/times.txt"
"$UMF" import folder "$T/set" "$T/good.mcap" > /dev/null || exit 2

# refused NAME ARGUMENTS...: one line (or typer's box), not 0
refused() {
  local name=$1; shift
  local start end out status seconds
  start=$(date +%s.%N); out=$("$UMF" "$@" 2>&1 < /dev/null); status=$?; end=$(date +%s.%N)
  seconds=$(awk -v a="$start" -v b="$end" 'BEGIN { printf "%.1f", b - a }')
  local lines said fault=""
  lines=$(printf '%s\n' "$out" | grep -vcE '^(Usage:|Try |╭|╰|$)')
  said=$(printf '%s\n' "$out" | grep -vE '^(Usage:|Try |╭|╰|$)' | tail -1 | sed "s#$T#.#g")
  [ "$status" -ne 0 ] || fault="$fault accepted"
  [ "$lines" -le 2 ] || fault="$fault ${lines}-lines"
  printf '%s' "$out" | grep -q Traceback && fault="$fault traceback"
  awk -v s="$seconds" -v m="$AT_ONCE_S" 'BEGIN { exit !(s > m) }' && [ "$name" != later ] && fault="$fault slow"
  count=$((count + 1)); [ -z "$fault" ] || wrong=$((wrong + 1))
  printf '%-4s %s %4ss  umf %s: %s%s\n' "$count" "$status" "$seconds" "$(printf '%s ' "$@" | sed "s#$T#.#g")" "$said" "${fault:+   <-- $fault}"
}

for bag in "$T/nowhere.mcap" "$T/notes.txt" "$T/empty.mcap" "$T/folder" "$T/broken.mcap" "$T/broken.db3" "$T/broken.bag" "$T/noise.mcap"; do
  for command in replay inspect play; do
    case "$bag" in *nowhere*) refused now $command "$bag" ;; *) refused later $command "$bag" ;; esac
  done
  refused later evaluate "$bag"
  refused later explain "$bag" 1 2
done
for config in nowhere unknown type range syntax twice; do
  for command in replay evaluate; do refused later $command "$T/good.mcap" --config "$T/$config.yaml"; done
done
refused now replay
refused now replay --nonsense
refused now replay "$T/good.mcap" --min-probability 2
refused now replay "$T/good.mcap" --min-probability high
refused now replay "$T/good.mcap" --odometry-frame camera
refused now replay "$T/good.mcap" --odometry "$T/nowhere.tum"
refused now replay "$T/good.mcap" --ground-truth "$T/nowhere.pos"
refused later replay "$T/good.mcap" --dataset nonsense
refused later replay "$T/good.mcap" --embedder nonsense
refused later replay "$T/good.mcap" --weights "$T/notes.txt"
refused later replay "$T/good.mcap" --odometry "$T/short.tum"
refused later replay "$T/good.mcap" --ground-truth "$T/short.tum"
refused now nonsense
refused now report "$T/nowhere" "$T/notes.txt"
refused later report "$T/folder" "$T/notes.txt"
refused later report "$T/run" "$T/notes.txt"
refused now why "$T/nowhere" 3
refused now why "$T/folder" 3
refused now why "$T/run" 3
refused now import nonsense "$T" "$T/a.mcap"
refused now import folder "$T/nowhere" "$T/a.mcap"
refused now import folder "$T/folder" "$T/a.bag"
refused later import kitti-odometry "$T/folder" "$T/a.mcap"
refused later import euroc "$T/folder" "$T/a.mcap"
refused later import tum-rgbd "$T/folder" "$T/a.mcap"
refused now simulate
refused later simulate "$T/a.bag"
refused later simulate "$T/a.mcap" --preset nonsense
refused later graph optimize "$T/nowhere.g2o"
refused later graph optimize "$T/wrong.g2o"
refused now graph optimize "$T/wrong.g2o" --reject some
refused later graph plot "$T/nowhere.g2o"
refused later compare "$T/nowhere.pcd" "$T/wrong.pcd"
refused later compare "$T/wrong.pcd" "$T/wrong.pcd"
refused later compare --list "$T/pairs.csv" --out "$T/out.csv"

echo "$count wrong inputs, $wrong not as they should be"
exit $((wrong > 0))
