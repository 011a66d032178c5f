"""A killed graph resumes from its write-ahead log."""

from __future__ import annotations

import os
import sqlite3
from pathlib import Path

import numpy as np
import pytest

from umf_ros.core.config import PoseGraphSettings, Settings, dump_settings
from umf_ros.core.errors import OutputError, UmfError
from umf_ros.core.frames import LoopClosure, State
from umf_ros.durable_graph import DurableGraph
from umf_ros.graph_process import JOURNAL
from umf_ros.lab.live.live_graph import settle_left
from umf_ros.lab.simulation.pose_graphs import PERIOD_NS, GraphWorld, rover_loops, with_wrong_closures
from umf_ros.pose_graph.closures import ClosureReason
from umf_ros.sensors.decode import OdometrySample
from umf_ros.sensors.sessions import CONFIRMING

SETTINGS = PoseGraphSettings(max_gap_s=3)


@pytest.fixture(scope="module")
def world() -> GraphWorld:
    return with_wrong_closures(rover_loops(300, 10003), 0.3, "groups", 1)


def made(path: Path | None, faults: list[OutputError] | None = None) -> DurableGraph:
    return DurableGraph(SETTINGS, path, (faults if faults is not None else []).append)


def drive(graph: DurableGraph, world: GraphWorld, first: int, last: int) -> None:
    """The part of the drive between two poses, with the closures that end there."""
    for k in range(first, last):
        graph.take([OdometrySample((k + 1) * PERIOD_NS, world.odometry[k])])
        for row, (_, query, *_) in enumerate(world.closures):
            if query == k:
                message = world.message(row)
                stamps = message.query_stamp_ns + PERIOD_NS, message.match_stamp_ns + PERIOD_NS
                graph.take([LoopClosure(*stamps, message.match_T_query, message.covariance)])
        graph.update()


def states(graph: DurableGraph) -> list[tuple[int, int, str]]:
    return [(v.closure.match_stamp_ns, v.closure.query_stamp_ns, v.state.value) for v in graph.graph.closures()]


def test_a_graph_that_was_killed_is_taken_up_as_it_was(world: GraphWorld, tmp_path: Path) -> None:
    whole, path = made(None), tmp_path / "pose_graph.sqlite"
    drive(whole, world, 0, len(world.truth))
    for first, last in ((0, 120), (120, 220), (220, len(world.truth))):
        graph = made(path)
        assert graph.changed == 0 and graph.recovered == len([c for c in world.closures if c[1] < first])
        drive(graph, world, first, last)
        os.close(graph._file._lock)  # as a kill does: nothing else is closed
    last_one = made(path)
    assert states(last_one) == states(whole) and last_one.changed == 0
    np.testing.assert_allclose(last_one.graph.trajectory()[1], whole.graph.trajectory()[1], atol=1e-6)
    assert "accepted" in {state for *_, state in states(whole)}


def test_a_revoked_closure_stays_revoked(world: GraphWorld, tmp_path: Path) -> None:
    graph = made(tmp_path / "graph.sqlite")
    drive(graph, world, 0, len(world.truth))
    match, query, _ = next(one for one in states(graph) if one[2] == "accepted")
    graph.decide_by_hand(match, query, State.REJECTED)
    graph.close()
    again = made(tmp_path / "graph.sqlite")
    assert (match, query, "rejected") in states(again) and states(again) == states(graph)


@pytest.mark.parametrize(
    ("pause_s", "moved_m", "sessions"), [(10, 1.0, 1), (10, 300.0, 2), (3600, 1.0, 1), (3600, 300.0, 2), (-50, 0, 2)]
)
def test_odometry_goes_on_after_a_restart_only_if_it_can_be_the_same(
    world: GraphWorld, tmp_path: Path, pause_s: int, moved_m: float, sessions: int
) -> None:
    graph = made(tmp_path / "graph.sqlite")
    drive(graph, world, 0, 50)
    graph.close()
    again = made(tmp_path / "graph.sqlite")
    pose = world.odometry[49].copy()
    pose[0, 3] += moved_m
    again.take([OdometrySample((50 + i) * PERIOD_NS + pause_s * 10**9, pose) for i in range(CONFIRMING)])
    assert len(again.graph.session_spans()) == sessions


