"""The odometry of a recording: its messages, or the poses of keyframes that were tracked where there are none."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.config import Verification
from umf_ros.core.errors import UmfError
from umf_ros.core.frames import Candidate, Keyframe
from umf_ros.core.geometry import Array
from umf_ros.core.io import atomic_write
from umf_ros.core.trajectory import Trajectory
from umf_ros.pose_graph.backend import PoseGraph
from umf_ros.sensors.decode import OdometrySample
from umf_ros.sensors.sessions import OdometrySessionSplitter
from umf_ros.verification import Verifier

NAME = "odometry.npz"
Item = TypeVar("Item")


class OdometryLog:
    """Odometry messages of a recording in the order of their arrival.

    Attributes:
        stamps: of each, ns.
        poses: (4, 4) `odom_T_body` of each.
        covariances: (6, 6) of the motion since the previous message, ROS order, axes of the previous body; empty, or
            one for every message.
        starts: rows of the messages without a motion since the previous one; only with covariances.
    """

    def __init__(self) -> None:
        self.stamps: list[int] = []
        self.poses: list[Array] = []
        self.covariances: list[Array] = []
        self.starts: list[int] = []

    def __len__(self) -> int:
        return len(self.stamps)

    def following(self, stream: Iterable[Item]) -> Iterator[Item]:
        """Pass on the stream of a recording unchanged, and log its odometry."""
        for item in stream:
            if isinstance(item, OdometrySample):
                self.stamps.append(item.stamp_ns)
                self.poses.append(item.odom_T_body)
            yield item

    def append(self, stamp_ns: int, pose: Array, covariance: Array | None) -> None:
        """Append a tracked pose; without a covariance it has no motion since the previous one."""
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
        """Add every message, its stamp shifted, to a graph whose newest session is empty."""
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
        """Write the log into a run folder.

        Raises:
            OutputError: the folder cannot be written.
        """
        arrays: dict[str, NDArray[np.float64] | NDArray[np.int64]] = {
            "stamps": np.array(self.stamps, np.int64),
            "poses": np.array(self.poses, float).reshape(-1, 4, 4),
            "covariances": np.array(self.covariances, float).reshape(-1, 6, 6),
            "starts": np.array(self.starts, np.int64),
        }
        with atomic_write(folder / NAME) as part, part.open("wb") as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]

    @classmethod
    def load(cls, folder: Path) -> OdometryLog:
        """Read the log of a run folder.

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


def track(keyframes: Iterable[Keyframe], settings: Verification) -> tuple[OdometryLog, list[Keyframe]]:
    """Track a recording without odometry by closures between consecutive keyframes.

    Where two consecutive keyframes have no closure, a new session begins, which other closures have to connect.

    Args:
        keyframes: of one recording, in order, without odometry.
        settings: of the verification of closures.

    Returns:
        The poses, and the keyframes with `odom_T_body`, `path_length_m` and `session`, which counts from 0.
    """
    log = OdometryLog()
    tracked: list[Keyframe] = []
    pose, path_m, session = np.eye(4), 0.0, 0
    for keyframe, found in _consecutive(keyframes, settings):
        if found is None:
            session += bool(tracked)
            pose, path_m, covariance = np.eye(4), 0.0, None
        else:
            step, covariance = found
            pose, path_m = pose @ step, path_m + float(np.linalg.norm(step[:3, 3]))
        log.append(keyframe.stamp_ns, pose, covariance)
        tracked.append(replace(keyframe, odom_T_body=pose, path_length_m=path_m, session=session))
    return log, tracked


def _consecutive(
    keyframes: Iterable[Keyframe], settings: Verification
) -> Iterator[tuple[Keyframe, tuple[Array, Array] | None]]:
    """Every keyframe with its pose in the previous one and the covariance, None where no closure was accepted."""
    before: Keyframe | None = None
    for keyframe in keyframes:
        found = None
        if before is not None:
            similarity = float(before.embedding.descriptor @ keyframe.embedding.descriptor)
            # a verifier that keeps earlier closures would need odometry between them
            verdicts = Verifier(settings).verify(keyframe, [(Candidate(0, before.stamp_ns, similarity), before)])
            closure = verdicts[0].closure
            found = None if closure is None else (closure.match_T_query, closure.covariance)
        yield keyframe, found
        before = keyframe
