"""Start loop-closure front-end, pose-graph back-end and the map of the ground; optionally a bag player and RViz.

ros2 launch umf_ros loop_closure.launch.py params_file:=/path/to/params.yaml bag:=/path/to/recording.mcap

Without a parameter file the nodes find their topics by type, and the rig by /tf_static and camera_info.
"""

from pathlib import Path

from ament_index_python.packages import PackageNotFoundError
from launch.actions import DeclareLaunchArgument, EmitEvent, OpaqueFunction, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription
from umf_ros.core.errors import ConfigError
from umf_ros.nodes.start import check_parameter_file, full_name, is_true

ARGUMENTS = [
    ("params_file", "", "parameter file; empty: none, topics are found by type"),
    ("config", "", "former name of params_file"),
    ("namespace", "", "namespace of the nodes and their topics; one per robot"),
    ("log_level", "info", "log level of the nodes: debug, info, warn, error or fatal"),
    ("use_sim_time", "", "true: use /clock; empty: true if bag is set"),
    ("rviz", "false", "true: open RViz"),
    ("bag", "", "recording to play; empty: none"),
    ("map", "true", "true: start map_node, the live map of the ground"),
    ("results_dir", "", "folder for closures, trajectories and the pose graph; empty: none"),
    ("autostart", "true", "true: the nodes configure and activate themselves; false: a life-cycle manager does"),
]
CHOICES = {"log_level": ["debug", "info", "warn", "error", "fatal"]}
LONGEST_S = "60"
"""Time in s that launch gives the nodes to write their results at shutdown."""


NODES, MAP = ("loop_closure_node", "pose_graph_node"), "map_node"


def start_nodes(context, *_):
    """Return the nodes for the arguments, after all arguments are checked.

    Raises:
        RuntimeError: an argument is wrong, a file or a package is missing, or a file is for other nodes.
    """
    value = {name: LaunchConfiguration(name).perform(context) for name, *_ in ARGUMENTS}
    share = FindPackageShare("umf_ros").perform(context)
    config = value["params_file"] or value["config"]
    try:
        own = _own_parameters(value)
        rviz, with_map = is_true("rviz", value["rviz"]), is_true("map", value["map"])
        if config:
            check_parameter_file(Path(config), [full_name(value["namespace"], name) for name in (*NODES, MAP)])
    except ConfigError as error:
        raise RuntimeError(str(error)) from None
    if value["bag"] and not Path(value["bag"]).exists():
        raise RuntimeError(f"bag: there is no {value['bag']}")

    def node(executable, **options):
        # only the node's own logger: at "debug" those of rcl print hundreds of lines
        logger = full_name(value["namespace"], executable).strip("/").replace("/", ".")
        return Node(
            package="umf_ros",
            executable=executable,
            name=executable,
            namespace=value["namespace"],
            output="screen",
            ros_arguments=["--log-level", f"{logger}:={value['log_level']}"],
            sigterm_timeout=LONGEST_S,
            sigkill_timeout=LONGEST_S,
            **options,
        )

    viewer = [_viewer(context, share, value["namespace"])] if rviz else []
    parameters = [*([config] if config else []), own]
    nodes = [node(name, parameters=parameters) for name in NODES]
    # neither node is useful alone: if one ends, launch ends the other
    ends = [
        RegisterEventHandler(OnProcessExit(target_action=one, on_exit=[EmitEvent(event=Shutdown())])) for one in nodes
    ]
    if with_map:
        nodes.append(node(MAP, parameters=parameters))
    if value["bag"]:
        player = node("bag_player_node", arguments=[value["bag"], "--wait-for-subscribers"])
        ends.append(RegisterEventHandler(OnProcessExit(target_action=player, on_exit=_end_if_it_failed)))
        nodes.append(player)
    return [*viewer, *ends, *nodes]


def _own_parameters(value):
    return {
        "use_sim_time": is_true("use_sim_time", value["use_sim_time"] or str(bool(value["bag"]))),
        "results_dir": value["results_dir"],
        "autostart": is_true("autostart", value["autostart"]),
    }


def _viewer(context, share, namespace):
    try:
        FindPackageShare("rviz2").perform(context)
    except PackageNotFoundError:
        raise RuntimeError("rviz: rviz2 is not installed (sudo apt install ros-jazzy-rviz2)") from None
    arguments = ["-d", f"{share}/config/loop_closure.rviz"]
    return Node(package="rviz2", executable="rviz2", name="rviz2", namespace=namespace, arguments=arguments)


def _end_if_it_failed(event, _):
    """Shut down if the player failed; after a complete recording the nodes continue."""
    return [EmitEvent(event=Shutdown(reason="the recording cannot be played"))] if event.returncode else []


def generate_launch_description():
    """Entry point of `ros2 launch`."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text, choices=CHOICES.get(name))
        for name, default, text in ARGUMENTS
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=start_nodes)])
