#!/usr/bin/env bash
# Run over 110 wrong inputs of a new user; print exit status, seconds, CPU seconds and the line of each. The exit status is 1 if
# an input is accepted, or gives more than one line, a traceback, or a late answer. Late: more than AT_ONCE_S of CPU time for an
# error that needs no import of large packages.
set -uo pipefail
cd "$(dirname "$0")/.."
export OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}"
UMF=${UMF:-.venv/bin/umf}
AT_ONCE_S=${AT_ONCE_S:-1.0}
T=$(mktemp -d); trap 'rm -rf "$T"' EXIT
count=0 wrong=0 at_once=0 slowest=0 longest=0 tracebacks=0

printf 'these are notes\n' > "$T/notes.txt"; : > "$T/empty.mcap"; mkdir "$T/folder" "$T/run"
printf '\x89MCAP0\r\nbroken' > "$T/broken.mcap"; printf 'SQLite format 3\0broken' > "$T/broken.db3"
printf '#ROSBAG V2.0\nbroken' > "$T/broken.bag"; head -c 4096 /dev/urandom > "$T/noise.mcap"
printf 'loop: {topk: 3}\n' > "$T/unknown.yaml"; printf 'loop: {top_k: many}\n' > "$T/type.yaml"
printf 'loop: {top_k: 0}\n' > "$T/range.yaml"; printf 'loop: [\n' > "$T/syntax.yaml"
printf 'loop: {top_k: 3}\nloop: {top_k: 4}\n' > "$T/twice.yaml"; printf '{"frames": 3}' > "$T/run/summary.json"
printf 'a,b\n1,2\n' > "$T/pairs.csv"; printf 'VERTEX_SE3:QUAT x\n' > "$T/wrong.g2o"; printf '1 2 3\n' > "$T/short.tum"
printf '# .PCD v0.7\nFIELDS a b\n' > "$T/wrong.pcd"

mkdir -p "$T/runs/latest"; : > "$T/runs/latest/run.sqlite"
mkdir "$T/set"; { printf 'P5 4 4 255\n'; head -c 16 /dev/zero; } > "$T/set/0.pgm"; printf '0.pgm 1600000000.5\n' > "$T/set/times.txt"
"$UMF" import folder "$T/set" "$T/good.mcap" > /dev/null || exit 2

TIMEFORMAT='%R %U %S'
# refused NAME ARGUMENTS...: one line (or typer's box), not 0; NAME now: within AT_ONCE_S, later: after large imports
refused() {
  local name=$1; shift
  local status seconds cpu said lines fault=""
  { time "$UMF" "$@" > "$T/said" 2>&1 < /dev/null; } 2> "$T/took"; status=$?
  read -r seconds cpu < <(awk '{ printf "%.2f %.2f\n", $1, $2 + $3 }' "$T/took")
  lines=$(grep -vcE '^(Usage:|Try |╭|╰|$)' "$T/said")
  said=$(grep -vE '^(Usage:|Try |╭|╰|$)' "$T/said" | tail -1 | sed "s#$T#.#g")
  [ "$status" -ne 0 ] || fault="$fault accepted"
  [ "$lines" -le 2 ] || fault="$fault ${lines}-lines"
  grep -q Traceback "$T/said" && { fault="$fault traceback"; tracebacks=$((tracebacks + 1)); }
  if [ "$name" = now ]; then
    at_once=$((at_once + 1))
    slowest=$(awk -v a="$cpu" -v b="$slowest" 'BEGIN { print (a > b) ? a : b }')
    longest=$(awk -v a="$seconds" -v b="$longest" 'BEGIN { print (a > b) ? a : b }')
    awk -v s="$cpu" -v m="$AT_ONCE_S" 'BEGIN { exit !(s > m) }' && fault="$fault slow"
  fi
  count=$((count + 1)); [ -z "$fault" ] || wrong=$((wrong + 1))
  printf '%-4s %s %5ss %5ss  umf %s: %s%s\n' "$count" "$status" "$seconds" "$cpu" \
    "$(printf '%s ' "$@" | sed "s#$T#.#g")" "$said" "${fault:+   <-- $fault}"
}
# took SECONDS ARGUMENTS...: CPU time, best of three runs
took() {
  local most=$1 best=99 one; shift
  for _ in 1 2 3; do
    { time "$UMF" "$@" > /dev/null 2>&1 < /dev/null; } 2> "$T/took"
    one=$(awk '{ print $2 + $3 }' "$T/took"); best=$(awk -v a="$one" -v b="$best" 'BEGIN { print (a < b) ? a : b }')
  done
  awk -v s="$best" -v m="$most" 'BEGIN { exit !(s > m) }' && { wrong=$((wrong + 1)); echo -n "SLOW "; }
  echo "umf $*: $best s of CPU, at most $most" | sed "s#$T#.#g"
}

