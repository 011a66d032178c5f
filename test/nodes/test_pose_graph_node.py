"""The live back-end over real DDS: a drive with right and wrong closures, bad input, services, an orderly end."""

from __future__ import annotations

import csv
import itertools
import os
import re
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from diagnostic_msgs.srv import AddDiagnostics
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from live_peers import Peer, odometry
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from processes import Process, call_service, wait_until
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import NavSatFix
from std_msgs.msg import String
from visualization_msgs.msg import MarkerArray

from umf_ros.absolute.measurement import Aid
from umf_ros.core.geometry import relative, to_quaternion
from umf_ros.lab.datasets.g2o import read_g2o
from umf_ros.lab.simulation.pose_graphs import PERIOD_NS, GraphWorld, open_ground, rover_loops, with_wrong_closures
from umf_ros.nodes.conversions import (
    CLOSURES_QOS,
    LATCHED_QOS,
    closure_to_message,
    from_time,
    parse_pair,
    to_time,
)
from umf_ros.sensors.decode import decode_pose

MODULE = "umf_ros.nodes.pose_graph_node"


class Rig(Peer):
    """A rover's odometry and front-end, and ears for everything the back-end says."""

    def __init__(self, world: GraphWorld) -> None:
        super().__init__("pose_graph_node", "pose graph")
        self.world = world
        self.odometry = self.create_publisher(Odometry, "/odom", 50)
        self.closures = self.create_publisher(Odometry, "/loop_closures", CLOSURES_QOS)
        self.reject = self.create_publisher(String, "/pose_graph_node/reject_edge", 10)
        self.hear(PathMessage, "path", LATCHED_QOS)
        self.hear(MarkerArray, "markers", LATCHED_QOS)
        self.hear(DiagnosticArray, "verdicts", CLOSURES_QOS)
        self.hear(PoseWithCovarianceStamped, "pose", qos_profile_sensor_data)
        self.hear(TransformStamped, "map_to_odom", qos_profile_sensor_data)

    def drive(self, first: int, last: int) -> None:
        for k in range(first, last):
            self.odometry.publish(odometry(k * PERIOD_NS, self.world.odometry[k]))
            if k % 10 == 0:
                # best effort: what is sent faster than it is taken is lost
                wait_until(lambda k=k: self._answered(k * PERIOD_NS), 5.0, self.spin)

    @property
    def taken(self) -> int:
        return int(self.values.get("odometry", 0))

    def _answered(self, stamp_ns: int) -> bool:
        poses = self.heard["pose"]
        return bool(poses) and from_time(poses[-1].header.stamp) == stamp_ns


@pytest.fixture
def rig(ros_context: None) -> Iterator[Rig]:
    world = with_wrong_closures(rover_loops(300, 10003), 0.3, "groups", 1)
    node = Rig(world)
    yield node
    node.destroy_node()


@pytest.fixture
def process(tmp_path: Path) -> Iterator[Process]:
    started = Process(
        MODULE,
        tmp_path / "node.log",
        f"results_dir:={tmp_path / 'results'}",
        "pose_graph.max_gap_s:=3",
        "dataset:=s3li-etna",
    )
    started.wait_for("ready")
    yield started
    started.kill()


def verdicts(rig: Rig) -> dict[str, str]:
    latest = {}
    for message in rig.heard["verdicts"]:
        for status in message.status:
            latest[status.name] = next(pair.value for pair in status.values if pair.key == "verdict")
    return latest


