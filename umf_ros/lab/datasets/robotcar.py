"""Oxford RobotCar [Maddern 2017] in the layout of MinkLoc++ [Komorowski 2021]: laser submaps, images by stamps.

    <root>/oxford/<traversal>/pointcloud_20m_10overlap/<stamp>.bin    4096 x 3 float64 in [-1, 1]
    <root>/training_queries_baseline.pickle, ...                      {number: TrainingTuple}
    <root>/oxford_evaluation_{database,query}.pickle                  [{number: {query, northing, easting, ...}}]
    <images>/<traversal>/<stamp>.png, lidar2image_ndx.pickle          {stamp of a submap: [stamps of images]}

Same place means within 10 m, another beyond 50 m, whatever the heading [UMF 5.1.1].
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from umf_ros.core.errors import UmfError
from umf_ros.core.frames import Image, Points, StereoCamera
from umf_ros.core.geometry import Array, make_pose
from umf_ros.lab.datasets.s3li import load_pickle
from umf_ros.lab.datasets.sample import Sample
from umf_ros.lab.datasets.simulated import RecordedSequence, course, poses_of
from umf_ros.lab.scan_files import read_picture

POINTS = 4096
SUBMAP_M = 20.0
"""Metres of one unit, about: the submaps were scaled to [-1, 1] and do not say by how much."""
CENTRE_M = 20.0
"""Submaps are centred on the car; they are moved this far ahead, into the box the network sees."""
CAMERA = StereoCamera(1280, 960, 983.044006, 983.044006, 643.646973, 493.378998, 0.0)
BODY_T_CAMERA = make_pose([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0, 0, 0])


class TrainingTuple:
    """Stands for MinkLoc++'s class of that name; of the attributes in the pickle these are read."""

    rel_scan_filepath: str
    position: Any


@dataclass(frozen=True, slots=True)
class SubmapFile:
    """A submap of the benchmark, and where it is.

    Attributes:
        path: of its file, relative to the root.
        northing, easting: metres.
    """

    path: str
    northing: float
    easting: float

    @property
    def traversal(self) -> str:
        """Name of the drive."""
        return Path(self.path).parent.parent.name

    @property
    def stamp(self) -> int:
        """Microseconds; the key of its images."""
        return int(Path(self.path).stem)


def read_training(root: Path, images: Path | None, name: str = "training_queries_baseline.pickle") -> RecordedSequence:
    """The training (or test) tuples as one sequence; every traversal is a pass.

    Args:
        root: of the submaps and pickles.
        images: of the images and `lidar2image_ndx.pickle`; None: laser alone.
        name: of the pickle.

    Raises:
        UmfError: a file is missing, damaged or of another layout.
    """
    tuples = load_pickle(root / name, {"TrainingTuple": TrainingTuple})
    try:
        submaps = [SubmapFile(item.rel_scan_filepath, *map(float, item.position)) for item in tuples.values()]
    except (AttributeError, TypeError, ValueError) as error:
        raise UmfError(f"{root / name} holds no training tuples: {error}") from None
    return _sequence(Path(name).stem, root, images, submaps)


def read_evaluation(root: Path, images: Path | None, part: str = "query") -> RecordedSequence:
    """The evaluation's "database" or "query" submaps as one sequence; every traversal is a pass.

    Raises:
        UmfError: a file is missing, damaged or of another layout.
    """
    path = root / f"oxford_evaluation_{part}.pickle"
    runs = load_pickle(path)
    try:
        entries = [entry for run in runs for _, entry in sorted(run.items())]
        submaps = [SubmapFile(entry["query"], float(entry["northing"]), float(entry["easting"])) for entry in entries]
    except (AttributeError, TypeError, KeyError, ValueError) as error:
        raise UmfError(f"{path} holds no evaluation set: {error!r}") from None
    return _sequence(path.stem, root, images, submaps)


def _sequence(name: str, root: Path, images: Path | None, submaps: list[SubmapFile]) -> RecordedSequence:
    linked = load_pickle(images / "lidar2image_ndx.pickle") if images is not None else {}
    poses = _poses(submaps)
    traversals = {traversal: number for number, traversal in enumerate(sorted({item.traversal for item in submaps}))}
    passes = np.array([traversals[item.traversal] for item in submaps])

    def load(index: int) -> Sample:
        submap = submaps[index]
        image = None if images is None else _read_image(submap, images, linked)
        return Sample(image, _read_points(root / submap.path), None, poses[index], CAMERA, BODY_T_CAMERA)

    return RecordedSequence(name, "oxford", poses, passes, load)


def _poses(submaps: list[SubmapFile]) -> Array:
    """East, north, level; the heading is the course along the submap's own traversal."""
    positions = np.array([[item.easting, item.northing, 0.0] for item in submaps]).reshape(-1, 3)
    rotations = np.tile(np.eye(3), (len(submaps), 1, 1))
    for traversal in {item.traversal for item in submaps}:
        rows = [row for row, item in enumerate(submaps) if item.traversal == traversal]
        rows.sort(key=lambda row: submaps[row].stamp)
        rotations[rows] = course(positions[rows])
    return poses_of(rotations, positions)


def _read_points(path: Path) -> Points:
    try:
        values = np.fromfile(path, np.float64)
    except OSError as error:
        raise UmfError(f"cannot read {path}: {error.strerror}") from None
    if values.size != POINTS * 3:
        raise UmfError(f"{path} holds {values.size} numbers instead of {POINTS} points")
    points = values.reshape(POINTS, 3) * SUBMAP_M
    return (points + np.array([CENTRE_M, 0, 0])).astype(np.float32)


def _read_image(submap: SubmapFile, images: Path, linked: dict[int, list[int]]) -> Image | None:
    """The image nearest in time; None where the submap has none."""
    for stamp in linked.get(submap.stamp, [])[:1]:
        path = images / submap.traversal / f"{stamp}.png"
        return read_picture(path).astype(np.uint8)
    return None
