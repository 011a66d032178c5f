"""S3LI [Giubilato 2022]: recordings with RTKLIB truth, and the s3li-toolkit's pickles."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.presets import settings_for
from umf_ros.bags.reader import open_bag
from umf_ros.bags.trajectories import east_north_up, read_ground_truth, read_odometry
from umf_ros.core.config import Settings
from umf_ros.core.errors import BagError, UmfError
from umf_ros.core.frames import Frame, Image
from umf_ros.core.geometry import Array, align, transform
from umf_ros.core.trajectory import Trajectory
from umf_ros.embedding.inputs import shrink
from umf_ros.lab.datasets.pickles import load_data_frame
from umf_ros.lab.datasets.recorded import RecordedSequence, course, detours, path_length, poses_of
from umf_ros.lab.datasets.sample import Sample
from umf_ros.sensors.calibration import Calibration, load_calibration

ETNA_TEST = ("s3li_loops", "s3li_traverse_1")
ETNA_TRAINING = ("s3li_traverse_2", "s3li_crater", "s3li_crater_inout", "s3li_mapping", "s3li_landmarks")
"""The split of [UMF 5.1.2]."""

KEPT_SIZE = (256, 344)
"""Height and width at which images stay in memory: half of Etna's."""
MAX_MISFIT = 0.1
"""SLAM is not believed when it misses the satellites by more than this share of the way."""

COLUMNS = ("seq_name", "img_path", "point_cloud", "latitude", "longitude", "elevation")


def read_bag(
    bag: Path,
    truth: Path | None = None,
    odometry: Path | None = None,
    settings: Settings | None = None,
    spacing_m: float = 1.0,
    odometry_frame: str = "body",
) -> RecordedSequence:
    """A recording as a sequence, one sample every `spacing_m` of the true path.

    Satellites know no heading: it comes from the odometry, aligned with the positions, or else from the
    course over ground.

    Args:
        bag: ROS 1 or ROS 2 recording.
        truth: RTKLIB .pos or TUM file; None: the recording's own truth.
        odometry: TUM file, where the recording has none.
        settings: topics and calibration; None: those of the data set the recording's topics belong to.
        spacing_m: distance between samples.
        odometry_frame: whose poses `odometry` holds: body, imu (S3LI's Eval/BASALT), camera or lidar.

    Raises:
        BagError: unreadable recording or truth, or no truth at all.
    """
    recording = open_bag(bag)
    settings = settings or settings_for(recording, None, "auto")
    known = read_ground_truth(recording, truth)
    if known is None:
        raise BagError(f"{bag} holds no ground truth; name a file")
    path = read_odometry(odometry, odometry_frame, settings) if odometry else None
    frames = FrameReader(recording, settings, path)
    kept, positions = _spaced(frames, known, spacing_m)
    if len(kept) < 3:
        raise BagError(f"the ground truth of {bag} covers {len(kept)} samples; do the clocks agree?")
    poses = _poses(kept, positions, known)
    samples = [_sample(*pair) for pair in zip(kept, poses, strict=True)]
    return RecordedSequence(bag.stem, bag.stem, poses, detours(positions), samples.__getitem__)


def read_toolkit(pickles: Sequence[Path], images: Path | None = None, dataset: str = "s3li-etna") -> RecordedSequence:
    """The toolkit's pickles as one sequence in common coordinates; each pickle is a pass when there are several.

    Args:
        pickles: `<sequence>.pkl`, one DataFrame each.
        images: folder to look for the images in, when they are no longer where they were written.
        dataset: whose calibration holds.

    Raises:
        UmfError: a file is missing, damaged, or lacks a column.
    """
    calibration = load_calibration(dataset)
    tables = [_read_table(path) for path in pickles]
    geodetic = [np.stack([table[name] for name in COLUMNS[3:]], axis=1).astype(float) for table in tables]
    positions = np.split(east_north_up(np.concatenate(geodetic)), np.cumsum([len(part) for part in geodetic])[:-1])
    poses = np.concatenate(
        [_toolkit_poses(table, place, calibration) for table, place in zip(tables, positions, strict=True)]
    )
    rows = [(table, row) for table in tables for row in range(len(table["img_path"]))]
    passes = [np.full(len(part), number) for number, part in enumerate(positions)]
    if len(tables) == 1:
        passes = [detours(positions[0])]

    def load(index: int) -> Sample:
        table, row = rows[index]
        points = transform(calibration.body_T_camera, np.asarray(table["point_cloud"][row], np.float32))
        image = _read_image(Path(str(table["img_path"][row])), images)
        return Sample(image, points, None, poses[index], calibration.camera, calibration.body_T_camera)

    name = "+".join(str(table["seq_name"][0]) for table in tables)
    return RecordedSequence(name, dataset, poses, np.concatenate(passes), load)


