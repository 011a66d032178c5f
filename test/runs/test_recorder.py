from __future__ import annotations

import json
import subprocess
import sys
import threading
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from conftest import make_frame, make_keyframe
from sources import rows_of

from umf_ros.core.config import Settings, load_settings
from umf_ros.core.errors import OutputError, UmfError
from umf_ros.core.frames import Candidate, LoopClosure
from umf_ros.core.geometry import make_pose
from umf_ros.core.io import memory_mb
from umf_ros.detector import Detection
from umf_ros.runs import writer as recorder_module
from umf_ros.runs.run_file import ALWAYS, SCAN_UNIT_M, RunFile, read_closures, read_descriptors
from umf_ros.runs.writer import RunRecorder, count_drops, read_summary
from umf_ros.sensors.synchronizer import INPUTS, SURPLUS, InputCounter
from umf_ros.verification import Hypothesis, RejectReason

MEASUREMENTS = {"similarity": 0.4, "inliers_image": 3.0}
COUNTS = ["frames", "pairs", "keyframes", "queries", "closures_published", "closures_rejected"]
OTHERS = ["latency_ms", "drops", "realtime_factor", "peak_rss_mb", "seed", "version", "weights"]
KEYS = [*COUNTS, "ground_truth", *OTHERS]


def accepted(query_ns: int, match_ns: int) -> Hypothesis:
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    closure = LoopClosure(
        query_ns, match_ns, make_pose(turn, [1.5, -0.25, 0.125]), np.diag([4, 1, 1, 0.25, 1, 1]), 0.97
    )
    pixels = np.array([[1, 2, 3, 4], [5, 6, 7, 8]], np.float32)
    return Hypothesis(query_ns, Candidate(0, match_ns, 0.8), MEASUREMENTS, closure=closure, inlier_pixels=pixels)


def detection(stamp_s: float, verdicts: list[Hypothesis]) -> Detection:
    latency = {"embed": 10.0, "query": 1.0, "verify": stamp_s, "total": 11 + stamp_s}
    return Detection(round(stamp_s * 1e9), make_keyframe(stamp_s, stamp_s), verdicts, latency)


def record_a_little(folder: Path) -> RunRecorder:
    recorder = RunRecorder(folder, Settings(), "some_weights")
    rejected = Hypothesis(40, Candidate(1, 5, 0.4), MEASUREMENTS, RejectReason.NO_POSE)
    recorder.record(make_frame(1), Detection(10**9))
    recorder.record(make_frame(2), detection(2, []))
    recorder.record(
        replace(make_frame(40), left=np.zeros((2, 2), np.uint8)), detection(40, [accepted(40, 2), rejected])
    )
    return recorder


def test_the_summary_has_its_stable_keys_and_counts(tmp_path: Path) -> None:
    recorder = record_a_little(tmp_path)
    counters = {name: InputCounter(received=9, used=2) for name in INPUTS}
    counters["right"].dropped.update({"size": 3, SURPLUS: 4})
    recorder.write_summary(count_drops(counters, worker=1))
    summary = read_summary(tmp_path)
    assert list(summary) == KEYS
    assert [summary[key] for key in KEYS[:6]] == [3, 1, 2, 1, 1, 1]
    assert summary["drops"] == {"image": 3, "cloud": 0, "odometry": 0, "worker": 1}
    assert summary["latency_ms"]["verify"] == {"p50": 21.0, "p95": pytest.approx(38.1), "max": 40.0}
    assert summary["ground_truth"] is None and summary["weights"] == "some_weights"
    assert summary["realtime_factor"] > 1  # 39 recorded seconds in a moment


def test_an_empty_run_is_valid_json(tmp_path: Path) -> None:
    RunRecorder(tmp_path, Settings(), "w").write_summary({})
    text = (tmp_path / "summary.json").read_text()
    assert json.loads(text, parse_constant=pytest.fail)["latency_ms"]["embed"]["p50"] is None


def test_tables_are_exported_at_the_end(tmp_path: Path) -> None:
    record_a_little(tmp_path).close()
    rows = rows_of(tmp_path / "candidates.csv")
    assert [row["reason"] for row in rows] == ["accepted", RejectReason.NO_POSE.value]
    assert json.loads(rows[1]["numbers"]) == MEASUREMENTS
    assert [float(row["match_v"]) for row in rows_of(tmp_path / "inliers.csv")] == [4, 8]
    assert [row["stamp_ns"] for row in rows_of(tmp_path / "keyframes.csv")] == ["2000000000", "40000000000"]


