"""The odometry of a recording, every message as it came, for the graphs that are built later."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.errors import UmfError, writing
from umf_ros.core.geometry import Array
from umf_ros.core.trajectory import Trajectory
from umf_ros.pose_graph.backend import PoseGraph
from umf_ros.sensors.decode import OdometrySample
from umf_ros.sensors.sessions import OdometrySessionSplitter

NAME = "odometry.npz"
Item = TypeVar("Item")


class OdometryLog:
    """Messages of one odometry in the order of their arrival.

    Attributes:
        stamps: of each, ns.
        poses: (4, 4) `odom_T_body` of each.
        covariances: (6, 6) of the motion since the one before, ROS order, axes of the body before; only where
            every message has one.
        starts: numbers of the messages that go on from nothing before; only with covariances.
    """

    def __init__(self) -> None:
        self.stamps: list[int] = []
        self.poses: list[Array] = []
        self.covariances: list[Array] = []
        self.starts: list[int] = []

    def __len__(self) -> int:
        return len(self.stamps)

    def following(self, stream: Iterable[Item]) -> Iterator[Item]:
        """The stream of a recording as it is, its odometry noted on the way."""
        for item in stream:
            if isinstance(item, OdometrySample):
                self.stamps.append(item.stamp_ns)
                self.poses.append(item.odom_T_body)
            yield item

    def append(self, stamp_ns: int, pose: Array, covariance: Array | None) -> None:
        """Note a pose that was found; without a covariance nothing joins it to the one before."""
        if covariance is None:
            self.starts.append(len(self))
        self.stamps.append(stamp_ns)
        self.poses.append(pose)
        self.covariances.append(np.eye(6) if covariance is None else covariance)

    @property
    def trajectory(self) -> Trajectory:
        """The poses in the order of their stamps."""
        stamps, first = np.unique(np.array(self.stamps, np.int64), return_index=True)
        return Trajectory(stamps, np.array(self.poses, float).reshape(-1, 4, 4)[first])

    def feed(self, graph: PoseGraph, shift_ns: int) -> None:
        """Give every message to a graph whose newest session is empty, on another clock."""
        if not self.covariances:
            feed = OdometrySessionSplitter(graph)
            for stamp, pose in zip(self.stamps, self.poses, strict=True):
                feed.take(stamp + shift_ns, pose)
            return
        starts = set(self.starts[1:])
        for row, (stamp, pose, covariance) in enumerate(zip(self.stamps, self.poses, self.covariances, strict=True)):
            if row in starts:
                graph.begin_session()
            known = None if row in starts or row == 0 else covariance
            graph.add_odometry(stamp + shift_ns, pose, known)

    def save(self, folder: Path) -> None:
        """Write it into a run folder.

        Raises:
            OutputError: the folder cannot be written.
        """
        arrays: dict[str, NDArray[np.float64] | NDArray[np.int64]] = {
            "stamps": np.array(self.stamps, np.int64),
            "poses": np.array(self.poses, float).reshape(-1, 4, 4),
            "covariances": np.array(self.covariances, float).reshape(-1, 6, 6),
            "starts": np.array(self.starts, np.int64),
        }
        with writing(folder / NAME), (folder / NAME).open("wb") as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]

    @classmethod
    def load(cls, folder: Path) -> OdometryLog:
        """Read it from a run folder.

        Raises:
            UmfError: it is missing or damaged.
        """
        log = cls()
        try:
            with np.load(folder / NAME) as stored:
                log.stamps, log.starts = stored["stamps"].tolist(), stored["starts"].tolist()
                log.poses, log.covariances = list(stored["poses"]), list(stored["covariances"])
        except (OSError, ValueError, KeyError) as error:
            raise UmfError(f"{folder / NAME} cannot be read: {error}") from None
        return log
