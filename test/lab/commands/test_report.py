"""`umf report` on a run folder: judged, drawn, one page that stands alone, and what happens when a file is damaged."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_line import Ended, only_line, umf
from conftest import make_keyframe
from recordings import CLOUD, LEFT, START_NS, TRUTH, drive, small_settings, traverse, write_mcap
from sources import rows_of as csv_rows

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.reader import open_bag
from umf_ros.core.frames import Candidate, Frame, LoopClosure
from umf_ros.core.geometry import Array, make_pose, relative
from umf_ros.core.trajectory import Trajectory, write_tum
from umf_ros.detector import Detection
from umf_ros.runs.reader import remember_recording
from umf_ros.runs.writer import RunRecorder
from umf_ros.verification import Hypothesis, RejectReason, thin_scan

LATENCY = {"embed": 30.0, "query": 1.0, "verify": 9.0, "total": 40.0}
PIXELS = np.array([[10, 12, 50, 30], [40, 20, 20, 41]], np.float32)


def verdict(query: Frame, match: Frame, error_m: float, probability: float) -> Hypothesis:
    """A closure between two frames that is wrong by so much, sideways."""
    poses = [drive((frame.stamp_ns - START_NS) * 1e-9) for frame in (match, query)]
    pose = relative(*poses) @ make_pose(np.eye(3), [0, error_m, 0])
    closure = LoopClosure(query.stamp_ns, match.stamp_ns, pose, np.eye(6) * 0.01, probability)
    return Hypothesis(
        query.stamp_ns, Candidate(0, match.stamp_ns, 0.8), {"similarity": 0.8}, closure=closure, inlier_pixels=PIXELS
    )


def record_run(folder: Path, bag: Path, settings_folder: Path) -> list[Frame]:
    """A run with two true closures and a false one, written as the replay writes it."""
    folder.mkdir()
    settings = small_settings(settings_folder, loop__min_time_gap_s=1.0, loop__min_travel_m=0.5)
    frames = list(FrameReader(open_bag(bag), settings))
    recorder = RunRecorder(folder, settings, "weights <v1>")
    closures = {10: verdict(frames[10], frames[5], 0.1, 0.99), 11: verdict(frames[11], frames[6], 0.3, 0.95)}
    closures[12] = verdict(frames[12], frames[7], 0.8, 0.9123)
    for i, frame in enumerate(frames):
        keyframe = replace(make_keyframe(0, 0.2 * i), stamp_ns=frame.stamp_ns, points=thin_scan(frame.points))
        rejected = Hypothesis(
            frames[0].stamp_ns, Candidate(1, frames[0].stamp_ns, 0.1), {"similarity": 0.1}, RejectReason.NO_POSE
        )
        found = [closures[i], rejected] if i in closures else []
        recorder.record(frame, Detection(frame.stamp_ns, keyframe, found, LATENCY))
    recorder.write_summary({"image": 1, "cloud": 0, "odometry": 0, "worker": 0})
    recorder.close()
    stamps = np.array([frame.stamp_ns for frame in frames], np.int64)
    truth = np.stack([drive(second) for second in (stamps - START_NS) * 1e-9])
    write_tum(folder / "trajectory_optimized.tum", Trajectory(stamps, truth))
    write_tum(folder / "trajectory_odometry.tum", Trajectory(stamps, drifted(truth)))
    return frames


def drifted(poses: Array) -> Array:
    """The same drive, a tenth too long."""
    longer = poses.copy()
    longer[:, :3, 3] *= 1.1
    return longer


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_mcap(tmp_path_factory.mktemp("bag") / "drive.mcap", traverse(4.0))


@pytest.fixture
def run(bag: Path, tmp_path: Path) -> Path:
    record_run(tmp_path / "run", bag, tmp_path)
    return tmp_path / "run"


def scene_of(run: Path) -> dict[str, Any]:
    """The data that the page draws."""
    page = (run / "report.html").read_text(encoding="utf-8")
    found = re.search(r'<script type="application/json" id="scene">(.*?)</script>', page, re.S)
    assert found
    content: dict[str, Any] = json.loads(found[1])
    return content


def rows_of(run: Path) -> list[list[str]]:
    """The cells of the table of closures."""
    page = (run / "report.html").read_text(encoding="utf-8")
    table = page[page.index('<table class="closures">') :]
    rows = re.findall(r"<tr>(.*?)</tr>", table[: table.index("</table>")], re.S)
    return [[re.sub("<.*?>", "", cell) for cell in re.findall(r"<td[^>]*>(.*?)</td>", row)] for row in rows[1:]]


def report(run: Path, bag: Path, *more: str | Path) -> Ended:
    ended = umf("report", run, bag, *more)
    assert ended.status == 0, ended.text
    return ended


def test_closures_are_judged_by_the_truth_of_the_recording(run: Path, bag: Path) -> None:
    ended = report(run, bag)
    found = json.loads((run / "summary.json").read_text())["ground_truth"]
    assert (found["closures_true"], found["closures_false"]) == (2, 1)
    assert found["ate_optimized_m"] == pytest.approx(0, abs=1e-3) and found["ate_odometry_m"] > 0.02
    # 18 scans; the first five are less than a second old when they look back
    assert found["revisits"] == 13
    assert found["nees_median"] > 0 and 0 <= found["inside_95"] <= 1 and "stated errors" in ended.text
    assert "warning: scans have 200 returns in the median" in ended.text  # the recording is read for the check
    assert "2 true and 1 false loop closures" in ended.text and f"Report: {run}/report.html" in ended.out


def test_sensors_that_the_replay_checked_are_not_checked_again(run: Path, bag: Path) -> None:
    path = run / "summary.json"
    summary = json.loads(path.read_text())
    path.write_text(json.dumps(summary | {"sensors": {"left_contrast": 5.0}}))
    report(run, bag)
    assert "the left images have little contrast" in (run / "report.html").read_text(encoding="utf-8")
    path.write_text(json.dumps(summary | {"sensors": {"contrast": 2.0}}))
    assert f"{path} is damaged" in only_line(umf("report", run, bag))


def test_the_page_shows_every_closure_with_pictures_scans_and_errors(run: Path, bag: Path, tmp_path: Path) -> None:
    report(run, bag)
    scene = scene_of(run)
    images = {frame.stamp_ns: frame.left for frame in FrameReader(open_bag(bag), small_settings(tmp_path))}
    written = [[row["query_stamp_ns"], row["match_stamp_ns"]] for row in csv_rows(run / "closures.csv")]
    pairs = [pair for pair in scene["pairs"] if pair["number"]]
    assert [pair["stamps"] for pair in pairs] == written
    assert [pair["kind"] for pair in pairs] == ["accepted", "accepted", "false"]
    for stamp in {stamp for pair in pairs for stamp in pair["stamps"]}:
        address, width, height = scene["photographs"][stamp]
        jpeg = np.frombuffer(base64.b64decode(address.partition(",")[2]), np.uint8)
        image, shown = images[int(stamp)], cv2.imdecode(jpeg, cv2.IMREAD_GRAYSCALE)
        assert image is not None and image.shape == (height, width) == shown.shape == (48, 64)
        assert np.abs(shown.astype(int) - image).mean() < 0.3 * image.std()  # reduced for the run's file
        scan = np.frombuffer(base64.b64decode(scene["scans"][stamp]), "<i2").reshape(-1, 3) * scene["scan_unit_m"]
        assert 10 < len(scan) <= 600 and 2 < np.linalg.norm(scan, axis=1).mean() < 25
    assert [pair["inliers"] for pair in pairs] == [PIXELS.astype(int).tolist()] * 3
    np.testing.assert_allclose(np.array(pairs[0]["pose"]).reshape(3, 4)[:, :3] @ np.eye(3), np.eye(3), atol=0.4)
    assert max(scene["errors"]["optimised"][1]) < 0.01 < max(scene["errors"]["odometry"][1])
    count = len(scene["keyframes"]["t"])
    assert count == 18 == len(scene["keyframes"]["xy"]) and scene["keyframes"]["latency"][3] == 40
    assert len(base64.b64decode(scene["similarity"]["data"])) == count**2
    assert scene["map"]["lower"][0] < scene["map"]["upper"][0]


def test_the_table_lists_every_closure_with_its_errors(run: Path, bag: Path) -> None:
    report(run, bag)
    rows = rows_of(run)
    assert [row[0] for row in rows] == ["1", "2", "3"] and [row[10] for row in rows] == ["yes", "yes", "NO"]
    assert [float(row[7]) for row in rows] == pytest.approx([0.1, 0.3, 0.8], abs=2e-3)
    assert [row[5] for row in rows] == ["0.9900", "0.9500", "0.9123"]


def test_reporting_twice_gives_the_same(run: Path, bag: Path) -> None:
    report(run, bag)
    first = (run / "report.html").read_bytes(), (run / "summary.json").read_bytes()
    report(run, bag)
    assert ((run / "report.html").read_bytes(), (run / "summary.json").read_bytes()) == first


def test_without_a_truth_nothing_is_judged(bag: Path, tmp_path: Path) -> None:
    record_run(tmp_path / "run", bag, tmp_path)
    blind = write_mcap(tmp_path / "blind.mcap", [entry for entry in traverse(4.0) if entry[0] != TRUTH])
    ended = report(tmp_path / "run", blind)
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["ground_truth"] is None
    assert "3 loop closures; there is no ground truth to judge them by." in ended.text
    assert [row[7:] for row in rows_of(tmp_path / "run")] == [["", "", "", ""]] * 3


def test_a_truth_file_goes_before_that_of_the_recording(run: Path, bag: Path, tmp_path: Path) -> None:
    seconds = np.arange(0, 4, 0.1)
    stamps = START_NS + np.round(seconds * 1e9).astype(np.int64)
    # a truth in which the rover stands: no closure has the right pose
    write_tum(tmp_path / "other.tum", Trajectory(stamps, np.tile(np.eye(4), (len(stamps), 1, 1))))
    for more in (["--ground-truth", tmp_path / "other.tum"], []):  # and later ones know it
        report(run, bag, *more)
        found = json.loads((run / "summary.json").read_text())["ground_truth"]
        assert (found["closures_true"], found["closures_false"]) == (0, 3)


def test_closures_outside_of_the_truth_are_not_judged(run: Path, bag: Path, tmp_path: Path) -> None:
    seconds = np.arange(0, 2.55, 0.05)
    stamps = START_NS + np.round(seconds * 1e9).astype(np.int64)
    write_tum(tmp_path / "short.tum", Trajectory(stamps, np.stack([drive(second) for second in seconds])))
    report(run, bag, "--ground-truth", tmp_path / "short.tum")
    found = json.loads((run / "summary.json").read_text())["ground_truth"]
    assert (found["closures_true"], found["closures_false"]) == (2, 0)
    assert [row[10] for row in rows_of(run)] == ["yes", "yes", ""]


def test_without_images_there_are_no_photographs(tmp_path: Path) -> None:
    dark = write_mcap(tmp_path / "dark.mcap", [entry for entry in traverse(4.0) if entry[0] in (CLOUD, TRUTH)])
    record_run(tmp_path / "run", dark, tmp_path)
    report(tmp_path / "run", dark)
    assert scene_of(tmp_path / "run")["photographs"] == {}


def test_a_run_without_closures_and_trajectories(bag: Path, tmp_path: Path) -> None:
    settings = small_settings(tmp_path)
    (tmp_path / "run").mkdir()
    recorder = RunRecorder(tmp_path / "run", settings, "weights")
    recorder.write_summary({})
    recorder.close()
    ended = report(tmp_path / "run", bag)
    assert "0 true and 0 false loop closures" in ended.text
    assert re.search("latency", ended.text) is None  # nothing was measured


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("summary.json", '{"frames": 3, ', "summary.json is not a summary of a run"),
        ("summary.json", "[]", "summary.json is not a summary of a run"),
        ("summary.json", '{"hello": 1}', "summary.json is not a summary of a run"),
        ("closures.csv", None, "cannot read"),
        ("closures.csv", "query_stamp_ns,match_stamp_ns\n1,2\n", "closures.csv, line 2: not a row of this table"),
        ("keyframes.csv", "stamp_ns,session,travelled_m\n5,0,1.5\n6,0\n", "keyframes.csv, line 3: not a row"),
        ("inliers.csv", "query_stamp_ns,match_stamp_ns,query_u\nx,2,3\n", "inliers.csv, line 2: not a row"),
        ("config.yaml", "loop: {topk: 3}\n", "unknown parameter loop.topk"),
        ("trajectory_odometry.tum", "1.0 0 0\n", "trajectory_odometry.tum, line 1: expected 8 numbers"),
    ],
)
def test_a_damaged_run_is_one_clear_line(run: Path, bag: Path, name: str, content: str | None, message: str) -> None:
    (run / name).unlink()
    if content is not None:
        (run / name).write_text(content)
    assert message in only_line(umf("report", run, bag))
    assert not (run / "report.html").exists()


def test_names_with_brackets_are_kept(bag: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run [old]"
    record_run(folder, bag, tmp_path)
    assert f"Report: {folder}/report.html" in report(folder, bag).out


def test_another_recording_changes_nothing(run: Path, bag: Path, tmp_path: Path) -> None:
    report(run, bag)
    before = {path.name: path.read_bytes() for path in run.iterdir() if path.is_file()}
    later = traverse(0.5)
    for _, _, message in later:
        message.header.stamp.sec += 1000
    late = write_mcap(tmp_path / "late.mcap", [(topic, at + 10**12, message) for topic, at, message in later])
    line = only_line(umf("report", run, late))
    assert line.startswith(f"{run} was made on another recording than {late}: 18 of 18 keyframes are outside its time")
    assert {path.name: path.read_bytes() for path in run.iterdir() if path.is_file()} == before


def test_a_run_knows_its_recording_from_one_of_the_same_time(run: Path, bag: Path, tmp_path: Path) -> None:
    remember_recording(run, open_bag(bag))
    other = write_mcap(tmp_path / "other.mcap", [entry for entry in traverse(4.0) if entry[0] != LEFT])
    assert only_line(umf("report", run, other)) == (f"{run} was made on another recording, {bag}; nothing was written")
    report(run, bag)


@pytest.mark.parametrize("later_s", [365 * 86400, 37, -(START_NS // 10**9) + 100])
def test_a_recording_whose_times_of_recording_are_of_another_clock_is_judged(
    run: Path, tmp_path: Path, later_s: int
) -> None:
    """Recorded again a year later, stamped in TAI, or by a computer without a clock."""
    entries = [(topic, at + later_s * 10**9, message) for topic, at, message in traverse(4.0)]
    report(run, write_mcap(tmp_path / "again.mcap", entries))


def test_a_truth_of_another_clock_does_not_unjudge_a_run(run: Path, bag: Path, tmp_path: Path) -> None:
    report(run, bag)
    before = (run / "summary.json").read_bytes(), (run / "report.html").read_bytes()
    stamps = START_NS - 10**18 + np.arange(40, dtype=np.int64) * 10**8
    write_tum(tmp_path / "other.tum", Trajectory(stamps, np.tile(np.eye(4), (40, 1, 1))))
    line = only_line(umf("report", run, bag, "--ground-truth", tmp_path / "other.tum"))
    assert line.startswith("the ground truth has another clock: it covers none of the 18 keyframes")
    assert ((run / "summary.json").read_bytes(), (run / "report.html").read_bytes()) == before
