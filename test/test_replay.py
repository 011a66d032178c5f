"""The offline run: what it leaves behind when it ends, is stopped early, has no odometry, or starts over."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import umf
from recordings import small_settings, traverse, write_mcap
from sources import rows_of

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.reader import open_bag
from umf_ros.bags.trajectories import read_tum
from umf_ros.baselines.handcrafted import ThumbnailEmbedder
from umf_ros.core.config import Database, Settings, load_settings
from umf_ros.core.errors import OutputError
from umf_ros.core.frames import Frame
from umf_ros.detector import Detection, LoopDetector
from umf_ros.lab.commands.report import recover_run
from umf_ros.places.database import PlaceDatabase
from umf_ros.replay import FAULTS, Replay
from umf_ros.sensors.decode import OdometrySample

TABLES = "candidates.csv closures.csv config.yaml inliers.csv keyframes.csv".split()
TABLES += ["latencies.csv", "run.sqlite", "summary.json"]
KILLED_AT = 8
GRAPH = ["graph.g2o", "graph_verdicts.csv", "trajectory_odometry.tum", "trajectory_optimized.tum"]


Stream = list[Frame | OdometrySample]


@pytest.fixture(scope="module")
def stream(tmp_path_factory: pytest.TempPathFactory) -> Stream:
    """Scans, images and odometry of four seconds."""
    folder = tmp_path_factory.mktemp("bag")
    return list(FrameReader(open_bag(write_mcap(folder / "a.mcap", traverse(4.0))), small_settings(folder)).stream())


def frames_of(stream: Stream) -> list[Frame]:
    return [item for item in stream if isinstance(item, Frame)]


def changed(item: Frame | OdometrySample, **values: Any) -> Frame | OdometrySample:
    return replace(item, **values) if isinstance(item, Frame) else item._replace(**values)


def later_by(seconds: int, stream: Stream) -> Stream:
    return [changed(item, stamp_ns=item.stamp_ns + seconds * 10**9) for item in stream]


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    gaps = {"loop__min_time_gap_s": 1.0, "loop__min_travel_m": 0.3}
    policy = {"keyframe__min_translation_m": 0.2, "keyframe__min_period_s": 0.0, "keyframe__untracked_period_s": 0.5}
    return small_settings(tmp_path, **gaps, **policy)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "run").mkdir()
    return tmp_path / "run"


def replay_of(folder: Path, settings: Settings) -> Replay:
    return Replay(folder, settings, LoopDetector(settings, ThumbnailEmbedder()))


def names_in(folder: Path) -> list[str]:
    names = sorted(path.name for path in folder.iterdir())
    return [name for name in names if not name.endswith("ids.csv")]


def keyframes_in(folder: Path) -> list[dict[str, str]]:
    return rows_of(folder / "keyframes.csv")


def test_a_whole_run_leaves_tables_trajectories_and_graph(folder: Path, settings: Settings, stream: Stream) -> None:
    replay = replay_of(folder, settings)
    detections, frames = list(replay.run(stream)), frames_of(stream)
    assert [detection.frame_stamp_ns for detection in detections] == [frame.stamp_ns for frame in frames]
    assert replay.finish({"image": 0}) is True
    assert set(TABLES + GRAPH) <= set(names_in(folder))
    summary = json.loads((folder / "summary.json").read_text())
    chosen = [detection.keyframe.stamp_ns for detection in detections if detection.keyframe is not None]
    assert summary["frames"] == summary["pairs"] == len(frames) and summary["keyframes"] == len(chosen)
    assert [int(row["stamp_ns"]) for row in keyframes_in(folder)] == chosen
    assert summary["queries"] == sum(bool(detection.verdicts) for detection in detections) > 0
    assert summary["closures_rejected"] == sum(
        verdict.closure is None for detection in detections for verdict in detection.verdicts
    )
    assert summary["weights"] == ThumbnailEmbedder().name
    assert load_settings(folder / "config.yaml") == settings
    assert len(read_tum(folder / "trajectory_odometry.tum")) > 2


def test_a_stopped_run_is_complete_as_far_as_it_went(folder: Path, settings: Settings, stream: Stream) -> None:
    replay = replay_of(folder, settings)
    for count, _ in enumerate(replay.run(stream), 1):
        if count == 7:
            break
    assert replay.finish({}) is True
    assert set(TABLES + GRAPH) <= set(names_in(folder))
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["frames"] == 7 and summary["keyframes"] == len(keyframes_in(folder))
    assert read_tum(folder / "trajectory_odometry.tum").stamps_ns[-1] <= frames_of(stream)[7].stamp_ns


def test_a_killed_replay_is_exported_like_a_stopped_one(tmp_path: Path, settings: Settings, stream: Stream) -> None:
    """The process of the killed one ends without any of its own code being run again."""
    for name in ("stopped", "killed"):
        (tmp_path / name).mkdir()
    stopped = replay_of(tmp_path / "stopped", settings)
    process = multiprocessing.get_context("fork").Process(
        target=replay_and_die, args=(tmp_path / "killed", settings, stream)
    )
    process.start()
    process.join(60)
    assert process.exitcode == -signal.SIGKILL and names_in(tmp_path / "killed") != TABLES
    found = 0
    for detection in stopped.run(stream):
        found += detection.keyframe is not None
        if found == KILLED_AT:
            break
    stopped.finish({})
    assert recover_run(tmp_path / "killed") and not recover_run(tmp_path / "killed")
    tables = [name for name in TABLES + GRAPH if name.endswith((".csv", ".tum", ".g2o"))]
    for name in set(tables) - {"latencies.csv"}:
        assert (tmp_path / "killed" / name).read_bytes() == (tmp_path / "stopped" / name).read_bytes(), name
    summaries = [json.loads((tmp_path / name / "summary.json").read_text()) for name in ("killed", "stopped")]
    for key in ("frames", "pairs", "keyframes", "queries", "closures_published", "closures_rejected", "weights"):
        assert summaries[0][key] == summaries[1][key], key
    assert summaries[0]["interrupted"] is True


def replay_and_die(folder: Path, settings: Settings, stream: Stream) -> None:
    found = 0
    for detection in replay_of(folder, settings).run(stream):
        found += detection.keyframe is not None
        if found == KILLED_AT:
            os.kill(os.getpid(), signal.SIGKILL)


def test_a_folder_without_a_killed_run_is_left_alone(tmp_path: Path) -> None:
    assert not recover_run(tmp_path) and list(tmp_path.iterdir()) == []


def test_without_odometry_there_is_no_graph_and_it_says_so(folder: Path, settings: Settings, stream: Stream) -> None:
    replay = replay_of(folder, settings)
    list(replay.run(replace(frame, odom_T_body=None) for frame in frames_of(stream)))
    assert replay.finish({}) is False
    assert names_in(folder) == TABLES
    assert {row["travelled_m"] for row in keyframes_in(folder)} == {"nan"}


def test_odometry_that_jumps_begins_a_chain_of_its_own_as_it_does_live(
    folder: Path, settings: Settings, stream: Stream
) -> None:
    half, moved = len(stream) // 2, np.eye(4)
    moved[0, 3] = 500.0
    later = [one if one.odom_T_body is None else changed(one, odom_T_body=moved @ one.odom_T_body) for one in stream]
    replay = replay_of(folder, settings)
    list(replay.run([*stream[:half], *later[half:]]))
    replay.finish({})
    vertices = [line for line in (folder / "graph.g2o").read_text().splitlines() if line.startswith("VERTEX")]
    edges = [line for line in (folder / "graph.g2o").read_text().splitlines() if line.startswith("EDGE")]
    assert len(vertices) - len(edges) == 2


def test_a_recording_that_starts_over_is_written_down_once(folder: Path, settings: Settings, stream: Stream) -> None:
    replay = replay_of(folder, settings)
    again = [replace(item, session=1) if isinstance(item, Frame) else item for item in stream]
    list(replay.run([*stream, *again]))
    assert replay.finish({}) is True
    stamps = [row["stamp_ns"] for row in keyframes_in(folder)]
    assert len(stamps) == len(set(stamps)) > 3
    assert {row["session"] for row in keyframes_in(folder)} == {"0"}


@pytest.mark.parametrize("frames_done", [1, 8, 15, 19])
def test_a_replay_that_was_cut_off_ends_like_one_that_was_not(
    tmp_path: Path, settings: Settings, stream: Stream, frames_done: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("umf_ros.replay.WARM_UP", 2)
    settings = settings.model_copy(update={"database": Database(path=str(tmp_path / "places.sqlite"))})
    for name in ("whole", "cut"):
        (tmp_path / name).mkdir()
    detector = LoopDetector(settings, ThumbnailEmbedder())
    cut = Replay(tmp_path / "cut", settings, detector)
    for count, _ in enumerate(cut.run(stream), 1):
        if count == frames_done:
            break
    detector.database.close()  # the locks go with the process, and nothing else is left of it
    cut._recorder._file.close()
    resumed = Replay(tmp_path / "cut", settings, LoopDetector(settings, ThumbnailEmbedder()), resume=True)
    list(resumed.run(stream))
    resumed.finish({})
    settings = settings.model_copy(update={"database": Database()})
    replay = replay_of(tmp_path / "whole", settings)
    list(replay.run(stream))
    replay.finish({})
    same = (".csv", ".tum", ".g2o")
    for table in [name for name in TABLES + GRAPH if name.endswith(same) and name != "latencies.csv"]:
        assert (tmp_path / "cut" / table).read_text() == (tmp_path / "whole" / table).read_text(), table
    counts = [json.loads((tmp_path / name / "summary.json").read_text()) for name in ("cut", "whole")]
    for key in ("frames", "pairs", "keyframes", "queries", "closures_published", "closures_rejected"):
        assert counts[0][key] == counts[1][key], key


def test_a_run_of_no_frames_is_a_run(folder: Path, settings: Settings) -> None:
    replay = replay_of(folder, settings)
    assert list(replay.run([])) == [] and replay.finish({}) is False
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["frames"] == summary["keyframes"] == 0 and summary["latency_ms"]["total"]["p50"] is None


def test_the_same_frames_give_the_same_tables(tmp_path: Path, settings: Settings, stream: Stream) -> None:
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        replay = replay_of(tmp_path / name, settings)
        list(replay.run(stream))
        replay.finish({})
    for table in set(TABLES + GRAPH) - {"summary.json", "latencies.csv", "run.sqlite"}:  # with times
        assert (tmp_path / "one" / table).read_bytes() == (tmp_path / "two" / table).read_bytes(), table


def test_a_folder_that_is_not_there_is_one_clear_line(tmp_path: Path, settings: Settings) -> None:
    with pytest.raises(OutputError, match=r"cannot write .*nowhere/config\.yaml"):
        replay_of(tmp_path / "nowhere", settings)


def test_places_are_kept_from_run_to_run_when_a_file_is_named(tmp_path: Path, stream: Stream) -> None:
    database = {"path": str(tmp_path / "places.sqlite")}
    settings = small_settings(tmp_path, database=database, loop__min_time_gap_s=1.0)
    counts = []
    for name, driven in (("first", stream), ("second", later_by(60, stream))):
        (tmp_path / name).mkdir()
        replay = replay_of(tmp_path / name, settings)
        detections = list(replay.run(driven))
        replay.finish({})
        counts.append(sum(bool(detection.verdicts) for detection in detections))
        sessions = {row["session"] for row in keyframes_in(tmp_path / name)}
        assert sessions == {"0" if name == "first" else "1"}
    # the second run has the first one's places to look at from its first keyframe on
    assert counts[1] == len(keyframes_in(tmp_path / "second")) > counts[0]
    assert np.isfinite(float(keyframes_in(tmp_path / "second")[-1]["travelled_m"]))


def test_a_recording_replayed_over_one_store_tests_the_same_pairs(tmp_path: Path, stream: Stream) -> None:
    database = {"path": str(tmp_path / "places.sqlite")}
    settings = small_settings(tmp_path, database=database, loop__min_time_gap_s=1.0, loop__min_travel_m=0.3)
    tested = []
    for name in ("first", "second", "third"):
        (tmp_path / name).mkdir()
        replay = replay_of(tmp_path / name, settings)
        tested.append([(d.frame_stamp_ns, v.candidate.stamp_ns) for d in replay.run(stream) for v in d.verdicts])
        replay.finish({})
    assert tested[0] and tested[0] == tested[1] == tested[2]
    assert all(query - match >= 10**9 for query, match in tested[0])


def test_a_full_disk_ends_the_replay_after_what_was_found_is_kept(
    tmp_path: Path, settings: Settings, stream: Stream, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> int:
        raise OutputError("no space left on device")

    monkeypatch.setattr(PlaceDatabase, "add", full)
    (tmp_path / "run").mkdir()
    replay = replay_of(tmp_path / "run", settings)
    with pytest.raises(OutputError, match="no space"):
        list(replay.run(stream))
    replay.finish({})
    assert len(keyframes_in(tmp_path / "run")) == 1


def test_an_internal_error_at_one_frame_costs_that_frame_alone(
    stream: Stream, settings: Settings, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, broken = frames_of(stream), frames_of(stream)[4].stamp_ns
    process = LoopDetector.process

    def faulty(self: LoopDetector, frame: Frame) -> Detection:
        if frame.stamp_ns == broken:
            raise ZeroDivisionError("no points in a submap")
        return process(self, frame)

    monkeypatch.setattr(LoopDetector, "process", faulty)
    replay = Replay(folder, settings, LoopDetector(settings, ThumbnailEmbedder()))
    found = list(replay.run(stream))
    replay.finish({})
    assert [one.frame_stamp_ns for one in found] == [frame.stamp_ns for frame in whole]
    assert replay.faults == 1 and sum(one.keyframe is not None for one in found) > 3
    log = (folder / FAULTS).read_text()
    assert f"frame {broken}" in log and "ZeroDivisionError: no points in a submap" in log


def test_the_command_says_so_in_one_line_and_fails(
    settings: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bag = write_mcap(tmp_path / "a.mcap", traverse(2.0))

    def faulty(self: LoopDetector, frame: Frame) -> Detection:
        raise IndexError("out of bounds")

    monkeypatch.setattr(LoopDetector, "process", faulty)
    ended = umf("replay", bag, "--embedder", "thumbnail", "--out", tmp_path / "out")
    assert ended.status == 1 and "frames skipped after internal errors: please report " in ended.text
    assert "Traceback" not in ended.text
    assert (tmp_path / "out" / "latest" / "report.html").exists()