def test_a_drive_ends_on_its_true_path_and_wrong_closures_stay_out(rig: Rig, process: Process, tmp_path: Path) -> None:
    rig.wait_for(lambda: rig.odometry.get_subscription_count() and rig.closures.get_subscription_count())
    rig.drive(0, len(rig.world.truth))
    rig.wait_for(lambda: rig.taken >= len(rig.world.truth) - 5)
    for row in range(len(rig.world.closures)):
        rig.closures.publish(closure_to_message(rig.world.message(row)))
    rig.wait_for(lambda: len(verdicts(rig)) == len(rig.world.closures))
    names = [f"keyframe/{i * PERIOD_NS} keyframe/{j * PERIOD_NS}" for i, j, *_ in rig.world.closures]
    right = {name for name, closure in zip(names, rig.world.closures, strict=True) if closure.right}
    rig.wait_for(lambda: sum(v == "accepted" for v in verdicts(rig).values()) >= len(right) - 2)
    assert {name for name, verdict in verdicts(rig).items() if verdict == "accepted"} <= right
    told = rig.heard["verdicts"][-1].status[-1]
    assert [pair.key for pair in told.values] == ["verdict", "mahalanobis", "misfit_m"]

    # the pose follows the odometry with the newest correction, whatever the optimiser does
    rig.wait_for(lambda: rig.values.get("accepted") and float(rig.values["accepted"]) >= len(right) - 2)
    drift_m = np.linalg.norm(rig.world.odometry[-1][:3, 3] - rig.world.truth[-1][:3, 3])
    stamps = itertools.count(len(rig.world.truth))

    def stands_where_it_is() -> bool:
        rig.heard["pose"].clear()
        rig.odometry.publish(odometry(next(stamps) * PERIOD_NS, rig.world.odometry[-1]))
        wait_until(lambda: bool(rig.heard["pose"]), 2.0, rig.spin)
        at = [decode_pose(pose.pose.pose)[:3, 3] for pose in rig.heard["pose"]]
        return bool(at) and bool(np.linalg.norm(at[-1] - rig.world.truth[-1][:3, 3]) < 0.5 * drift_m)

    # the last verdicts and the correction after them may come later than the first of these poses
    rig.wait_for(stands_where_it_is)
    pose = rig.heard["pose"][-1]
    assert pose.header.frame_id == "map"
    assert np.linalg.eigvalsh(np.reshape(pose.pose.covariance, (6, 6))).min() > 0
    assert rig.heard["map_to_odom"][-1].child_frame_id == "odom"
    rig.wait_for(lambda: len(rig.heard["path"][-1].poses) >= len(rig.world.truth) - 5)
    rig.wait_for(lambda: sum(len(m.points) for m in rig.heard["markers"][-1].markers) == 2 * len(rig.world.closures))
    green, _, red, *measured = rig.heard["markers"][-1].markers
    assert [marker.ns for marker in measured] == ["absolute accepted", "absolute pending", "absolute rejected"]
    assert (green.ns, red.ns) == ("accepted", "rejected")

    assert process.interrupt() == 0
    results = tmp_path / "results"
    assert len((results / "trajectory_optimized.tum").read_text().splitlines()) >= len(rig.world.truth) - 5
    assert (results / "trajectory_odometry.tum").is_file()
    assert read_g2o(results / "graph.g2o").problems == []
    rows = list(csv.DictReader((results / "graph_verdicts.csv").open()))
    ends = {(int(r["match_stamp_ns"]), int(r["query_stamp_ns"])) for r in rows if r["verdict"] == "accepted"}
    assert {f"keyframe/{match} keyframe/{query}" for match, query in ends} == right


def test_bad_messages_are_counted_and_the_node_goes_on(rig: Rig, process: Process) -> None:
    rig.wait_for(lambda: rig.odometry.get_subscription_count() and rig.closures.get_subscription_count())
    world = rig.world
    broken, undated = odometry(PERIOD_NS, world.odometry[0]), odometry(0, world.odometry[0])
    broken.pose.pose.orientation.w = 3.0
    rig.odometry.publish(broken)
    rig.drive(0, 100)
    foreign = closure_to_message(world.message(0))
    foreign.header.frame_id = "elsewhere"
    flat = closure_to_message(world.message(0))
    flat.pose.covariance = np.zeros(36)
    own = closure_to_message(world.message(0))
    own.header.frame_id = own.child_frame_id
    for message in (foreign, flat, own):
        rig.closures.publish(message)
    wanted = ("pose", "stamp", "closure_frame", "reject_edge")

    def all_counted() -> bool:
        # a best-effort message may be lost: broken ones are sent until each kind was seen
        rig.odometry.publish(broken)
        rig.odometry.publish(undated)
        rig.reject.publish(String(data="the red one"))
        return all(name in rig.values for name in wanted)

    rig.wait_for(all_counted)
    rig.wait_for(lambda: sum(name.startswith("closure refused") for name in rig.values) == 2)
    rig.wait_for(lambda: rig.taken >= 95)
    assert "a new session" not in process.output


def test_no_message_ends_the_node(rig: Rig, process: Process) -> None:
    rig.wait_for(lambda: rig.odometry.get_subscription_count() and rig.closures.get_subscription_count())
    endless = closure_to_message(rig.world.message(0))
    endless.header.frame_id = "keyframe/" + "9" * 5000
    beyond = closure_to_message(rig.world.message(0))
    beyond.child_frame_id = "keyframe/" + "9" * 19
    infinite = closure_to_message(rig.world.message(0))
    infinite.pose.covariance = np.full(36, 1e308)
    for message in (endless, beyond, infinite):
        rig.closures.publish(message)
    for text in (
        "keyframe/" + "9" * 5000 + " keyframe/1",
        "keyframe/" + "9" * 19 + " keyframe/1",
        "keyframe/1 keyframe/2",
    ):
        rig.reject.publish(String(data=text))
    rig.wait_for(lambda: rig.values.get("closure_frame") == "2" and rig.values.get("reject_edge") == "2")
    rig.wait_for(lambda: rig.values.get("GraphError") == "1")
    assert process.exit_code is None and "Traceback" not in process.output
    assert max(map(len, process.output.splitlines())) < 500


