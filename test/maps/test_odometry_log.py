from pathlib import Path

import numpy as np
import pytest

from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.errors import UmfError
from umf_ros.core.geometry import make_pose
from umf_ros.maps.odometry_log import OdometryLog
from umf_ros.pose_graph.backend import PoseGraph
from umf_ros.sensors.decode import OdometrySample

SECOND_NS = 10**9


def at(x: float) -> np.ndarray:
    return make_pose(np.eye(3), [x, 0, 0])


def heard(*positions: float) -> OdometryLog:
    log = OdometryLog()
    stream = [OdometrySample(row * SECOND_NS, at(x)) for row, x in enumerate(positions)]
    mixed = [stream[0], "a frame", *stream[1:]]
    assert list(log.following(mixed)) == mixed
    return log


def test_a_log_is_read_back_as_it_was(tmp_path: Path) -> None:
    log = heard(0, 1, 2, 3)
    log.save(tmp_path)
    again = OdometryLog.load(tmp_path)
    assert again.stamps == log.stamps and np.array_equal(again.poses, log.poses) and not again.covariances
    assert np.allclose(again.trajectory.at(np.array([1_500_000_000]))[0][0], at(1.5))


def test_a_graph_gets_it_on_another_clock_and_in_its_sessions() -> None:
    graph = PoseGraph(PoseGraphSettings())
    heard(0, 1, 2, 500, 501, 502).feed(graph, 70 * SECOND_NS)  # it jumps: the rover was carried
    assert graph.session_spans() == [(70 * SECOND_NS, 72 * SECOND_NS), (73 * SECOND_NS, 75 * SECOND_NS)]


def test_tracked_poses_keep_their_covariances_and_sessions(tmp_path: Path) -> None:
    log = OdometryLog()
    for stamp, x, covariance in ((0, 0, None), (1, 1, 0.01), (5, 0, None), (6, 1, 0.04)):
        log.append(stamp * SECOND_NS, at(x), None if covariance is None else covariance * np.eye(6))
    log.save(tmp_path)
    graph = PoseGraph(PoseGraphSettings())
    OdometryLog.load(tmp_path).feed(graph, 0)
    assert graph.session_spans() == [(0, SECOND_NS), (5 * SECOND_NS, 6 * SECOND_NS)]


def test_a_missing_log_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UmfError, match=r"odometry\.npz"):
        OdometryLog.load(tmp_path)