def _spaced(frames: FrameReader, truth: Trajectory, spacing_m: float) -> tuple[list[Frame], Array]:
    kept: list[Frame] = []
    places: list[Array] = []
    for frame in frames:
        pose, known = truth.at(np.array([frame.stamp_ns]))
        place = pose[0, :3, 3]
        if known[0] and (not places or np.linalg.norm(place - places[-1]) >= spacing_m):
            kept.append(frame)
            places.append(place)
    return kept, np.array(places).reshape(-1, 3)


def _poses(frames: list[Frame], positions: Array, truth: Trajectory) -> Array:
    if truth.has_orientation:
        return truth.at(np.array([frame.stamp_ns for frame in frames]))[0]
    odometry = [frame.odom_T_body for frame in frames if frame.odom_T_body is not None]
    if len(odometry) < len(frames):
        return poses_of(course(positions), positions)
    return poses_of(_aligned(np.stack(odometry), positions), positions)


def _aligned(estimate: Array, positions: Array) -> Array:
    """(N, 3, 3) rotations of estimated (N, 4, 4) poses in the frame of (N, 3) positions; the course if they differ."""
    truth_T_estimate = align(estimate[:, :3, 3], positions)[0]
    misfit = np.linalg.norm(transform(truth_T_estimate, estimate[:, :3, 3]) - positions, axis=1)
    if np.sqrt(np.mean(misfit**2)) > MAX_MISFIT * path_length(positions)[-1]:
        return course(positions)
    return truth_T_estimate[:3, :3] @ estimate[:, :3, :3]


def _sample(frame: Frame, pose: Array) -> Sample:
    image = None if frame.left is None else shrink(frame.left, KEPT_SIZE)
    return Sample(image, frame.points, frame.intensity, pose, frame.camera, frame.body_T_camera)


def _read_table(path: Path) -> dict[str, NDArray[Any]]:
    table = load_data_frame(path)
    missing = [name for name in COLUMNS if name not in table]
    if missing or not len(table[COLUMNS[0]]):
        raise UmfError(f"{path} is no data set of the s3li-toolkit: {', '.join(missing) or 'every row'} missing")
    return table


def _toolkit_poses(table: dict[str, NDArray[Any]], positions: Array, calibration: Calibration) -> Array:
    """Poses of the body: the satellites' positions, and SLAM's rotations (of the IMU; w x y z) aligned with them."""
    if len(positions) < 3 or "slam_orientation" not in table or "slam_position" not in table:
        return poses_of(course(positions), positions)
    wxyz = np.stack([np.asarray(value, float) for value in table["slam_orientation"]])
    slam = poses_of(
        Rotation.from_quat(wxyz, scalar_first=True).as_matrix(),
        np.stack([np.asarray(value, float) for value in table["slam_position"]]),
    )
    return poses_of(_aligned(slam @ np.linalg.inv(calibration.body_T_imu), positions), positions)


def _read_image(written: Path, folder: Path | None) -> Image:
    """The image where it was written, or in `folder` under as much of its path as is there."""
    places = [written]
    if folder is not None:
        places += [folder.joinpath(*written.parts[-count:]) for count in range(min(4, len(written.parts)), 0, -1)]
    for path in places:
        if path.is_file():
            image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            if image is None:
                raise UmfError(f"{path} is no image")
            return image.astype(np.uint8)
    raise UmfError(f"there is no image {written}" + (f", nor in {folder}" if folder else ""))