def test_closures_survive_the_table(tmp_path: Path) -> None:
    record_a_little(tmp_path).close()
    (closure,) = read_closures(tmp_path / "closures.csv")
    expected = accepted(40, 2).closure
    assert expected is not None
    assert (closure.query_stamp_ns, closure.match_stamp_ns, closure.probability) == (40, 2, 0.97)
    np.testing.assert_allclose(closure.match_T_query, expected.match_T_query, atol=1e-9)
    np.testing.assert_allclose(closure.covariance, expected.covariance)


def test_the_effective_settings_are_written_first(tmp_path: Path) -> None:
    settings = load_settings(None, loop__top_k=3)
    RunRecorder(tmp_path, settings, "w")
    assert load_settings(tmp_path / "config.yaml") == settings


def test_a_folder_that_is_gone_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot write"):
        RunRecorder(tmp_path / "gone", Settings(), "w")


def test_the_realtime_factor_is_recorded_time_by_elapsed_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A looped bag starts over: its second lap counts like the first, and the jump back does not."""
    now_s = [50.0]
    monkeypatch.setattr(recorder_module, "time", SimpleNamespace(monotonic=lambda: now_s[0]))
    recorder = RunRecorder(tmp_path, Settings(), "w")
    for session in range(2):
        for second in (100, 110, 130):
            recorder.record(make_frame(second, session=session), Detection(second * 10**9))
    now_s[0] += 20.0
    assert recorder.summary({})["realtime_factor"] == 3.0


def test_the_summary_can_be_written_again_as_the_run_goes_on(tmp_path: Path) -> None:
    recorder = RunRecorder(tmp_path, Settings(), "w")
    for count in range(1, 4):
        recorder.record(make_frame(count), detection(count, []))
        recorder.write_summary({"worker": count})
        summary = read_summary(tmp_path)
        assert summary["keyframes"] == count and summary["drops"] == {"worker": count}
        assert summary["peak_rss_mb"] > 20 and summary["seed"] == 0
    assert sorted(path.name for path in tmp_path.glob("summary*")) == ["summary.json"]


def test_the_memory_is_that_of_the_process_and_not_of_the_one_that_started_it() -> None:
    large = np.ones(700 * 2**17)
    code = "import umf_ros.runs.writer; from umf_ros.core.io import memory_mb; print(memory_mb(peak=True))"
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert 20 < float(child.stdout) < 600 < large.nbytes / 2**20 < memory_mb(peak=True)


def test_a_keyframe_that_was_asked_and_found_nothing_is_no_query(tmp_path: Path) -> None:
    recorder = RunRecorder(tmp_path, Settings(), "w")
    rejected = Hypothesis(40, Candidate(1, 5, 0.4), MEASUREMENTS, RejectReason.NO_POSE)
    recorder.record(make_frame(1), detection(1, []))
    recorder.record(make_frame(2), detection(2, [rejected, rejected]))
    recorder.record(make_frame(60), detection(60, [accepted(60, 2), accepted(60, 3), rejected]))
    summary = recorder.summary({})
    assert (summary["keyframes"], summary["queries"]) == (3, 2)
    assert (summary["closures_published"], summary["closures_rejected"]) == (2, 3)


@pytest.mark.parametrize("content", ["", "[1, 2]", '{"frames": 3}', '{"closures_published": '])
def test_a_foreign_summary_is_one_clear_line(tmp_path: Path, content: str) -> None:
    (tmp_path / "summary.json").write_text(content)
    with pytest.raises(UmfError, match=r"summary\.json is not a summary of a run"):
        read_summary(tmp_path)


def test_the_summary_can_be_written_while_the_run_goes_on_in_another_thread(tmp_path: Path) -> None:
    """The live node's timer writes it while the worker records."""
    recorder = RunRecorder(tmp_path, Settings(), "w")
    errors: list[Exception] = []

    def record() -> None:
        try:
            for count in range(1500):
                recorder.record(make_frame(count), detection(count, []))
        except Exception as error:
            errors.append(error)

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)  # threads take turns as often as they can
    try:
        worker = threading.Thread(target=record)
        worker.start()
        while worker.is_alive():
            recorder.summary({})
    finally:
        sys.setswitchinterval(interval)
    assert errors == [] and recorder.summary({})["keyframes"] == 1500


