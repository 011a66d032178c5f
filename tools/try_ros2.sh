#!/usr/bin/env bash
# Try every verb of the `ros2` command on the nodes, and print a table "tried | expected | got".
#
#   source install/setup.bash && src/umf_ros/tools/try_ros2.sh [--write docs/ros.md]
#
# Needs a sourced Jazzy with umf_ros built by colcon; no sensors. --write puts the table between the markers of a file.
set -u
export ROS_DOMAIN_ID=${ROS_DOMAIN_ID:-77} ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST
folder=$(mktemp -d)
table=$folder/table.md
failures=0
launched=0
trap 'kill -INT $launched 2>/dev/null; wait 2>/dev/null; ros2 daemon stop >/dev/null 2>&1; rm -rf "$folder"' EXIT

row() { # command, what is expected (an extended regular expression), what that means
  local got verdict
  got=$(timeout -k 2 25 bash -c "$1" 2>&1 </dev/null)
  if grep -Eq -- "$2" <<<"$got"; then
    verdict="as expected"
  else
    verdict="**$(tail -1 <<<"$got" | cut -c1-80 | tr '|' '/')**"
    failures=$((failures + 1))
  fi
  printf '| `%s` | %s | %s |\n' "${1//|/\\|}" "$3" "$verdict" | tee -a "$table"
}

ros2 daemon start >/dev/null 2>&1  # the first question to a fresh one finds an empty graph
printf '| tried | expected | got |\n|---|---|---|\n' >"$table"
row 'ros2 pkg executables umf_ros' 'loop_closure_node' 'both nodes are there'
row 'ros2 launch umf_ros loop_closure.launch.py --show-args' 'params_file' 'every argument is described'
row 'ros2 launch umf_ros loop_closure.launch.py params_file:=/no.yaml' 'there is no /no.yaml' 'stops with one line'
row 'umf --version' 'umf_ros [0-9]' '`umf` is in the path'
ros2 launch umf_ros loop_closure.launch.py namespace:=one results_dir:="$folder/run" >"$folder/launch.log" 2>&1 &
launched=$!
for _ in $(seq 60); do [ "$(grep -c ': ready' "$folder/launch.log")" -ge 2 ] && break; sleep 1; done
sleep 5
front=/one/loop_closure_node back=/one/pose_graph_node
row 'ros2 node list' "$front" 'both nodes in their namespace'
row "ros2 node info $front" '/one/loop_closures: nav_msgs/msg/Odometry' 'topics are relative to the namespace'
row 'ros2 topic list -t' '/one/loop_closures \[nav_msgs/msg/Odometry\]' 'stock message types only'
row 'ros2 topic info -v /one/loop_closures' 'Durability: TRANSIENT_LOCAL' 'latched, with history'
row 'ros2 topic echo --once /diagnostics' 'one/(loop_closure|pose_graph)_node: ' 'health, by node'
row 'ros2 topic hz /diagnostics --window 5 & sleep 8; kill $!' 'average rate' 'about twice per second'
row "ros2 param list $back" 'pose_graph.gate_chi2' 'every setting is a parameter'
row "ros2 param describe $front loop.top_k" 'Max value: 200' 'with its range'
row "ros2 param get $front verification.min_probability" '0\.9' 'and its value'
row "ros2 param set $front verification.min_probability 0.95" 'successful' 'what may change does'
row "ros2 param set $front loop.top_k 0" 'failed|range' 'within its range'
row "ros2 param set $front embedding.threads 2" 'read-only' 'and nothing else'
row "ros2 param dump $front" 'min_probability: 0.95' 'a file to start from'
row "ros2 service list" "$front/save" 'services of the nodes'
row "ros2 service call $front/pause std_srvs/srv/SetBool '{data: true}'" "message='paused'" 'paused'
row "ros2 service call $front/reset std_srvs/srv/Trigger" 'all places are kept' 'ends the session, deletes nothing'
row "ros2 service call $back/save std_srvs/srv/Trigger" 'results written' 'trajectory and graph on disk'
row "ros2 topic pub --once $back/reject_edge std_msgs/msg/String '{data: nonsense}'" 'publishing' 'is survived, and counted'
row 'ros2 lifecycle nodes' "$back" 'managed nodes'
row "ros2 lifecycle get $front" 'active' 'active from the start'
row "ros2 lifecycle set $front deactivate" 'Transitioning successful' 'stops taking messages'
row "ros2 lifecycle set $front activate" 'Transitioning successful' 'takes them again'
row 'ros2 interface show nav_msgs/msg/Odometry' 'child_frame_id' 'any SLAM system has it'
kill -INT "$launched"
wait "$launched" 2>/dev/null
row "cat $folder/launch.log" 'loop_closure_node-1\]: process has finished cleanly' 'Ctrl-C: the front-end ends cleanly'
row "cat $folder/launch.log" 'pose_graph_node-2\]: process has finished cleanly' 'Ctrl-C: the back-end ends cleanly'
row "ls $folder/run" 'graph.g2o' 'and its results are written'
sed -i "s|$folder|FOLDER|g" "$table"

if [ "${1:-}" = --write ]; then
  sed -i -e "/<!-- try_ros2 begin -->/,/<!-- try_ros2 end -->/{//!d}" -e "/<!-- try_ros2 begin -->/r $table" "$2"
fi
echo "$failures of $(($(wc -l <"$table") - 2)) not as expected"
[ "$failures" -eq 0 ]
