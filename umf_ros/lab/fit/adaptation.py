"""Fine-tune the network's heads on a rover's own drives, without ground truth.

Poses are those of the pose graph. Two keyframes are one place where they are near in the map *and* a measurement
confirms it: the odometry between them is short, or a verified closure that the graph accepted joins the two stretches
of the drive. They are different places where they are further apart in the map than the map's error; other pairs are
left out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from umf_ros.absolute.measurement import AbsoluteMeasurement
from umf_ros.core.config import Database, Settings
from umf_ros.core.errors import UmfError
from umf_ros.core.frames import Frame
from umf_ros.core.geometry import Array
from umf_ros.core.io import atomic_write
from umf_ros.core.trajectory import Trajectory
from umf_ros.detector import Detection, LoopDetector, make_detector_embedder
from umf_ros.lab.datasets.sample import distances, places_of
from umf_ros.lab.datasets.views import read_frame
from umf_ros.lab.training.losses import neighbourhood_components
from umf_ros.networks.fusion import Fused
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
    """Labels (N, N) of pairs of keyframes, the first of a pair being the query; a pair with neither is unknown."""

    same: Mask
    other: Mask

    @property
    def revisits(self) -> NDArray[np.int64]:
        """Keyframes that have been somewhere before, and could be mistaken."""
        return np.flatnonzero(self.same.any(axis=1) & self.other.any(axis=1))


def label_drive(drive: Drive) -> Labels:
    """Label the pairs of a drive by its map."""
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

    def take(self, item: Frame | OdometrySample | AbsoluteMeasurement) -> Detection | None:
        """The next of the recording's stream; what became of it, if it is a frame."""
        if isinstance(item, OdometrySample):
            self._feed.take(item.stamp_ns, item.odom_T_body)
        if not isinstance(item, Frame):
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
    """Input of the heads for a frame: the first five fields of a drive after the stamps, of one keyframe."""
    assert network.scene is not None
    batch = read_frame(frame, network.config).tensors()
    with torch.inference_mode():
        features = network.encode(batch)
        cloud_present = batch.coarse_mask.any(1)
        seen, felt = network.pool(features, batch.image_present, cloud_present)
        cells = network.scene.pool(batch.image).flatten(1).half()
    return tuple(each[0].numpy() for each in (seen, felt, cells, batch.image_present, cloud_present))


HELD_OUT = 0.3
"""Share of a drive's revisits, the last ones."""
FEWEST = 20
"""Revisits held out that can decide."""
GAINED = 0.01
"""Mean gain of recall@1 from which the result is kept."""
LOST = 0.01
"""Largest loss of a single modality."""
SURE = 1.64
"""Standard deviations of chance by which what is found now must outweigh what is found no more (a sign test)."""
PARTS = ("descriptor", "image", "cloud")


@dataclass(frozen=True, slots=True)
class Adaptation:
    """How the heads are fitted.

    Attributes:
        steps: of one drive each.
        learning_rate: of Adam; `scene_rate` that of the scene's projection, whose numbers are small.
        pull: weight of the squared relative distance from the start.
        way: from the start to what was fitted, how far to go.
        seed: of the order of the drives.
    """

    steps: int = 150
    learning_rate: float = 5e-4
    scene_rate: float = 1e-5
    pull: float = 10.0
    way: float = 0.5
    seed: int = 0


class Recall(NamedTuple):
    """Recall@1 of the revisits held out, by what is asked; NaN where a modality is absent.

    Attributes:
        fused, image, lidar: shares.
        revisits: so many.
        hits: (Q,) bool, of all that was asked, in an order that another network's hits share.
    """

    fused: float
    image: float
    lidar: float
    revisits: int
    hits: NDArray[np.bool_]

    def said(self) -> str:
        """For people."""
        shown = zip(("both", "image", "LiDAR"), self[:3], strict=True)
        return ", ".join(f"{name} {100 * value:.1f} %" for name, value in shown if np.isfinite(value))

    def gain_over(self, before: Recall) -> float:
        """Mean gain; negative where any modality lost, 0 at most where it may be chance."""
        gains = np.array(self[:3]) - np.array(before[:3])
        gains = gains[np.isfinite(gains)]
        if not len(gains) or gains.min() < -LOST:
            return -1.0
        won, lost = int((self.hits & ~before.hits).sum()), int((before.hits & ~self.hits).sum())
        sure = won - lost > SURE * np.sqrt(won + lost)
        return float(gains.mean() if sure else min(gains.mean(), 0.0))


