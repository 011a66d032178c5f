"""Managed nodes: what a transition makes, the opposite one takes off the graph again."""

from __future__ import annotations

import gc
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from threading import Event
from types import SimpleNamespace

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from lifecycle_msgs.msg import State, Transition, TransitionEvent
from lifecycle_msgs.srv import ChangeState, GetAvailableStates, GetAvailableTransitions, GetState
from processes import Process, call_service, wait_until
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter

from umf_ros.core.errors import ConfigError, OutputError
from umf_ros.core.geometry import make_pose
from umf_ros.nodes import diagnostics
from umf_ros.nodes.base_node import BaseNode
from umf_ros.nodes.loop_closure_node import LoopClosureNode
from umf_ros.nodes.pose_graph_node import PoseGraphNode
from umf_ros.sensors.decode import OdometrySample

STALL = "executor_stall_max_ms"


class Back(PoseGraphNode):
    """With last words that may fail."""

    fault: Exception | None = None

    def _finish(self) -> None:
        super()._finish()
        if self.fault is not None:
            raise self.fault


@pytest.fixture
def node(ros_context: None) -> Iterator[Back]:
    node = Back()
    yield node
    node.fault = None
    node.close()
    node.destroy_node()


def entities(node: Node) -> Counter[str]:
    sent, heard = ([one.topic_name for one in ends] for ends in (node.publishers, node.subscriptions))
    topics = [f"to {name}" for name in sent] + [f"from {name}" for name in heard]
    return Counter([*topics, *(service.srv_name for service in node.services)])


def test_a_node_that_is_made_anew_is_there_once(node: Back) -> None:
    node.set_parameters([Parameter("use_sim_time", value=True)])
    made = entities(node)
    assert {"from /clock", "from /odom", "to /pose_graph_node/path"} <= set(made)
    for _ in range(2):
        node.trigger_deactivate()
        node.trigger_cleanup()
        left = entities(node)
        assert "from /odom" not in left and "to /pose_graph_node/path" not in left
        # it goes on to know the time, and to say how it is
        assert {"from /clock", "to /diagnostics"} <= set(left)
        node.trigger_configure()
        node.trigger_activate()
        assert entities(node) == made


