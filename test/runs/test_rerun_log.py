"""The recording for the Rerun viewer: written by the real package, read back by it."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.accuracy.postgres import free_port
from umf_ros.absolute.measurement import AbsoluteReason, AbsoluteVerdict, Aid, write_verdicts
from umf_ros.core.config import TerrainSettings, Verification
from umf_ros.core.errors import ConfigError, OutputError
from umf_ros.core.frames import Candidate, Frame, Keyframe, State
from umf_ros.core.io import write_table
from umf_ros.detector import Detection
from umf_ros.lab.simulation.scenes import landscape, pose_at, take
from umf_ros.runs import rerun_log
from umf_ros.runs.rerun_log import RerunLog
from umf_ros.runs.run_file import CLOSURES
from umf_ros.verification import Verifier

pytest.importorskip("rerun")
GROUND, RERUN = landscape(20), str(Path(sys.executable).with_name("rerun"))


def seen(keyframe: Keyframe) -> Frame:
    image = np.full((48, 64), 90, np.uint8)
    return Frame(keyframe.stamp_ns, keyframe.camera, keyframe.body_T_camera, keyframe.body_T_lidar, left=image)


def run(path: Path | None, folder: Path) -> None:
    there, here = pose_at(GROUND, -15.0, 0.0, 0.0), pose_at(GROUND, -14.0, 1.2, 6.0)
    first, again = take(GROUND, there, 10.0, odom=there), take(GROUND, here, 100.0, odom=here)
    verdicts = Verifier(Verification()).verify(again, [(Candidate(0, first.stamp_ns, 0.7), first)])
    assert verdicts[0].closure is not None
    write_table(folder / "closures.csv", CLOSURES, [])
    log = RerunLog(path, TerrainSettings())
    for item, detection in zip(
        log.watch([seen(first), seen(again)]),
        [Detection(first.stamp_ns, first), Detection(again.stamp_ns, again, verdicts)],
        strict=True,
    ):
        assert isinstance(item, Frame)
        log.show(detection)
    log.finish(folder)


def logged(path: Path) -> set[str]:
    printed = subprocess.run([RERUN, "rrd", "print", "-v", path], capture_output=True, text=True, check=True).stdout
    return set(re.findall(r"(/[\w/]+)", printed))


def test_what_was_seen_and_found_is_in_the_file(tmp_path: Path) -> None:
    (tmp_path / "trajectory_odometry.tum").write_text("10.0 0 0 0 0 0 0 1\n100.0 1 0 0 0 0 0 1\n")
    run(tmp_path / "run.rrd", tmp_path)
    assert subprocess.run([RERUN, "rrd", "verify", tmp_path / "run.rrd"]).returncode == 0
    found = logged(tmp_path / "run.rrd")
    assert {"/camera/left", "/rover", "/rover/scan", "/trajectory/odometry"} <= found
    assert sum(name.startswith("/closures/") for name in found) == 1
    assert "/trajectory/optimized" not in found  # the run has none


def test_the_map_and_verdicts_by_state_are_in_the_file(tmp_path: Path) -> None:
    (tmp_path / "trajectory_optimized.tum").write_text("10.0 -15 0 0 0 0 0 1\n11.0 -14 0 0 0 0 0 1\n")
    write_verdicts(
        tmp_path / "absolute_verdicts.csv",
        [AbsoluteVerdict(Aid.GNSS, 10 * 10**9, State.REJECTED, AbsoluteReason.CONTRADICTS, 9.0, 20.0)],
    )
    run(tmp_path / "run.rrd", tmp_path)
    found = logged(tmp_path / "run.rrd")
    assert {"/map/cloud", "/map/grid", "/map/closures/accepted", "/map/absolute/rejected"} <= found


def test_a_viewer_that_listens_shows_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "trajectory_optimized.tum").write_text("10.0 -15 0 0 0 0 0 1\n11.0 -14 0 0 0 0 0 1\n")
    monkeypatch.setattr(rerun_log, "PORT", free_port())
    command = [RERUN, "--save", str(tmp_path / "seen.rrd"), "--port", str(rerun_log.PORT)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as receiver:
        assert receiver.stderr and any("Saving incoming" in line for line in iter(receiver.stderr.readline, ""))
        run(None, tmp_path)  # the receiver stands for a viewer, without a window
        seen = (logged(tmp_path / "seen.rrd") for _ in range(100))  # it writes in a thread
        assert any({"/camera/left", "/rover/scan", "/trajectory/optimized", "/map/cloud"} <= one for one in seen)
        receiver.terminate()


def test_without_a_viewer_and_a_display_one_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rerun_log, "PORT", free_port())
    monkeypatch.setattr("os.environ", {})
    with pytest.raises(ConfigError, match=r"no display, .*--rerun FILE"):
        RerunLog(None, TerrainSettings())


@pytest.mark.parametrize(("path", "option"), [("run.rrd", "--rerun"), (None, "--viewer")])
def test_without_the_package_one_line_says_what_to_install(
    path: str | None, option: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ConfigError, match=rf"{option} needs .*pip install 'umf_ros\[rerun\]'"):
        RerunLog(tmp_path / path if path else None, TerrainSettings())


def test_a_file_that_cannot_be_written_is_told_before_the_run(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot write"):
        RerunLog(tmp_path / "nowhere" / "run.rrd", TerrainSettings())
