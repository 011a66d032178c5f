"""S3LI: pickled pairs and sequences."""

from __future__ import annotations

import math
import pickle
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.presets import settings_for
from umf_ros.bags.reader import open_bag
from umf_ros.bags.trajectories import read_ground_truth, read_odometry
from umf_ros.core.config import Settings
from umf_ros.core.errors import BagError, UmfError, one_line
from umf_ros.core.frames import Frame, Image
from umf_ros.core.geometry import Array, align, to_enu, transform
from umf_ros.core.trajectory import Trajectory
from umf_ros.embedding.inputs import shrink
from umf_ros.lab.datasets.sample import Sample
from umf_ros.lab.datasets.simulated import RecordedSequence, course, detours, path_length, poses_of
from umf_ros.lab.scan_files import read_picture
from umf_ros.sensors.calibration import Calibration, load_calibration

Names = Mapping[str, Callable[..., Any]]

_PLAIN = re.compile(r"(?:[fiuc](?:1|2|4|8|16)|b1|O8?|[US][0-9]{1,5})")


class _DataType:
    """Stands for a `numpy.dtype`: numbers, truth values, text and objects, nothing composed."""

    def __init__(self, name: str, *_: Any) -> None:
        if not isinstance(name, str) or not _PLAIN.fullmatch(name):
            raise pickle.UnpicklingError(f"it holds an array of type {str(name)[:40]!r}")
        self.value = np.dtype(name)

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, order, *composed = state
        if order not in ("<", ">", "=", "|") or any(part is not None for part in composed[:3]):
            raise pickle.UnpicklingError("it holds an array of a composed type")
        self.value = self.value.newbyteorder(order)


class _Array:
    """Stands for a `numpy.ndarray` until all of its state has come."""

    def __init__(self, *_: Any) -> None:
        self.value: NDArray[Any] = np.empty(0)

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, shape, kind, by_column, data = state
        self.value = _from_data(data, kind, shape, "F" if by_column else "C")


def _from_data(data: Any, kind: Any, shape: Any, order: str) -> NDArray[Any]:
    if not isinstance(kind, _DataType) or not isinstance(shape, tuple) or order not in ("C", "F"):
        raise pickle.UnpicklingError("it holds an array of no type or shape")
    if not all(type(size) is int and size >= 0 for size in shape) or len(shape) > 8:
        raise pickle.UnpicklingError("it holds an array of no shape")
    count = math.prod(shape)
    if kind.value.hasobject:
        if not isinstance(data, list) or len(data) != count:
            raise pickle.UnpicklingError("it holds an array whose objects do not fit its shape")
        objects = np.empty(count, object)
        objects[:] = data if count != 1 else [data[0]]
        return objects.reshape(shape, order="F" if order == "F" else "C")
    if not isinstance(data, bytes | bytearray) or len(data) != count * kind.value.itemsize:
        raise pickle.UnpicklingError("it holds an array whose bytes do not fit its shape")
    return np.frombuffer(bytes(data), kind.value).reshape(shape, order="F" if order == "F" else "C").copy(order="K")


def _frombuffer(data: Any, kind: Any, shape: Any, order: str, *_: Any) -> NDArray[Any]:
    return _from_data(data, kind, shape, order)


def _scalar(kind: Any, data: Any) -> Any:
    return _from_data([data] if kind.value.hasobject else data, kind, (), "C")[()]


def _latin1(text: str, encoding: str) -> bytes:
    """How bytes are written by protocols that know none."""
    if encoding != "latin1":
        raise pickle.UnpicklingError(f"it asks for the encoding {encoding[:40]!r}")
    return text.encode("latin1")


_NUMPY: dict[str, Callable[..., Any]] = {
    "numpy.ndarray": _Array,
    "numpy.dtype": _DataType,
    "builtins.slice": slice,
    "_codecs.encode": _latin1,
    "__builtin__.bytes": lambda: b"",
}
for _package in ("numpy.core", "numpy._core"):
    _NUMPY |= {f"{_package}.multiarray._reconstruct": _Array, f"{_package}.multiarray.scalar": _scalar}
    _NUMPY[f"{_package}.numeric._frombuffer"] = _frombuffer


class _Unpickler(pickle._Unpickler):
    """The one written in Python: that in C takes the memory that a hostile file names."""

    def __init__(self, stream: Any, known: Names) -> None:
        super().__init__(stream)
        self._known = known

    def find_class(self, module: str, name: str) -> Any:
        # a class is asked for by its module, which is wherever the writer's script had it
        found = self._known.get(f"{module}.{name}", self._known.get(name))
        if found is None:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}, which has no business there")
        return found