def test_odometry_that_begins_at_its_origin_is_another(world: GraphWorld, tmp_path: Path) -> None:
    graph = made(tmp_path / "graph.sqlite")
    drive(graph, world, 0, 3)
    graph.close()
    again = made(tmp_path / "graph.sqlite")
    (reset,) = again.take([OdometrySample((8 + i) * PERIOD_NS, np.eye(4)) for i in range(CONFIRMING)])[1]
    assert "origin" in reset.reason


def test_closures_that_are_told_again_after_a_restart_count_once(world: GraphWorld, tmp_path: Path) -> None:
    graph = made(tmp_path / "graph.sqlite")
    drive(graph, world, 0, len(world.truth))
    graph.close()
    again = made(tmp_path / "graph.sqlite")
    again.take([OdometrySample(10**18 + i * PERIOD_NS, np.eye(4)) for i in range(CONFIRMING)])  # another session begins
    told = [verdict.closure for verdict in graph.graph.closures()]
    for closure in told:
        again.take([closure])
    assert len(again.graph.closures()) == len(told) == again.graph.counts["closure twice"]


def test_ending_a_graph_keeps_its_journal(world: GraphWorld, tmp_path: Path) -> None:
    graph = made(tmp_path / "graph.sqlite")
    drive(graph, world, 0, 60)
    old = graph.end()
    assert old is not None and sqlite3.connect(old).execute("SELECT count(*) FROM event").fetchone()[0] >= 60
    drive(graph, world, 0, 10)
    graph.close()
    assert len(made(tmp_path / "graph.sqlite").graph.trajectory()[0]) <= 10


def test_changed_settings_hold_for_the_next_graph_and_after_a_restart(world: GraphWorld, tmp_path: Path) -> None:
    graph, strict = made(tmp_path / "graph.sqlite"), SETTINGS.model_copy(update={"max_closure_m": 1e-3})
    graph.retune(strict)
    graph.end()
    drive(graph, world, 0, len(world.truth))
    assert {state for *_, state in states(graph)} == {"refused"}
    graph.close()
    again = DurableGraph(strict, tmp_path / "graph.sqlite", [].append)
    with sqlite3.connect(tmp_path / "graph.sqlite") as connection:
        assert connection.execute("PRAGMA user_version").fetchone()[0] == again._mark
    again.close()


def test_one_process_writes_and_what_is_no_journal_is_refused(tmp_path: Path) -> None:
    first = made(tmp_path / "graph.sqlite")
    with pytest.raises(UmfError, match="is in use by another process"):
        made(tmp_path / "graph.sqlite")
    first.close()
    (tmp_path / "text.sqlite").write_text("no database, " * 100)
    with pytest.raises(UmfError, match="cannot be used as a pose graph") as caught:
        made(tmp_path / "text.sqlite")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "change",
    [
        "UPDATE event SET data = 'text where bytes belong' WHERE id = 3",
        "UPDATE event SET data = x'00' WHERE id = 3",
        "UPDATE event SET kind = 'closure' WHERE id = 3",
        "UPDATE event SET kind = 'anything' WHERE id = 3",
        "UPDATE event SET first_ns = 'yesterday' WHERE id = 3",
        "ALTER TABLE verdict DROP COLUMN state",
    ],
)
def test_a_journal_that_holds_nonsense_is_refused_in_one_line(change: str, world: GraphWorld, tmp_path: Path) -> None:
    path = tmp_path / "pose_graph.sqlite"
    graph = made(path)
    drive(graph, world, 0, 5)
    graph.close()
    with sqlite3.connect(path) as connection:
        connection.execute(change)
    with pytest.raises(UmfError, match=r"is damaged|is not that of a pose graph") as refusal:
        made(path)
    assert "\n" not in str(refusal.value)


def test_a_journal_that_cannot_be_written_costs_no_closure(world: GraphWorld, tmp_path: Path) -> None:
    faults: list[OutputError] = []
    graph = made(tmp_path / "graph.sqlite", faults)
    graph._file.connection.execute("PRAGMA query_only = 1")  # type: ignore[union-attr]
    drive(graph, world, 0, 60)
    assert len(graph.graph.trajectory()[0]) > 10 and faults and "cannot write" in str(faults[0])


def test_a_closure_from_before_the_first_odometry_is_told_soon(world: GraphWorld) -> None:
    graph = made(None)
    drive(graph, world, 150, 160)
    graph.take([world.message(0)])
    drive(graph, world, 160, 175)
    (verdict,) = [v for v in graph.graph.closures() if v.closure.match_stamp_ns == world.message(0).match_stamp_ns]
    assert (verdict.state.value, verdict.reason) == ("refused", "no odometry at its keyframes: it began later")


