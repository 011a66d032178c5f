"""What a drive teaches about places without ground truth: where it was the same place, where surely not.

Poses are those of the pose graph. Two keyframes are one place where they are near in the map *and* something
measured says so: odometry between them is short, or a verified closure the graph accepted joins the two stretches of
the drive. They are different places where they are further apart in the map than it may be wrong; what is neither is
left out.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from umf_ros.core.config import Database, Settings
from umf_ros.core.errors import UmfError
from umf_ros.core.frames import Frame
from umf_ros.core.geometry import Array
from umf_ros.core.io import atomic_write
from umf_ros.core.trajectory import Trajectory
from umf_ros.detector import Detection, LoopDetector, make_detector_embedder
from umf_ros.embedding.inputs import read_frame
from umf_ros.embedding.torch_runtimes import to_tensors
from umf_ros.lab.datasets.sample import distances, places_of
from umf_ros.networks.umf import UMF
from umf_ros.pose_graph.backend import PoseGraph
from umf_ros.pose_graph.closures import State
from umf_ros.sensors.decode import OdometrySample
from umf_ros.sensors.sessions import OdometrySessionSplitter

Mask = NDArray[np.bool_]
SAME_M, SAME_DEG = 8.0, 25.0
"""Views nearer and less turned show the same place; the evaluation's rule is 12 m and 30 deg."""
OTHER_M, OTHER_DEG = 25.0, 60.0
"""Views further apart or more turned do not."""
VOUCHED_M = 10.0
"""Along the drive: how far from its ends a closure speaks for the map, and odometry for itself."""
DRIFT = 0.03
"""Of the distance to the nearest closure along the drive: how far the map may be wrong there."""
GAP_M = 15.0
"""Along the drive: nearer views of one drive are not asked for, as on the rover."""


@dataclass(frozen=True, slots=True)
class Drive:
    """The keyframes of one recording: what the network pools of them, and what the map says.

    Attributes:
        stamps_ns: (N,) int64.
        seen, felt: (N, C) what the heads see of image and scan; cells: (N, D) pooled maps of the scene.
        image_present, cloud_present: (N,) bool.
        map_T_body: (N, 4, 4) by the pose graph.
        path_length_m: (N,) along the drive.
        session: (N,) int; between sessions the odometry began anew.
        closures: (K, 2) keyframes that accepted closures join.
    """

    stamps_ns: NDArray[np.int64]
    seen: Array
    felt: Array
    cells: Array
    image_present: Mask
    cloud_present: Mask
    map_T_body: Array
    path_length_m: Array
    session: NDArray[np.int64]
    closures: NDArray[np.int64]

    def save(self, path: Path) -> None:
        """Write an `.npz` in one step."""
        with atomic_write(path) as part, part.open("wb") as stream:
            np.savez(stream, allow_pickle=False, **{one.name: getattr(self, one.name) for one in fields(self)})

    @classmethod
    def load(cls, path: Path) -> Drive:
        """Inverse of `save`."""
        with np.load(path) as stored:
            return cls(**{one.name: stored[one.name] for one in fields(cls)})


@dataclass(frozen=True, slots=True)
class Labels:
    """What is known of pairs of keyframes, (N, N), the first of a pair being asked for; what is neither is unknown."""

    same: Mask
    other: Mask

    @property
    def revisits(self) -> NDArray[np.int64]:
        """Keyframes that have been somewhere before, and could be mistaken."""
        return np.flatnonzero(self.same.any(axis=1) & self.other.any(axis=1))


def label_drive(drive: Drive) -> Labels:
    """What the map of a drive says of its pairs."""
    places = places_of(0, drive.map_T_body)
    metres, turn = distances(places, places)
    along = _along(drive)
    slack = DRIFT * _to_closure(drive, along)
    near = along < VOUCHED_M
    joined = near[:, drive.closures.ravel()]
    first, second = joined[:, 0::2].astype(np.float32), joined[:, 1::2].astype(np.float32)
    vouched = (first @ second.T + second @ first.T) > 0
    apart = along > GAP_M
    same = (metres < SAME_M) & (turn < np.radians(SAME_DEG)) & vouched & apart
    far = metres - slack[:, None] - slack[None] > OTHER_M
    return Labels(same, (far | (turn > np.radians(OTHER_DEG))) & apart)