@pytest.mark.parametrize("make", [PoseGraphNode, LoopClosureNode])
def test_what_a_failed_configuration_made_does_not_stand_in_the_way_of_the_next(
    make: type[BaseNode], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An open graph or database keeps other processes and openings out."""
    given = ["autostart:=false", f"results_dir:={tmp_path}", "dataset:=s3li-etna", "embedding.method:=solid"]
    given.append(f"database.path:={tmp_path / 'places.sqlite'}")
    rclpy.init(args=["--ros-args", *(part for one in given for part in ("-p", one))])
    node = make()

    def fail(*_: object, **__: object) -> None:
        raise ConfigError("no such topic")

    with monkeypatch.context() as patch:
        patch.setattr(make, "_subscribe", fail)
        assert node.trigger_configure() is TransitionCallbackReturn.FAILURE
    assert node.trigger_configure() is TransitionCallbackReturn.SUCCESS
    node.close()
    node.destroy_node()
    rclpy.try_shutdown()


def test_no_pose_is_told_of_odometry_that_the_correction_is_not_of(node: Back, monkeypatch: pytest.MonkeyPatch) -> None:
    """An outlier, and the first messages after a reset while the worker is busy with a large graph."""
    told: list[float] = []
    monkeypatch.setattr(node, "_pose_publisher", SimpleNamespace(publish=lambda one: told.append(position(one))))
    newest_s, gate = 100, Event()

    def hear(*x: float) -> None:
        nonlocal newest_s
        for one in x:
            newest_s += 1
            node._on_odometry(OdometrySample(newest_s * 10**9, make_pose(np.eye(3), [one, 0.0, 0.0])))

    hear(0.0)
    assert wait_until(lambda: node._corrected == 0)
    hear(0.5, 1.0, 500.0, 1.5)
    assert told == [0.5, 1.0, 1.5]
    node._worker.submit(gate.wait)
    hear(500.0, 500.5, 501.0, 501.5)
    assert told == [0.5, 1.0, 1.5]
    gate.set()
    assert wait_until(lambda: node._corrected == 1)
    hear(502.0)
    assert told == [0.5, 1.0, 1.5, 502.0]


def position(message: PoseWithCovarianceStamped) -> float:
    return float(message.pose.pose.position.x)


def test_a_player_that_is_still_starting_is_no_warning(
    node: Back, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    now_s = [1000.0]
    monkeypatch.setattr(diagnostics, "time", SimpleNamespace(monotonic=lambda: now_s[0]))

    def logged(seconds: int) -> str:
        for _ in range(seconds):
            now_s[0] += 1.0
            node._watch()
        return capfd.readouterr().err

    node.set_parameters([Parameter("use_sim_time", value=True)])
    assert "WARN" not in logged(25)
    monkeypatch.setattr(node, "_lacks_clock", lambda: False)  # it plays
    assert "WARN" not in logged(4)
    assert "nothing received: no publisher on /odom" in logged(4)
    monkeypatch.undo()
    assert "/clock is silent" in logged(35)


def test_diagnostics_have_the_longest_stall_of_the_executor(node: Back) -> None:
    stalls: list[float] = []

    def hear(report: DiagnosticArray) -> None:
        stalls.extend(float(one.value) for line in report.status for one in line.values if one.key == STALL)

    node.create_subscription(DiagnosticArray, "/diagnostics", hear, 10)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    node.create_timer(0.2, lambda: time.sleep(0.4))
    assert wait_until(lambda: bool(stalls) and stalls[-1] > 300, 20.0, lambda: executor.spin_once(timeout_sec=0.1))
    executor.shutdown()


def test_a_fault_that_goes_on_is_logged_now_and_then(node: Back, capfd: pytest.CaptureFixture[str]) -> None:
    def fail() -> None:
        raise ZeroDivisionError("a fault in the program")

    for name in ("one", "other", "one", "one"):
        node._guarded(name, fail)()
    captured = capfd.readouterr()
    assert (captured.out + captured.err).count("a fault in the program") == 2


def test_garbage_is_looked_for_among_what_comes_while_the_node_runs(node: Back) -> None:
    # a collection stops every thread: over all modules and networks that are there it took a third of a second
    for _ in range(2):
        assert gc.get_freeze_count() > 10_000
        node.trigger_deactivate()
        node.trigger_cleanup()
        assert gc.get_freeze_count() == 0  # what it let go of can be found
        node.trigger_configure()
        node.trigger_activate()


def heard_at_the_end(node: Back) -> list[str]:
    events: list[str] = []
    listener = Node("listener")
    topic = "/pose_graph_node/transition_event"
    listener.create_subscription(TransitionEvent, topic, lambda event: events.append(event.goal_state.label), 10)
    executor = SingleThreadedExecutor()
    executor.add_node(listener)

    def spin() -> None:
        executor.spin_once(timeout_sec=0.02)

    wait_until(lambda: listener.count_publishers(topic) > 0, 10.0, spin)
    wait_until(lambda: False, 0.3, spin)
    try:
        node.close()
    finally:
        wait_until(lambda: "finalized" in events, 10.0, spin)
        executor.shutdown()
        listener.destroy_node()
    return events


def test_who_waits_for_its_last_words_hears_when_they_begin_and_end(node: Back) -> None:
    assert heard_at_the_end(node) == ["shuttingdown", "finalized"]


def test_results_that_cannot_be_written_at_the_end_are_told_to_who_closes_it(node: Back) -> None:
    node.fault = OutputError("cannot write graph.g2o: No space left on device")
    with pytest.raises(OutputError, match="No space left"):
        node.close()


def test_a_fault_in_a_transition_is_told_and_can_be_mended(node: Back, capfd: pytest.CaptureFixture[str]) -> None:
    node.fault = ZeroDivisionError("a fault in the program")
    node.trigger_deactivate()
    assert node.trigger_cleanup() is TransitionCallbackReturn.FAILURE
    captured = capfd.readouterr()
    assert "ZeroDivisionError: a fault in the program" in captured.out + captured.err
    assert node.trigger_activate() is TransitionCallbackReturn.FAILURE
    node.fault = None
    for step in (node.trigger_cleanup, node.trigger_configure, node.trigger_activate):
        assert step() is TransitionCallbackReturn.SUCCESS


ASKED = [Transition(id=Transition.TRANSITION_ACTIVATE), Transition(id=99), Transition(label="fly\x1b[31m\nup")]
ASKED += [Transition(id=Transition.TRANSITION_ON_CONFIGURE_SUCCESS), Transition(label="deactivate"), Transition()]


@pytest.mark.parametrize("name", ["loop_closure_node", "pose_graph_node", "map_node"])
def test_a_transition_that_is_not_possible_is_refused_in_the_response(
    name: str, ros_context: None, tmp_path: Path
) -> None:
    given = ["autostart:=false", "dataset:=s3li-etna", "embedding.method:=thumbnail"]
    process, client = Process(f"umf_ros.nodes.{name}", tmp_path / "node.log", *given), Node("client")

    def change(transition: Transition) -> bool:
        request = ChangeState.Request(transition=transition)
        return call_service(client, ChangeState, f"/{name}/change_state", request).success

    def state() -> int:
        return call_service(client, GetState, f"/{name}/get_state", GetState.Request()).current_state.id

    for asked in ASKED:
        assert not change(asked)
        assert state() == State.PRIMARY_STATE_UNCONFIGURED
    # the second one of two in a row is queued behind the first
    both = client.create_client(ChangeState, f"/{name}/change_state")
    answers = [both.call_async(ChangeState.Request(transition=Transition(label="configure"))) for _ in range(2)]
    assert wait_until(lambda: all(it.done() for it in answers), 60.0, lambda: rclpy.spin_once(client, timeout_sec=0.1))
    assert [one.result().success for one in answers] == [True, False] and state() == State.PRIMARY_STATE_INACTIVE
    assert change(Transition(label="activate")) and not change(Transition(id=Transition.TRANSITION_CONFIGURE))
    assert state() == State.PRIMARY_STATE_ACTIVE
    for kind, service in (
        (GetAvailableStates, "get_available_states"),
        (GetAvailableTransitions, "get_available_transitions"),
        (GetAvailableTransitions, "get_transition_graph"),
    ):
        assert call_service(client, kind, f"/{name}/{service}", kind.Request()) is not None
    assert change(Transition(label="shutdown")) and not change(Transition(label="shutdown"))
    assert state() == State.PRIMARY_STATE_FINALIZED
    assert process.output.count("refused: not possible in the state") == len(ASKED) + 3, process.output
    assert "transition activate" not in process.output and process.interrupt() == 0
    client.destroy_node()
