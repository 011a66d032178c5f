"""The odometry of a recording in a map: kept in the file of its run, and fed to the joint graph."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from umf_ros.core.config import PoseGraphSettings, Settings
from umf_ros.core.errors import UmfError
from umf_ros.core.geometry import make_pose
from umf_ros.durable_graph import feed
from umf_ros.maps.map_folder import MapFolder
from umf_ros.pose_graph.backend import PoseGraph
from umf_ros.runs.run_file import RunFile
from umf_ros.sensors.decode import OdometrySample

SECOND_NS = 10**9


def at(x: float) -> np.ndarray:
    return make_pose(np.eye(3), [x, 0, 0])


def messages(*positions: float) -> list[OdometrySample]:
    return [OdometrySample(row * SECOND_NS, at(x)) for row, x in enumerate(positions)]


@pytest.fixture
def folder(tmp_path: Path) -> MapFolder:
    folder = MapFolder.open_or_create(tmp_path / "map", Settings())
    folder.folder_of("a").mkdir(parents=True)
    return folder


def test_odometry_is_read_back_as_it_was(folder: MapFolder) -> None:
    put = messages(0, 1, 2, 3)
    with closing(RunFile(folder.folder_of("a"))) as file:
        for one in put:
            file.append_odometry(one)
    got, _ = folder.inputs_of("a")
    assert [one.stamp_ns for one in got] == [one.stamp_ns for one in put]
    for ours, theirs in zip(got, put, strict=True):
        np.testing.assert_array_equal(ours.odom_T_body, theirs.odom_T_body)


def test_estimates_of_an_earlier_release_are_refused(folder: MapFolder) -> None:
    run = folder.folder_of("a")
    with closing(RunFile(run)) as file:
        file.append_odometry(messages(0)[0])
    with closing(sqlite3.connect(run / "run.sqlite")) as connection, connection:
        connection.execute("UPDATE odometry SET covariance = zeroblob(288)")
    with pytest.raises(UmfError, match="only estimates between keyframes: map it again"):
        folder.inputs_of("a")


def test_a_graph_gets_it_on_another_clock_and_in_its_sessions() -> None:
    graph = PoseGraph(PoseGraphSettings())
    later = (one._replace(stamp_ns=one.stamp_ns + 70 * SECOND_NS) for one in messages(0, 1, 2, 500, 501, 502, 503))
    assert feed(graph, later)  # it jumps: the rover was carried
    assert graph.session_spans() == [(70 * SECOND_NS, 72 * SECOND_NS), (73 * SECOND_NS, 76 * SECOND_NS)]


def test_a_session_without_its_run_is_refused(folder: MapFolder) -> None:
    with pytest.raises(UmfError, match=r"there is no run .*run\.sqlite"):
        folder.inputs_of("a")