def lines(path: Path) -> list[str]:
    return path.read_text(encoding="utf-8").splitlines()


def test_a_folder_with_results_is_continued(tmp_path: Path) -> None:
    record_a_little(tmp_path).close()
    before = {name: lines(tmp_path / f"{name}.csv") for name in ("closures", "candidates", "keyframes", "inliers")}
    again = RunRecorder(tmp_path, Settings(), "w")
    assert [again.summary({})[key] for key in COUNTS] == [3, 1, 2, 1, 1, 1]
    again.record(make_frame(40), detection(40, [accepted(40, 2)]))  # played again: there already
    again.record(make_frame(90), detection(90, [accepted(90, 2)]))
    again.close()
    for name, rows in before.items():
        now = lines(tmp_path / f"{name}.csv")
        assert now[: len(rows)] == rows and len(now) == len(rows) + (2 if name == "inliers" else 1)
    assert again.summary({})["closures_published"] == 2 and again.summary({})["frames"] == 5


def test_a_keyframe_is_written_completely_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recorder = record_a_little(tmp_path)
    monkeypatch.setattr(recorder_module, "inlier_rows", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        recorder.record(make_frame(90), detection(90, [accepted(90, 2)]))
    recorder.close()
    assert [line.split(",")[0] for line in lines(tmp_path / "keyframes.csv")[1:]] == ["2000000000", "40000000000"]
    assert [closure.query_stamp_ns for closure in read_closures(tmp_path / "closures.csv")] == [40]


def test_a_second_process_may_not_write_the_same_folder(tmp_path: Path) -> None:
    recorder = record_a_little(tmp_path)
    with pytest.raises(UmfError, match=r"run\.sqlite is in use by another process"):
        RunRecorder(tmp_path, Settings(), "w")
    recorder.close()


def test_tables_of_an_older_release_are_set_aside(tmp_path: Path) -> None:
    (tmp_path / "closures.csv").write_text("a,b\n1,2\n")
    record_a_little(tmp_path).close()
    assert (tmp_path / "closures.1.csv").read_text() == "a,b\n1,2\n"
    assert len(read_closures(tmp_path / "closures.csv")) == 1


def test_descriptors_come_back_by_stamp(tmp_path: Path) -> None:
    record_a_little(tmp_path).close()
    found = read_descriptors(tmp_path)
    assert list(found) == [2 * 10**9, 40 * 10**9] and found[40 * 10**9].dtype == np.float32
    np.testing.assert_allclose(found[40 * 10**9], make_keyframe(40, 40).embedding.descriptor, atol=2e-3)


def test_nothing_but_the_file_of_the_run_and_its_exports_is_left(tmp_path: Path) -> None:
    record_a_little(tmp_path).close()
    read_descriptors(tmp_path)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {f"{name}.csv" for name in ALWAYS} | {"run.sqlite", "config.yaml"}


@pytest.mark.parametrize("width", [200, 900])
def test_a_keyframe_keeps_a_reduced_image_and_its_scan(tmp_path: Path, width: int) -> None:
    image = np.tile(np.linspace(0, 255, width).astype(np.uint8), (width // 2, 1))
    points = np.random.default_rng(0).uniform(-30, 30, (5000, 3)).astype(np.float32)
    found = detection(5, [])
    assert found.keyframe is not None
    recorder = RunRecorder(tmp_path, Settings(), "w")
    recorder.record(replace(make_frame(5), left=image), replace(found, keyframe=replace(found.keyframe, points=points)))
    recorder.close()
    with closing(RunFile(tmp_path, read_only=True)) as file:
        (picture,) = file.pictures()
    assert (picture.stamp_ns, picture.width, picture.height) == (5 * 10**9, width, width // 2)
    reduced = cv2.imdecode(np.frombuffer(picture.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert reduced is not None and reduced.shape == (min(width, 320) // 2, min(width, 320))
    assert (
        abs(float(reduced.mean()) - float(image.mean())) < 3 and reduced[:, -1].mean() > 240 > 15 > reduced[:, 0].mean()
    )
    assert len(picture.scan) == 3000 and len(picture.jpeg) < 20_000
    np.testing.assert_allclose(picture.scan[[0, -1]] * SCAN_UNIT_M, points[[0, -1]], atol=SCAN_UNIT_M)
