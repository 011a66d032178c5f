"""Start the loop-closure front-end and the pose-graph back-end; optionally a bag player and RViz.

ros2 launch umf_ros loop_closure.launch.py params_file:=/path/to/params.yaml bag:=/path/to/recording.mcap
"""

from pathlib import Path

from launch.actions import DeclareLaunchArgument, EmitEvent, OpaqueFunction, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

ARGUMENTS = [
    ("params_file", "", "parameter file; empty: the shipped config/loop_closure.yaml"),
    ("config", "", "the same, by its former name"),
    ("namespace", "", "namespace of both nodes and of their topics: one for each robot"),
    ("log_level", "info", "debug, info, warn, error or fatal"),
    ("use_sim_time", "", "true to follow /clock; empty: true when a bag is played"),
    ("rviz", "false", "true to open RViz"),
    ("bag", "", "recording to play"),
    ("results_dir", "", "folder for closures, trajectories and the pose graph; empty: none"),
    ("autostart", "true", "false: the nodes wait for the services of their life cycle"),
]
LONGEST_S = "60"
"""So long the nodes may take to write their results before launch insists."""


def start_nodes(context, *_):
    """Turn the arguments into nodes.

    Raises:
        RuntimeError: a file is missing: nothing is started on other settings than those that were asked for.
    """
    value = {name: LaunchConfiguration(name).perform(context) for name, *_ in ARGUMENTS}
    share = FindPackageShare("umf_ros").perform(context)
    config = value["params_file"] or value["config"] or f"{share}/config/loop_closure.yaml"
    for name, path in (("params_file", config), ("bag", value["bag"])):
        if path and not Path(path).exists():
            raise RuntimeError(f"{name}: there is no {path}")
    own = {
        "use_sim_time": _is_true(value["use_sim_time"] or str(bool(value["bag"]))),
        "results_dir": value["results_dir"],
        "autostart": _is_true(value["autostart"]),
    }

    def node(executable, **options):
        return Node(
            package="umf_ros",
            executable=executable,
            name=executable,
            namespace=value["namespace"],
            output="screen",
            ros_arguments=["--log-level", value["log_level"]],
            sigterm_timeout=LONGEST_S,
            sigkill_timeout=LONGEST_S,
            **options,
        )

    nodes = [node(name, parameters=[config, own]) for name in ("loop_closure_node", "pose_graph_node")]
    # one alone finds or judges nothing: when one cannot start, the other is not left behind
    ends = [
        RegisterEventHandler(OnProcessExit(target_action=one, on_exit=[EmitEvent(event=Shutdown())])) for one in nodes
    ]
    if value["bag"]:
        nodes.append(node("bag_player_node", arguments=[value["bag"], "--wait-for-subscribers"]))
    if _is_true(value["rviz"]):
        rviz = ["-d", f"{share}/config/loop_closure.rviz"]
        options = {"namespace": value["namespace"], "arguments": rviz}
        nodes.append(Node(package="rviz2", executable="rviz2", name="rviz2", **options))
    return [*nodes, *ends]


def _is_true(text):
    return text.strip().lower() in ("true", "1", "yes", "on")


def generate_launch_description():
    """Entry point of `ros2 launch`."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text) for name, default, text in ARGUMENTS
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=start_nodes)])