def _plain(value: Any) -> Any:
    """The array, where something stands for one."""
    return value.value if isinstance(value, _Array) else value


def _settled(value: Any, done: dict[int, Any]) -> Any:
    """`value` with arrays in place of what stood for them, however deep."""
    if id(value) in done:
        return done[id(value)]
    if isinstance(value, _Array):
        done[id(value)] = value.value
        return _settled(value.value, done)
    done[id(value)] = value
    if isinstance(value, np.ndarray):
        if value.dtype.hasobject:
            for index, item in enumerate(value.flat):
                value.flat[index] = _settled(item, done)
    elif isinstance(value, list):
        value[:] = [_settled(item, done) for item in value]
    elif isinstance(value, dict):
        value.update({key: _settled(item, done) for key, item in value.items()})
    elif type(value) is tuple:
        done[id(value)] = tuple(_settled(item, done) for item in value)
    elif hasattr(value, "__dict__") and not callable(value):
        vars(value).update({name: _settled(item, done) for name, item in vars(value).items()})
    return done[id(value)]


def load_pickle(path: Path, known: Names | None = None) -> Any:
    """Contents of a pickle.

    Args:
        path: the file.
        known: what stands for the names it may ask for, by `module.name` or by name alone, beside NumPy's arrays.

    Raises:
        UmfError: the file is missing, damaged, or asks for anything else.
    """
    try:
        with path.open("rb") as stream:
            return _settled(_Unpickler(stream, _NUMPY | dict(known or {})).load(), {})
    except OSError as error:
        raise UmfError(f"cannot read {path}: {error.strerror}") from None
    except Exception as error:  # damaged bytes provoke anything
        raise UmfError(f"cannot read the pickle {path}: {' '.join(str(error).split())[:200]}") from None


class _Frame:
    """Stands for a pandas DataFrame."""

    manager: _Manager

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.manager = state["_mgr"]


class _Manager:
    """Stands for the blocks and axes of a DataFrame."""

    def __init__(self, blocks: tuple[tuple[Any, Any], ...], axes: list[Any]) -> None:
        self.blocks, self.names = blocks, axes[0]


class _Strings:
    """Stands for an array of strings of pandas 3."""

    def __init__(self, *_: Any) -> None:
        self.values = np.empty(0, object)

    def __setstate__(self, state: tuple[Any, NDArray[Any], Any]) -> None:
        self.values = _plain(state[1])


def _index(_: Any, content: dict[str, Any]) -> list[Any]:
    data = _plain(content.get("data", ()))
    return list(data.values if isinstance(data, _Strings) else data)


_PANDAS: dict[str, Callable[..., Any]] = {
    "pandas.core.frame.DataFrame": _Frame,
    "pandas.DataFrame": _Frame,
    "pandas.core.internals.managers.BlockManager": _Manager,
    "pandas._libs.internals._unpickle_block": lambda values, place, dimensions: (values, place),
    "pandas.core.indexes.base._new_Index": _index,
    "pandas._libs.arrays.__pyx_unpickle_NDArrayBacked": _Strings,
    "pandas.StringDtype": lambda *_: None,
    # only named as arguments of the above
    "pandas.core.indexes.base.Index": object,
    "pandas.core.indexes.range.RangeIndex": object,
    "pandas.Index": object,
    "pandas.RangeIndex": object,
    "pandas.arrays.StringArray": object,
}


def load_data_frame(path: Path) -> dict[str, NDArray[Any]]:
    """The columns of a pickled pandas DataFrame (pandas 1.3 to 3), by name.

    Raises:
        UmfError: the file cannot be read or is no DataFrame of plain columns.
    """
    frame = load_pickle(path, _PANDAS)
    if not isinstance(frame, _Frame) or not isinstance(getattr(frame, "manager", None), _Manager):
        raise UmfError(f"{path} holds a {type(frame).__name__}, not a pandas DataFrame")
    try:
        return _columns(frame, path)
    except (ValueError, TypeError, LookupError) as error:
        raise UmfError(f"{path} is no DataFrame of plain columns: {one_line(error)}") from None


def _columns(frame: _Frame, path: Path) -> dict[str, NDArray[Any]]:
    names = frame.manager.names
    columns: dict[str, NDArray[Any]] = {}
    for values, place in frame.manager.blocks:
        rows = values.values if isinstance(values, _Strings) else values
        where = np.arange(len(names))[place]
        if not isinstance(rows, np.ndarray) or len(where) != len(np.atleast_2d(rows)):
            raise UmfError(f"{path}: cannot read the columns {', '.join(str(names[i]) for i in where)}")
        columns |= {str(names[column]): row for column, row in zip(where, np.atleast_2d(rows), strict=True)}
    return columns