took 0.4 --help
took 0.6 replay "$T/nowhere.mcap"
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
refused now why "$T/runs"
refused now judge "$T/runs"
refused now report "$T/good.mcap"
refused later why "$T/run" 3
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

# maps and localisation
refused now map
refused now map "$T/nowhere.mcap" --out "$T/map"
refused now map "$T/good.mcap" --workers 0
refused now map "$T/good.mcap" --out "$T/map" --odometry "$T/nowhere"
refused later map "$T/folder" --out "$T/map"
refused later map "$T/notes.txt" --out "$T/map"
refused later map "$T/good.mcap" --out "$T/notes.txt"
refused now replay "$T/good.mcap" --map "$T/nowhere"
refused later replay "$T/good.mcap" --map "$T/folder"
refused later replay "$T/good.mcap" --mode localization
refused later replay "$T/good.mcap" --mode sideways
refused later replay "$T/good.mcap" --map "$T/folder" --rerun "$T/run.rrd"
refused later replay "$T/good.mcap" --rerun "$T/nowhere/run.rrd"
refused later replay "$T/good.mcap" --out "$T/notes.txt"
# fleet and place database
refused later fleet setup "nonsense"
refused later fleet setup "postgresql://me:secret@127.0.0.1:9/places"
refused later fleet setup "postgresql://me@127.0.0.1:9/places"
refused now fleet setup "postgresql://me@127.0.0.1:9/places" --dimension 0
refused later fleet add "postgresql://me@127.0.0.1:9/places" rover
refused now fleet
refused now places list "$T/nowhere.sqlite"
refused later places list "$T/notes.txt"
refused now places delete "$T/nowhere.sqlite" --session 1
refused now places delete "$T/nowhere.sqlite"
refused now bench nonsense
refused now bench places --run "$T/nowhere"
refused later bench places --run "$T/folder"
# data sets and training
refused now import nuscenes "$T/nowhere" "$T/a.mcap"
refused later import nuscenes "$T/folder" "$T/a.mcap"
refused now train
refused now train "$T/folder" --config "$T/nowhere.yaml"
refused now train "$T/folder" --validation "$T/nowhere"
refused now train "$T/nowhere"
refused later train "$T/folder" --out "$T/train"
refused later train "$T/folder" --method nonsense
refused later train "$T/folder" --preset nonsense --out "$T/train"
refused later train "$T/folder" --resume --out "$T/train"
refused later export "$T/notes.txt/model.xml"
refused later export "$T/model.xml" --weights "$T/notes.txt"
# evaluation
printf 'sets: 3\n' > "$T/places.yaml"; printf 'places:\n  - name: a\n    queries: nowhere\n' > "$T/more.yaml"
refused now evaluate
refused now evaluate "$T/nowhere.yaml"
refused later evaluate "$T/places.yaml"
refused later evaluate "$T/more.yaml"
refused now evaluate --worlds moon
refused now evaluate --worlds test --count 9
refused now evaluate --worlds test --methods some
refused now evaluate "$T/good.mcap" --worlds test
refused later evaluate "$T/good.mcap"
# other commands
refused later why "$T/run" soon
refused later compare --list "$T/nowhere.csv" --out "$T/out.csv"
refused now compare --list "$T/pairs.csv"
refused now compare
refused later compare "$T/good.mcap@99999" "$T/good.mcap@0"
refused now sensors "$T/nowhere.mcap"
refused later sensors "$T/good.mcap" --out "$T/out"
refused now demo --rate 0
refused now demo --seed many
refused later demo --bag "$T/nowhere.mcap" --out "$T/out"
refused later demo --bag "$T/notes.txt" --out "$T/out"
refused later simulate "$T/a.mcap" --duration 1
refused later simulate "$T/a.mcap" --family venus
refused later simulate --shards "$T/shards" --worlds some
refused later simulate "$T/nowhere.png"
refused later explain "$T/good.mcap" soon 2
refused later inspect "$T/good.mcap" --write "$T/notes.txt"
refused now play "$T/good.mcap" --rate 0
refused now graph nonsense
refused later graph optimize "$T/notes.txt"

echo "$count wrong inputs, $wrong not as they should be, $tracebacks tracebacks"
echo "$at_once of them known at once: at most $slowest s of CPU, $longest s by the clock"
exit $((wrong > 0))