def test_graph_and_verdicts_are_there_again_after_a_kill(rig: Rig, tmp_path: Path) -> None:
    parameters = f"results_dir:={tmp_path / 'results'}", "pose_graph.max_gap_s:=3", "dataset:=simulated"
    process = Process(MODULE, tmp_path / "one.log", *parameters)
    process.wait_for("ready")
    rig.wait_for(lambda: rig.odometry.get_subscription_count() and rig.closures.get_subscription_count())
    rig.drive(0, len(rig.world.truth))
    for row in range(len(rig.world.closures)):
        rig.closures.publish(closure_to_message(rig.world.message(row)))
    rig.wait_for(lambda: len(verdicts(rig)) == len(rig.world.closures))
    taken = -1
    while taken != rig.taken:  # until a status later nothing more has come
        taken = rig.taken
        rig.values.clear()
        rig.wait_for(lambda: rig.values.get("accepted") == str(list(verdicts(rig).values()).count("accepted")))
    before, odometry_before, solver = rig.values["accepted"], rig.taken, Path(f"/proc/{process.child}")
    process.kill()
    assert wait_until(lambda: not solver.exists())
    rig.values.clear()
    again = Process(MODULE, tmp_path / "two.log", *parameters)
    again.wait_for("ready")
    assert f"recovered: {odometry_before} odometry messages" in again.output and "differ" not in again.output
    rig.wait_for(lambda: rig.values.get("accepted") == before)
    second = Process(MODULE, tmp_path / "three.log", *parameters)
    wait_until(lambda: second.exit_code is not None, 120.0)
    assert second.exit_code == 1 and "is in use by another process" in second.output
    assert len(second.output.strip().splitlines()) == 1
    for one in (again, second):
        one.kill()


def test_the_end_of_the_solver_ends_the_node_and_loses_nothing(rig: Rig, tmp_path: Path) -> None:
    parameters = f"results_dir:={tmp_path / 'results'}", "topics.odometry:=/odom"
    process = Process(MODULE, tmp_path / "one.log", *parameters)
    process.wait_for("ready")
    rig.wait_for(lambda: rig.odometry.get_subscription_count())
    rig.drive(0, 50)
    rig.wait_for(lambda: rig.taken >= 45)
    taken = rig.taken  # diagnostics are of a moment ago: the journal may hold more
    os.kill(process.child, signal.SIGKILL)
    assert wait_until(lambda: process.exit_code is not None)
    journal = tmp_path / "results" / "pose_graph.sqlite"
    line = f"umf: the process of the pose graph ended by SIGKILL: the next start resumes it from {journal}"
    assert process.exit_code == 1 and process.output.splitlines().count(line) == 1
    assert process.output.splitlines()[-1] == line and "Traceback" not in process.output
    again = Process(MODULE, tmp_path / "two.log", *parameters)
    again.wait_for("ready")
    recovered = re.search(r"recovered: (\d+) odometry messages", again.output)
    assert recovered and taken <= int(recovered[1]) <= 50


def test_a_namespace_is_a_robot(rig: Rig, process: Process, tmp_path: Path) -> None:
    other = Process(MODULE, tmp_path / "other.log", "__ns:=/other", "dataset:=simulated")
    other.wait_for("ready")
    rig.wait_for(lambda: rig.closures.get_subscription_count() and "other/pose_graph_node: pose graph" in rig.messages)
    assert {name for name, _ in rig.get_topic_names_and_types()} >= {"/other/loop_closures", "/other/odom"}
    assert rig.count_subscribers("/loop_closures") == rig.count_subscribers("/other/loop_closures") == 1
    rig.drive(0, 20)
    rig.wait_for(lambda: rig.taken >= 15)
    assert other.interrupt() == 0
    other.kill()


