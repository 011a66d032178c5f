#!/usr/bin/env bash
# Run every verb of the `ros2` command on nodes in two namespaces; print a table "tried | expected | got".
#
#   source install/setup.bash && src/umf_ros/tools/try_ros2.sh [--write docs/history/ros.md]
#
# Needs a sourced Jazzy with umf_ros built by colcon; no sensors. --write puts the table between the markers of a file.
set -u
export ROS_DOMAIN_ID=${ROS_DOMAIN_ID:-77} ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST
folder=$(mktemp -d)
table=$folder/table.md
failures=0
launched=()
trap 'stop; ros2 daemon stop >/dev/null 2>&1; rm -rf "$folder"' EXIT

row() { # command, what is expected (an extended regular expression), what that means
  local got verdict
  got=$(timeout -k 2 60 bash -c "$1" 2>&1 </dev/null)
  if grep -Eq -- "$2" <<<"$got"; then
    verdict="as expected"
  else
    verdict="**$(tail -1 <<<"$got" | cut -c1-80 | tr '|' '/')**"
    failures=$((failures + 1))
  fi
  # shellcheck disable=SC2016
  printf '| `%s` | %s | %s |\n' "${1//|/\\|}" "$3" "$verdict" | tee -a "$table"
}

launch() { # namespace: both nodes, until they are ready
  # background processes ignore SIGINT by default, and so do their children
  # --dataset: no topics exist yet that could be found by type
  env --default-signal=INT,TERM ros2 launch umf_ros loop_closure.launch.py namespace:="$1" results_dir:="$folder/run_$1" \
    params_file:="$(ros2 pkg prefix --share umf_ros)/config/loop_closure.yaml" >"$folder/$1.log" 2>&1 &
  launched+=($!)
  for _ in $(seq 120); do [ "$(grep -c ': ready' "$folder/$1.log")" -ge 2 ] && return; sleep 0.5; done
}

stop() { # Ctrl-C for all that was launched
  for one in "${launched[@]}"; do kill -INT "$one" 2>/dev/null; done
  for one in "${launched[@]}"; do
    for _ in $(seq 120); do kill -0 "$one" 2>/dev/null || break; sleep 0.5; done
    kill -KILL "$one" 2>/dev/null
  done
  launched=()
}

printf '| tried | expected | got |\n|---|---|---|\n' >"$table"
printf 'camera_driver:\n  ros__parameters: {rate: 30}\n' >"$folder/other.yaml"
start='ros2 launch umf_ros loop_closure.launch.py'
row 'ros2 pkg executables umf_ros' 'loop_closure_node' 'both nodes are listed'
row 'umf --version' 'umf_ros [0-9]' 'the command is on the PATH'
row "$start --show-args" 'params_file' 'every argument is described'
row "$start params_file:=/no.yaml" 'there is no /no.yaml' 'stops with one line'
row "$start params_file:=$folder/other.yaml" 'sets nothing for /loop_closure_node' 'a file for other nodes: stops with one line'
row "$start namespace:=one params_file:=$folder" 'there is no' 'a folder: stops with one line'
row "$start log_level:=loud" 'Valid options are' 'stops with one line'
row "$start use_sim_time:=perhaps" 'true or false' 'stops with one line'
row "$start bag:=/no.mcap" 'there is no /no.mcap' 'stops with one line'
row "$start bag:=$folder/other.yaml" 'pose_graph_node-2\]: process has finished cleanly' 'not a recording: the nodes end'
row 'ros2 run umf_ros loop_closure_node --ros-args -p lop:=1' '^umf: unknown parameter lop$' 'stops with one line'
row 'ros2 run umf_ros pose_graph_node --ros-args -p pose_graph.gate_chi2:=-1.0' '^umf: pose_graph.gate_chi2' 'value out of range: stops with one line'
# shellcheck disable=SC2016
row 'timeout --preserve-status -s INT 1 $(ros2 pkg prefix umf_ros)/lib/umf_ros/loop_closure_node; echo status $?' \
  '^status 0$' 'Ctrl-C while loading: status 0'

launch one
launch two
ros2 daemon start >/dev/null 2>&1  # the first question to a fresh one finds an empty graph
sleep 5
front=/one/loop_closure_node back=/one/pose_graph_node
row 'ros2 node list' "$front" 'nodes are in their namespaces'
row "ros2 node info $front" '/one/loop_closures: nav_msgs/msg/Odometry' 'topics are in the namespace'
row 'ros2 topic list -t' '/two/loop_closures \[nav_msgs/msg/Odometry\]' 'stock message types only'
row 'ros2 topic info -v /one/loop_closures' 'Durability: TRANSIENT_LOCAL' 'latched, with history'
zeros='0, 0, 0, 0, 0, 0'
closure="{header: {stamp: {sec: 9}, frame_id: keyframe/1000000000}, child_frame_id: keyframe/9000000000,
  pose: {covariance: [1, $zeros, 1, $zeros, 1, $zeros, 1, $zeros, 1, $zeros, 1]}}"