class Lesson:
    """One drive as tensors: what to learn from, and what is held out."""

    def __init__(self, drive: Drive) -> None:
        self._drive = drive
        labels = label_drive(drive)
        revisits = labels.revisits
        kept = max(1, round(HELD_OUT * len(revisits))) if len(revisits) else 0
        self.held_out = revisits[len(revisits) - kept :]
        hidden = _with_their_places(labels, self.held_out)
        self.learned = np.setdiff1d(revisits, np.flatnonzero(hidden))
        self.same, self.other = torch.from_numpy(labels.same), torch.from_numpy(labels.other)
        self._shown = torch.from_numpy(~hidden)

    def describe(self, network: UMF) -> Fused:
        """Descriptors (N, ...) of all keyframes."""
        assert network.scene is not None
        drive = self._drive
        seen, felt, cells = (torch.from_numpy(each).float() for each in (drive.seen, drive.felt, drive.cells))
        present = torch.from_numpy(drive.image_present), torch.from_numpy(drive.cloud_present)
        return network.fusion.describe(seen, felt, *present, network.scene.project(cells))

    def loss(self, network: UMF) -> Tensor:
        """Of what is not held out: both halves and the whole."""
        rows = torch.from_numpy(self.learned)
        found = self.describe(network)
        same, other = (mask[rows] & self._shown for mask in (self.same, self.other))
        parts = [getattr(found, name) for name in self._parts()]
        return torch.stack([neighbourhood_components(part[rows] @ part.T, same, other) for part in parts]).sum()

    def hits(self, network: UMF) -> dict[str, NDArray[np.bool_]]:
        """Whether each revisit held out finds its place, by what is asked."""
        rows = torch.from_numpy(self.held_out)
        with torch.inference_mode():
            found = self.describe(network)
            asked = self.same[rows] | self.other[rows]
            hits = {}
            for name in self._parts():
                part = getattr(found, name)
                best = (part[rows] @ part.T).masked_fill(~asked, -2).argmax(1)
                hits[name] = self.same[rows, best].numpy()
        return hits

    def _parts(self) -> list[str]:
        """The whole, and the halves of the modalities that the drive has."""
        present = True, bool(self._drive.image_present.any()), bool(self._drive.cloud_present.any())
        return [name for name, there in zip(PARTS, present, strict=True) if there]


def measure(network: UMF, lessons: Sequence[Lesson]) -> Recall:
    """Recall@1 of all revisits that are held out."""
    hits = [lesson.hits(network) for lesson in lessons if len(lesson.held_out)]
    fused, image, lidar = (_share([found[name] for found in hits if name in found]) for name in PARTS)
    every = [found[name] for found in hits for name in PARTS if name in found]
    revisits = sum(len(lesson.held_out) for lesson in lessons)
    return Recall(fused, image, lidar, revisits, np.concatenate(every) if every else np.empty(0, bool))


def adapt(
    network: UMF, lessons: Sequence[Lesson], settings: Adaptation, report: Callable[[int], None] = lambda _: None
) -> None:
    """Fit the heads in place.

    Args:
        network: with a scene.
        lessons: of drives with revisits that are not held out.
        settings: of the fit.
        report: called with the steps done.
    """
    assert network.scene is not None
    usable = [lesson for lesson in lessons if len(lesson.learned)]
    fusion, projection = network.fusion, network.scene.projection.weight
    heads = [*fusion.image_head.parameters(), *fusion.cloud_head.parameters(), *fusion.weigh.parameters()]
    chosen = [*heads, projection]
    start = [each.detach().clone() for each in chosen]
    groups = [
        {"params": heads, "lr": settings.learning_rate},
        {"params": [projection], "lr": settings.scene_rate},
    ]
    optimiser = torch.optim.Adam(groups)
    luck = np.random.default_rng(settings.seed)
    for step in range(settings.steps):
        strayed = [_strayed(now, then) for now, then in zip(chosen, start, strict=True)]
        loss = usable[int(luck.integers(len(usable)))].loss(network) + settings.pull * torch.stack(strayed).sum()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        report(step + 1)
    with torch.no_grad():
        for now, then in zip(chosen, start, strict=True):
            now.lerp_(then, 1 - settings.way)


def _strayed(now: Tensor, start: Tensor) -> Tensor:
    """Squared distance from the start, relative to it."""
    return ((now - start) ** 2).sum() / (start**2).sum().clamp(min=1e-6)


def _with_their_places(labels: Labels, rows: NDArray[np.int64]) -> Mask:
    """(N,) bool: some keyframes, and all that show the same places."""
    hidden: Mask = np.asarray(labels.same[rows].any(axis=0))
    hidden[rows] = True
    return hidden


def _share(hits: Sequence[NDArray[np.bool_]]) -> float:
    return float(np.concatenate(hits).mean()) if hits else float("nan")