def test_without_autostart_it_waits_for_its_life_cycle(rig: Rig, tmp_path: Path) -> None:
    process = Process(MODULE, tmp_path / "node.log", "autostart:=false")
    state = call_service(rig, GetState, "/pose_graph_node/get_state", GetState.Request()).current_state.id
    assert state == State.PRIMARY_STATE_UNCONFIGURED and rig.count_subscribers("/loop_closures") == 0

    def step(number: int) -> None:
        request = ChangeState.Request(transition=Transition(id=number))
        assert call_service(rig, ChangeState, "/pose_graph_node/change_state", request).success, process.output

    step(Transition.TRANSITION_CONFIGURE)
    step(Transition.TRANSITION_ACTIVATE)
    rig.wait_for(lambda: rig.odometry.get_subscription_count())
    rig.drive(0, 20)
    rig.wait_for(lambda: rig.taken >= 15)
    step(Transition.TRANSITION_DEACTIVATE)
    step(Transition.TRANSITION_CLEANUP)
    assert process.interrupt() == 0, process.output
    process.kill()


def test_without_a_clock_it_says_so(rig: Rig, tmp_path: Path) -> None:
    process = Process(MODULE, tmp_path / "node.log", "use_sim_time:=true")
    process.wait_for("/clock is silent")
    rig.wait_for(lambda: "pose_graph_node: pose graph" in rig.messages)
    process.kill()


def test_a_gate_changes_while_the_node_runs(rig: Rig, process: Process) -> None:
    wanted = Parameter("pose_graph.max_closure_m", value=0.001).to_parameter_msg()
    wrong = Parameter("pose_graph.gate_chi2", value=-1.0).to_parameter_msg()
    fixed = Parameter("pose_graph.max_gap_s", value=9.0).to_parameter_msg()
    request = SetParameters.Request(parameters=[wanted, wrong, fixed])
    answer = call_service(rig, SetParameters, "/pose_graph_node/set_parameters", request)
    assert [result.successful for result in answer.results] == [True, False, False]
    rig.wait_for(lambda: rig.closures.get_subscription_count())
    rig.closures.publish(closure_to_message(rig.world.message(0)))
    rig.wait_for(lambda: any("absurd translation" in name for name in rig.values))


def test_a_rover_without_odometry_is_no_fault(rig: Rig, tmp_path: Path) -> None:
    process = Process(MODULE, tmp_path / "node.log", "topics.odometry:=''")
    process.wait_for("ready")
    rig.wait_for(lambda: "closures" in " ".join(rig.messages))
    assert not any("odometry" in name for name in rig.messages) and process.exit_code is None
    assert process.interrupt() == 0, process.output
    process.kill()


