"""Start the loop-closure front-end and the pose-graph back-end; optionally a bag player and RViz.

ros2 launch umf_ros loop_closure.launch.py config:=/path/to/params.yaml bag:=/path/to/recording.mcap
"""

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

ARGUMENTS = [
    ("config", "", "parameter file; empty: the shipped config/loop_closure.yaml"),
    ("use_sim_time", "", "true to follow /clock; empty: true when a bag is played"),
    ("rviz", "false", "true to open RViz"),
    ("bag", "", "recording to play"),
    ("results_dir", "", "folder for closures, trajectories and the pose graph; empty: none"),
]


def start_nodes(context, *_):
    """Turn the arguments into nodes."""
    value = {name: LaunchConfiguration(name).perform(context) for name, *_ in ARGUMENTS}
    share = FindPackageShare("umf_ros").perform(context)
    config = value["config"] or f"{share}/config/loop_closure.yaml"
    sim_time = (value["use_sim_time"] or str(bool(value["bag"]))).lower() == "true"
    parameters = [config, {"use_sim_time": sim_time, "results_dir": value["results_dir"]}]

    def node(executable, **options):
        return Node(package="umf_ros", executable=executable, name=executable, output="screen", **options)

    nodes = [node("loop_closure_node", parameters=parameters), node("pose_graph_node", parameters=parameters)]
    if value["bag"]:
        nodes.append(node("bag_player_node", arguments=[value["bag"], "--wait-for-subscribers"]))
    if value["rviz"].lower() == "true":
        rviz = ["-d", f"{share}/config/loop_closure.rviz"]
        nodes.append(Node(package="rviz2", executable="rviz2", name="rviz2", arguments=rviz))
    return nodes


def generate_launch_description():
    """Entry point of `ros2 launch`."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text) for name, default, text in ARGUMENTS
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=start_nodes)])
