"""Closures of each sensor, by stretches of a drive."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from command_line import only_line, umf
from finished_runs import closure, examined, stamp, trajectory

from umf_ros.core.errors import UmfError
from umf_ros.lab.evaluation.sensors_run import Stretch, describe_sensors, score, stretches_of, table_of
from umf_ros.sensors.motion_check import Disagreement
from umf_ros.sensors.sensor_check import Overlay, SensorReport

EARLY, LATE = Stretch("early", stamp(40), stamp(59.5)), Stretch("late", stamp(59.6), stamp(80))


def test_revisits_and_closures_are_counted_where_they_were(tmp_path: Path) -> None:
    about = examined(
        tmp_path, closures=[closure(50, 10), closure(54, 14), closure(70, 30, error_m=3.0)], truth=trajectory()
    )
    found = score(about, [EARLY, LATE, Stretch("all", 0, stamp(1000))])
    assert (found["early"].true, found["early"].false, found["early"].closed) == (2, 0, 2)
    assert (found["late"].true, found["late"].false, found["late"].closed) == (0, 1, 0)
    assert [found[name].revisits for name in ("early", "late", "all")] == [10, 10, 20]
    head, rows = table_of({"both": found, "LiDAR alone": found})
    assert len(rows) == 6 and rows[0][:2] == ["early", "both"] and rows[1][0] == "" and len(head) == len(rows[0])


def test_without_a_truth_nothing_is_judged(tmp_path: Path) -> None:
    about = examined(tmp_path, closures=[closure(50, 10)])
    with pytest.raises(UmfError, match="no ground truth"):
        score(replace(about, run=replace(about.run, truth=None)), [EARLY])


def test_what_was_not_measured_is_not_called_right() -> None:
    assert describe_sensors(SensorReport()) == ["could not be measured: light, clocks, mountings, baseline"]
    seen = SensorReport(left_contrast=40.0, lidar=Disagreement(0.0, None))
    unknown = "could not be measured: mountings, baseline"
    assert describe_sensors(seen) == ["nothing is wrong with light, clocks", unknown]
    late = replace(seen, lidar=Disagreement(0.5, None))
    told, *rest = describe_sensors(late)
    assert "the LiDAR's clock" in told and rest == [unknown]


def test_the_measurements_of_a_run_are_kept_in_its_summary() -> None:
    lidar = Disagreement(None, np.array([1.0, -2.0, 0.5]), mirrored=None, impossible=True)
    overlay = Overlay(np.array([0.1, 0.2, 0.3]), 1.01, 0.002, np.array([0.2, 0.01, 0.003]))
    mountings = {"lidar": np.eye(3)}
    for one in (SensorReport(), SensorReport(20.0, overlay=overlay, lidar=lidar, mountings=mountings)):
        again = SensorReport.from_json(json.loads(json.dumps(one.as_json(), allow_nan=False)))
        np.testing.assert_equal(asdict(again), asdict(one))
        assert describe_sensors(again) == describe_sensors(one)


def test_one_recording_is_replayed_with_both_sensors_and_with_each(
    mini_bag: Path, mini_config: Path, tmp_path: Path
) -> None:
    ended = umf("sensors", mini_bag, "--config", mini_config, "--out", tmp_path, "--workers", "1")
    assert ended.status == 0 and "camera alone" in ended.text
    figures = json.loads((tmp_path / "latest" / "sensors.json").read_text())
    assert set(figures) == {"both", "LiDAR alone", "camera alone"}
    assert all(one["all"]["revisits"] > 5 and one["all"]["false"] == 0 for one in figures.values())
    assert figures["both"]["all"]["closed"] > 5
    assert [one.name for one in stretches_of(mini_bag)] == ["all"]


def test_a_recording_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    assert "no recording" in only_line(umf("sensors", tmp_path / "nowhere.mcap"))
