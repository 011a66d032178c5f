"""Absolute measurements of recordings, and in the file of a run."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from recordings import START_NS, small_settings, traverse, write_mcap

from umf_ros.absolute.measurement import AbsoluteMeasurement, Aid
from umf_ros.bags.frames import FrameReader
from umf_ros.bags.reader import open_bag
from umf_ros.core.config import AbsoluteTopics, Settings
from umf_ros.core.errors import BagError
from umf_ros.core.frames import Frame
from umf_ros.durable_graph import feed
from umf_ros.lab.simulation.bag_writer import fix_message, imu_message
from umf_ros.pose_graph.backend import PoseGraph
from umf_ros.runs.run_file import RunFile
from umf_ros.sensors.decode import OdometrySample

PLACE = np.array([37.72, 15.0, 2550.0])
ENTRIES = sorted(
    [
        *traverse(3.0),
        *(("/gnss/fix", at, fix_message(PLACE, 0.5, at)) for at in range(START_NS, START_NS + 3 * 10**9, 500_000_000)),
        *(
            ("/imu/data", at, imu_message(np.zeros(3), np.array([0.0, 0.0, 9.81]), at))
            for at in range(START_NS, START_NS + 3 * 10**9, 20_000_000)
        ),
    ],
    key=lambda entry: entry[1],
)


def with_topics(tmp_path: Path, **topics: str) -> Settings:
    return small_settings(tmp_path).model_copy(update={"absolute": AbsoluteTopics(**topics)})


def test_a_recording_gives_fixes_and_gravity_where_they_are_named(tmp_path: Path) -> None:
    bag, told = open_bag(write_mcap(tmp_path / "a.mcap", ENTRIES)), list[str]()
    reader = FrameReader(bag, with_topics(tmp_path, gnss="/gnss/fix", imu="/imu/data"), warn=told.append)
    found = [item for item in reader.stream() if isinstance(item, AbsoluteMeasurement)]
    assert [one.stamp_ns for one in found if one.source is Aid.GNSS] == [START_NS + k * 500_000_000 for k in range(6)]
    up = [one.value for one in found if one.source is Aid.GRAVITY]
    assert 2 <= len(up) <= 3 and np.allclose(np.linalg.norm(up, axis=1), 1) and not told
    off = FrameReader(bag, small_settings(tmp_path))
    assert not any(isinstance(item, AbsoluteMeasurement) for item in off.stream())


def test_a_receiver_without_a_fix_is_told_once(tmp_path: Path) -> None:
    lost = [fix_message(PLACE, 0.5, START_NS + k) for k in range(5)]
    for message in lost:
        message.status.status = -1
    entries = [*traverse(1.0), *(("/gnss/fix", START_NS + k, message) for k, message in enumerate(lost))]
    bag, told = open_bag(write_mcap(tmp_path / "a.mcap", entries)), list[str]()
    list(FrameReader(bag, with_topics(tmp_path, gnss="/gnss/fix"), warn=told.append).stream())
    assert told == ["/gnss/fix: the GNSS receiver has no fix; such messages are skipped"]


def test_a_message_that_breaks_the_decoder_costs_itself_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("of a message")

    monkeypatch.setattr("umf_ros.absolute.measurement.decode_fix", broken)
    bag, told = open_bag(write_mcap(tmp_path / "a.mcap", ENTRIES)), list[str]()
    reader = FrameReader(bag, with_topics(tmp_path, gnss="/gnss/fix"), warn=told.append)
    assert any(isinstance(item, Frame) for item in reader.stream())
    assert told == ["/gnss/fix: message raises ZeroDivisionError: of a message; such messages are skipped"]


def test_a_topic_that_is_not_there_is_one_line_with_the_others(tmp_path: Path) -> None:
    bag = open_bag(write_mcap(tmp_path / "a.mcap", ENTRIES))
    with pytest.raises(BagError, match=r"no sensor_msgs/msg/NavSatFix on /fix \(topics of that type: /gnss/fix\)"):
        FrameReader(bag, with_topics(tmp_path, gnss="/fix"))


def test_the_file_of_a_run_feeds_a_graph_with_them_in_order(tmp_path: Path) -> None:
    fix = AbsoluteMeasurement(Aid.GNSS, START_NS + 1, PLACE, np.eye(3), np.zeros(3))
    with closing(RunFile(tmp_path)) as file:
        for number in range(4):
            if number == 2:
                file.append_absolute(fix)
                file.append_absolute(fix)  # as when a recording is played again
            file.append_odometry(OdometrySample(START_NS + number * 10**9, np.eye(4)))
        with file.writing():
            pass
        inputs = list(file.graph_inputs())
    assert [isinstance(item, AbsoluteMeasurement) for item in inputs] == [False, False, True, False, False]
    graph = PoseGraph()
    assert feed(graph, inputs)
    graph.update()
    assert [one.stamp_ns for one in graph.reference.verdicts()] == [fix.stamp_ns]