def test_what_was_not_settled_in_time_is_known_to_be_and_settled_later(tmp_path: Path, world: GraphWorld) -> None:
    durable = made(tmp_path / JOURNAL)
    drive(durable, world, 0, 300)
    assert not durable.write_results(tmp_path, within_s=-1.0) and durable.unsettled
    hasty = (tmp_path / "trajectory_optimized.tum").read_text()
    durable.close()
    (tmp_path / "config.yaml").write_text(dump_settings(Settings(pose_graph=SETTINGS)))
    settle_left(tmp_path)
    assert (tmp_path / "trajectory_optimized.tum").read_text() != hasty
    again = made(tmp_path / JOURNAL)
    assert not again.unsettled
    again.close()


def test_ending_a_graph_keeps_a_journal_that_somebody_reads(world: GraphWorld, tmp_path: Path) -> None:
    graph = made(tmp_path / JOURNAL)
    drive(graph, world, 0, 230)
    before = states(graph)
    reader = sqlite3.connect(tmp_path / JOURNAL)
    reader.execute("BEGIN")
    reader.execute("SELECT count(*) FROM event").fetchone()  # its log cannot be written back now
    graph.take([OdometrySample(231 * PERIOD_NS, world.odometry[230])])
    kept = graph.end()
    graph.close()
    reader.close()
    assert kept is not None
    assert made(tmp_path / JOURNAL).recovered == 0
    again = made(kept)
    assert states(again) == before and again.graph.counts["odometry"] == 231


def test_a_resumed_graph_goes_on_and_keeps_revocations(world: GraphWorld, tmp_path: Path) -> None:
    whole, path = made(None), tmp_path / "pose_graph.sqlite"
    drive(whole, world, 0, len(world.truth))
    graph = made(path)
    drive(graph, world, 0, 270)
    revoked = next((match, query) for match, query, state in states(graph) if state == "accepted")
    before = graph.graph.verdict_counts()
    graph.close()
    again = made(path)
    assert again.changed == 0 and again.graph.verdict_counts() == before and again.recovered == sum(before.values())
    drive(again, world, 270, len(world.truth))
    assert states(again) == states(whole)
    np.testing.assert_allclose(again.graph.trajectory()[1], whole.graph.trajectory()[1], atol=1e-6)
    again.decide_by_hand(*revoked, State.REJECTED)
    again.close()
    last_one = made(path)
    assert (*revoked, "rejected") in states(last_one)
    last_one.graph.settle()
    assert (*revoked, "rejected") in states(last_one)


def test_other_settings_decide_all_again(world: GraphWorld, tmp_path: Path) -> None:
    graph = made(tmp_path / JOURNAL)
    drive(graph, world, 0, len(world.truth))
    counts = graph.graph.verdict_counts()
    graph.close()
    believing = SETTINGS.model_copy(update={"reject_outliers": False})
    again = DurableGraph(believing, tmp_path / JOURNAL, [].append)
    assert again.graph.verdict_counts() != counts and again.changed


def test_decisions_by_hand_are_there_again_until_they_are_undone(world: GraphWorld, tmp_path: Path) -> None:
    graph = made(tmp_path / "graph.sqlite")
    drive(graph, world, 0, len(world.truth))
    match, query, before = next(one for one in states(graph) if one[2] != "accepted")
    graph.decide_by_hand(match, query, State.ACCEPTED)
    graph.close()
    again = made(tmp_path / "graph.sqlite")
    assert (match, query, "accepted") in states(again)
    again.decide_by_hand(match, query, State.PENDING)
    again.close()
    last_one = made(tmp_path / "graph.sqlite")
    assert (match, query, before) in states(last_one)
    last_one.close()


def test_closures_without_time_wait_and_the_next_call_decides_about_them(world: GraphWorld) -> None:
    graph = made(None)
    graph.take([OdometrySample(k * PERIOD_NS, pose) for k, pose in enumerate(world.odometry)])
    closures = [world.message(row) for row in range(len(world.closures))]
    verdicts, _ = graph.take(closures, 0.0)
    assert {verdict.reason for verdict in verdicts} == {ClosureReason.NOT_DECIDED_YET}
    assert graph.graph.undecided == len(closures)
    assert {verdict.state for verdict in graph.take([])[0]} >= {State.ACCEPTED} and not graph.graph.undecided