def test_a_folder_that_cannot_be_written_is_told_at_the_start(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    process = Process(MODULE, tmp_path / "node.log", f"results_dir:={tmp_path / 'file' / 'results'}")
    wait_until(lambda: process.exit_code is not None, 90.0)
    assert process.exit_code == 1
    assert process.output == f"umf: cannot write to {tmp_path / 'file' / 'results'}: Not a directory\n"
    process.kill()


def test_services_revoke_save_and_reset(rig: Rig, process: Process, tmp_path: Path) -> None:
    rig.wait_for(lambda: rig.odometry.get_subscription_count() and rig.closures.get_subscription_count())
    assert not rig.call("reject_last").success
    rig.drive(0, len(rig.world.truth))
    rig.wait_for(lambda: rig.taken >= len(rig.world.truth) - 5)
    for row in range(len(rig.world.closures)):
        rig.closures.publish(closure_to_message(rig.world.message(row)))
    rig.wait_for(lambda: "accepted" in verdicts(rig).values())
    assert rig.call("save").success
    assert (tmp_path / "results" / "graph.g2o").is_file()
    answer = rig.call("reject_last")
    assert answer.success and "revoked" in answer.message
    match, query = answer.message.split()[1:3]
    rig.wait_for(lambda: verdicts(rig)[f"{match} {query}"] == "rejected")
    assert rig.call("reset").success
    rig.wait_for(lambda: rig.values.get("accepted") is None)
    assert process.exit_code is None


def test_edges_are_edited_by_hand_and_undone_by_name(rig: Rig, process: Process, tmp_path: Path) -> None:
    rig.wait_for(lambda: rig.odometry.get_subscription_count() and rig.closures.get_subscription_count())
    rig.drive(0, len(rig.world.truth))
    for row in range(len(rig.world.closures)):
        rig.closures.publish(closure_to_message(rig.world.message(row)))
    rig.wait_for(lambda: len(verdicts(rig)) == len(rig.world.closures))

    def call(service: str, text: str) -> AddDiagnostics.Response:
        request = AddDiagnostics.Request(load_namespace=text)
        return call_service(rig, AddDiagnostics, f"/pose_graph_node/{service}", request)

    right = next(name for name, verdict in verdicts(rig).items() if verdict == "accepted")
    answer = call("reject_edge", right)
    assert answer.success and answer.message == f"closure {right} rejected: revoked by hand"
    rig.wait_for(lambda: verdicts(rig)[right] == "rejected")
    answer = call("undo_edit", right)
    assert answer.success and "by hand" not in answer.message
    answer = call("add_closure", right)
    assert answer.success and answer.message == f"closure {right} accepted: accepted by hand"
    # one that the front-end did not find
    truth = rig.world.truth
    x, y, z = relative(truth[10], truth[20])[:3, 3]
    turn = " ".join(map(str, to_quaternion(relative(truth[10], truth[20]))))
    new = f"keyframe/{10 * PERIOD_NS} keyframe/{20 * PERIOD_NS}"
    answer = call("add_closure", f"{new} {x} {y} {z} {turn} 0.1 1.0")
    assert answer.success and answer.message == f"closure {new} accepted: accepted by hand"
    rig.wait_for(lambda: verdicts(rig).get(new) == "accepted")
    for text, told in (
        ("keyframe/1 keyframe/2", "no closure between keyframes 1 and 2"),
        ("nonsense", "'nonsense' is no pair of keyframes"),
        (f"{new} 1 2 3", "is no pose"),
        (f"{new} 1 2 3 0 0 0 0 1 1", "is no pose"),
    ):
        answer = call("add_closure", text)
        assert not answer.success and told in answer.message
    assert process.interrupt() == 0
    rows = list(csv.DictReader((tmp_path / "results" / "graph_verdicts.csv").open()))
    by_hand = {(int(row["match_stamp_ns"]), int(row["query_stamp_ns"])) for row in rows if "by hand" in row["reason"]}
    assert by_hand == {(10 * PERIOD_NS, 20 * PERIOD_NS), parse_pair(right)}


def test_a_clock_that_goes_back_begins_a_session(rig: Rig, process: Process) -> None:
    rig.wait_for(lambda: rig.odometry.get_subscription_count())
    rig.drive(0, 60)
    rig.wait_for(lambda: rig.taken >= 55)
    rig.drive(0, 20)
    process.wait_for("a new session begins")
    rig.wait_for(lambda: rig.taken >= 75)


def test_a_wrong_parameter_is_one_line(tmp_path: Path) -> None:
    process = Process(MODULE, tmp_path / "node.log", "pose_graph.gate:=3")
    wait_until(lambda: process.exit_code is not None, 90.0)
    assert process.exit_code == 1
    assert "unknown parameter pose_graph.gate" in process.output
    assert len(process.output.strip().splitlines()) == 1
    process.kill()


def test_fixes_over_dds_are_decided_about_and_told(ros_context: None, tmp_path: Path) -> None:
    world = open_ground(10_004, 300.0)
    rig = Rig(world.graph)
    fixes, results = rig.create_publisher(NavSatFix, "/gnss/fix", 50), tmp_path / "results"
    arguments = (
        "absolute.gnss:=/gnss/fix",
        "topics.odometry:=/odom",
        "pose_graph.max_gap_s:=3",
        "pose_graph.odometry_sigma_deg:=0.1",
    )
    process = Process(MODULE, tmp_path / "node.log", f"results_dir:={results}", *arguments)
    try:
        process.wait_for("ready")
        rig.wait_for(lambda: rig.odometry.get_subscription_count() and fixes.get_subscription_count())
        given = {one.stamp_ns // PERIOD_NS: one for one in world.measurements if one.source is Aid.GNSS}
        for k in range(len(world.graph.truth)):
            rig.drive(k, k + 1)
            if k in given:
                message = NavSatFix(position_covariance_type=2)
                message.header.stamp, message.status.status = to_time(k * PERIOD_NS), 0
                message.latitude, message.longitude, message.altitude = given[k].value.tolist()
                message.position_covariance = given[k].covariance.ravel()
                fixes.publish(message)
        fixes.publish(NavSatFix())  # without a stamp
        rig.wait_for(lambda: int(rig.values.get("gnss accepted", 0)) > 100)
        rig.wait_for(lambda: "stamp" in rig.values)
        assert "pose_graph_node: input gnss" in rig.messages
        assert process.interrupt() == 0
    finally:
        process.kill()
        rig.destroy_node()
    rows = list(csv.DictReader((results / "absolute_verdicts.csv").open()))
    both = zip(world.measurements, world.lies, strict=True)
    lies = {one.stamp_ns for one, lie in both if lie and one.source is Aid.GNSS}
    assert len(lies) > 20
    accepted = {int(row["stamp_ns"]) for row in rows if row["verdict"] == "accepted"}
    assert len(accepted) > 100 and not accepted & lies