ETNA_TEST = ("s3li_loops", "s3li_traverse_1")
ETNA_TRAINING = ("s3li_traverse_2", "s3li_crater", "s3li_crater_inout", "s3li_mapping", "s3li_landmarks")
"""The split of [UMF 5.1.2]."""

KEPT_SIZE = (256, 344)
"""Height and width at which images stay in memory: half of Etna's."""
MAX_MISFIT = 0.1
"""SLAM is not believed when it misses the satellites by more than this share of the way."""
HEADING_WINDOW_M = 20.0
"""Way before and after a pose on which odometry is turned to the satellites' positions, long beside their noise; with
the drift of the twin's crater, 140 degrees in a kilometre, R@1 is the same for 5 to 40 m."""

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
    places = np.concatenate(geodetic)
    positions = np.split(to_enu(places, places[0]), np.cumsum([len(part) for part in geodetic])[:-1])
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
    return poses_of(aligned_rotations(np.stack(odometry), positions), positions)


def aligned_rotations(estimate: Array, positions: Array) -> Array:
    """(N, 3, 3) rotations of estimated (N, 4, 4) poses in the frame of (N, 3) positions; the course if they differ."""
    truth_T_estimate = align(estimate[:, :3, 3], positions)[0]
    misfit = np.linalg.norm(transform(truth_T_estimate, estimate[:, :3, 3]) - positions, axis=1)
    if np.sqrt(np.mean(misfit**2)) > MAX_MISFIT * path_length(positions)[-1]:
        return course(positions)
    return truth_T_estimate[:3, :3] @ estimate[:, :3, :3]


def headed(
    truth: Trajectory, stamps: NDArray[np.int64], odometry: Trajectory | None
) -> tuple[Array, NDArray[np.bool_]]:
    """True poses (N, 4, 4): positions by satellites, rotations of the odometry, turned to them about the vertical.

    Each pose is turned by the way around it, so its heading is right however far the odometry has drifted. Without
    odometry, or where the two differ by more than a tenth of that way, the course over ground is the heading. Second
    comes (N,) whether each is known.
    """
    poses, known = truth.at(stamps)
    rows = np.flatnonzero(known)
    if not len(rows):
        return poses, known
    positions = poses[rows, :3, 3]
    rotations = course(positions)
    estimate, heard = odometry.at(stamps[rows]) if odometry is not None else (poses, np.zeros(len(rows), bool))
    if heard.any():
        turned, fits = turned_rotations(estimate[heard], positions[heard])
        rotations[np.flatnonzero(heard)[fits]] = turned[fits]
    poses[rows] = poses_of(rotations, positions)
    return poses, known


def turned_rotations(estimate: Array, positions: Array) -> tuple[Array, NDArray[np.bool_]]:
    """(N, 3, 3) rotations of (N, 4, 4) poses with z up, each turned about z to fit (N, 3) positions on the way around.

    Second comes (N,) whether they fit.
    """
    way = path_length(positions)
    turns, fits = np.zeros(len(way)), np.zeros(len(way), bool)
    plane = estimate[:, 0, 3] + 1j * estimate[:, 1, 3], positions[:, 0] + 1j * positions[:, 1]
    for row, here in enumerate(way):
        around = slice(*np.searchsorted(way, (here - HEADING_WINDOW_M, here + HEADING_WINDOW_M)))
        ours, theirs = (one[around] - one[around].mean() for one in plane)
        turn = np.vdot(ours, theirs)  # of least squares, in the plane [Kabsch 1976]
        turns[row] = np.angle(turn)
        misfit = np.sqrt(np.mean(np.abs(ours * np.exp(1j * turns[row]) - theirs) ** 2))
        fits[row] = turn != 0 and misfit < MAX_MISFIT * (way[around][-1] - way[around][0])
    return Rotation.from_euler("z", turns[:, None]).as_matrix() @ estimate[:, :3, :3], fits


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
    return poses_of(aligned_rotations(slam @ np.linalg.inv(calibration.body_T_imu), positions), positions)


def _read_image(written: Path, folder: Path | None) -> Image:
    """The image where it was written, or in `folder` under as much of its path as is there."""
    places = [written]
    if folder is not None:
        places += [folder.joinpath(*written.parts[-count:]) for count in range(min(4, len(written.parts)), 0, -1)]
    for path in places:
        if path.is_file():
            return read_picture(path).astype(np.uint8)
    raise UmfError(f"there is no image {written}" + (f", nor in {folder}" if folder else ""))