def _along(drive: Drive) -> Array:
    """(N, N) metres between keyframes along the drive, infinite between sessions."""
    metres = np.abs(drive.path_length_m[:, None] - drive.path_length_m[None])
    return np.where(drive.session[:, None] == drive.session[None], metres, np.inf)


def _to_closure(drive: Drive, along: Array) -> Array:
    """(N,) metres along the drive to the nearest keyframe that a closure holds, infinite without any."""
    return along[:, drive.closures.ravel()].min(axis=1, initial=np.inf)


class DriveReader:
    """Has the detector and the pose graph go through a recording, and keeps what the network pools of its keyframes.

    Args:
        network: whose heads are to be fitted, with a scene.
        settings: of the recording; their embedder has the same weights.
    """

    def __init__(self, network: UMF, settings: Settings) -> None:
        self._network = network
        own = settings.model_copy(update={"database": Database()})  # the rover's map is not touched
        self._detector = LoopDetector(own, make_detector_embedder(settings))
        self._graph = PoseGraph(settings.pose_graph)
        self._feed = OdometrySessionSplitter(self._graph)
        self._stamps: list[int] = []
        self._sessions: list[int] = []
        self._travelled: list[float] = []
        self._pooled: list[tuple[NDArray, ...]] = []

    def take(self, item: Frame | OdometrySample) -> Detection | None:
        """The next of the recording's stream; what became of it, if it is a frame."""
        if isinstance(item, OdometrySample):
            self._feed.take(item.stamp_ns, item.odom_T_body)
            return None
        detection = self._detector.process(item)
        for closure in detection.closures:
            self._graph.add_closure(closure)
        if detection.keyframe is not None and detection.keyframe.path_length_m is not None:
            self._stamps.append(detection.keyframe.stamp_ns)
            self._sessions.append(detection.keyframe.session)
            self._travelled.append(detection.keyframe.path_length_m)
            self._pooled.append(pool(self._network, item))
        return detection

    def finish(self) -> Drive:
        """The drive, its closures judged.

        Raises:
            UmfError: there was no odometry, or not a single keyframe in the map.
        """
        self._detector.database.close()
        self._graph.settle()
        stamps, poses = self._graph.trajectory()
        order = np.argsort(stamps, kind="stable")
        own_stamps = np.array(self._stamps, np.int64)
        map_T_body, known = Trajectory(stamps[order], poses[order]).at(own_stamps)
        if not known.any():
            raise UmfError("no keyframe has odometry: without it nothing is known of what is one place")
        kept = np.flatnonzero(known)
        seen, felt, cells, image_present, cloud_present = (
            np.stack([each[part] for each in self._pooled])[kept] for part in range(5)
        )
        return Drive(
            own_stamps[kept],
            seen,
            felt,
            cells,
            image_present,
            cloud_present,
            map_T_body=map_T_body[kept],
            path_length_m=np.array(self._travelled)[kept],
            session=np.array(self._sessions, np.int64)[kept],
            closures=self._closures([self._stamps[row] for row in kept]),
        )

    def _closures(self, stamps: list[int]) -> NDArray[np.int64]:
        row = {stamp: index for index, stamp in enumerate(stamps)}
        found = [one.closure for one in self._graph.closures() if one.state is State.ACCEPTED]
        ends = [(row.get(one.query_stamp_ns), row.get(one.match_stamp_ns)) for one in found]
        return np.array([pair for pair in ends if None not in pair], np.int64).reshape(-1, 2)


def pool(network: UMF, frame: Frame) -> tuple[NDArray, ...]:
    """What the heads see of a frame: the first five fields of a drive after the stamps, of one keyframe."""
    assert network.scene is not None
    batch = to_tensors(read_frame(frame, network.config))
    with torch.inference_mode():
        features = network.encode(batch)
        cloud_present = batch.coarse_mask.any(1)
        tokens = network.stand_in(features, batch.image_present, cloud_present)
        seen, felt = network.fusion.pool(*tokens)
        cells = network.scene.pool(batch.image).flatten(1).half()
    return tuple(each[0].numpy() for each in (seen, felt, cells, batch.image_present, cloud_present))