printf '%s\n' "$closure" >"$folder/closure.yaml"
row "ros2 topic pub --once --qos-durability transient_local /one/loop_closures nav_msgs/msg/Odometry \"\$(cat $folder/closure.yaml)\"" \
  'publishing' 'a closure of robot one is published'
health="ros2 topic echo --once /diagnostics --filter"
row "$health 'm.status[0].name == \"one/pose_graph_node: pose graph\" and \"1 closures pending\" in m.status[0].message'" \
  'hardware_id: one' 'the back-end of robot one receives it'
row "$health 'm.status[0].name == \"two/pose_graph_node: pose graph\"'" 'message: .?0 closures accepted' 'the back-end of robot two does not'
row "timeout 8 ros2 topic pub --once /one/loop_closures nav_msgs/msg/Odometry; cat $folder/one.log" \
  'incompatible QoS' 'a publisher without history: QoS warning'
row 'ros2 topic hz /diagnostics --window 5 & sleep 8; kill $!' 'average rate' 'about once per second and node'
row "ros2 param list $back" 'pose_graph.gate_chi2' 'every setting is a parameter'
row "ros2 param describe $front loop.top_k" 'Max value: 200' 'the range is printed'
row "ros2 param get $front verification.min_probability" '0\.9' 'the value is printed'
row "ros2 param set $front verification.min_probability 0.95" 'successful' 'a run-time parameter changes'
row "ros2 param set $front loop.top_k 0" 'failed|range' 'a value out of range is refused'
row "ros2 param set $front loop.top_k many" '[Ww]rong parameter type' 'a value of another type is refused'
row "ros2 param set $front embedding.threads 2" 'read-only' 'a read-only parameter is refused'
row "ros2 param dump $front" 'min_probability: 0.95' 'a file to start from'
row "ros2 service list" "$front/save" 'services are listed'
row "ros2 service call $front/pause std_srvs/srv/SetBool '{data: true}'" "message='paused'" 'the front-end pauses'
row "ros2 service call $front/reset std_srvs/srv/Trigger" 'all places are kept' 'the session ends, all places are kept'
row "ros2 service call $back/save std_srvs/srv/Trigger" 'results written' 'trajectory and graph on disk'
row "ros2 topic pub --once $back/reject_edge std_msgs/msg/String '{data: nonsense}'" 'publishing' 'a malformed message is published; later rows still pass'
pair='{load_namespace: keyframe/1000000000 keyframe/9000000000}'
for verb in add_closure reject_edge undo_edit; do
  row "ros2 service call $back/$verb diagnostic_msgs/srv/AddDiagnostics '$pair'" 'no closure between keyframes' \
    'a closure that waits for its odometry: refused in one line'
done
row 'ros2 lifecycle nodes' "$back" 'managed nodes are listed'
row "ros2 lifecycle get $front" 'active' 'active after the start'
row "ros2 lifecycle set $front configure" 'Unknown transition' 'an invalid transition is refused'
row "ros2 lifecycle set $front deactivate" 'Transitioning successful' 'the transition succeeds'
row "ros2 lifecycle set $front activate" 'Transitioning successful' 'the transition succeeds'
row "for to in deactivate cleanup configure activate; do ros2 lifecycle set $back \$to; done; ros2 node info $back" \
  "$back/path: nav_msgs/msg/Path" 'publishers are created again'
row "ros2 topic info $back/path" 'Publisher count: 1' 'one publisher only'
row "ros2 param set $back use_sim_time true; sleep 34; cat $folder/one.log" 'clock is silent' 'no /clock: a warning is logged'
row 'ros2 interface show nav_msgs/msg/Odometry' 'child_frame_id' 'a standard message type'
stop
for one in one two; do
  row "cat $folder/$one.log" 'loop_closure_node-1\]: process has finished cleanly' 'Ctrl-C: the front-end ends cleanly'
  row "cat $folder/$one.log" 'pose_graph_node-2\]: process has finished cleanly' 'Ctrl-C: the back-end ends cleanly'
done
row "ls $folder/run_one" 'graph.g2o' 'results are written'
sed -i "s|$folder|FOLDER|g" "$table"

if [ "${1:-}" = --write ]; then
  sed -i -e "/<!-- try_ros2 begin -->/,/<!-- try_ros2 end -->/{//!d}" -e "/<!-- try_ros2 begin -->/r $table" "$2"
fi
echo "$failures of $(($(wc -l <"$table") - 2)) not as expected"
[ "$failures" -eq 0 ]
