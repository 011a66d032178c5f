"""Files of a download of S3LI, and readers of its calibrations and lists of pairs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from umf_ros.bags.trajectories import read_rtklib
from umf_ros.core.errors import BagError, CalibrationError, ConfigError, UmfError
from umf_ros.core.geometry import Array, invert, make_pose, rotation_angle, to_quaternion
from umf_ros.core.io import read_lines, read_yaml
from umf_ros.core.trajectory import Trajectory
from umf_ros.lab.datasets.s3li import ETNA_TEST, ETNA_TRAINING, load_pickle

ETNA = (*ETNA_TEST, *ETNA_TRAINING)
VULCANO_DAYS = {
    **dict.fromkeys(("capo_grillo", "capo_grillo_2"), "07-04"),
    **dict.fromkeys(("vegetation", "waterfront"), "07-05"),
    **dict.fromkeys(("straight_path", "moon_lake", "lava_tunnel"), "07-06"),
}
"""Month and day of the CalDe file that is valid for a recording (comments of the launch file)."""
DATASETS = {name: "s3li-etna" for name in ETNA} | {name: "s3li-vulcano" for name in VULCANO_DAYS}
PLAUSIBLE_BASELINE_M, PLAUSIBLE_FOCAL = (0.02, 1.0), (0.2, 5.0)
"""Metres, and focal lengths by the image's width: outside, units are wrong."""
SAME_SHARE, SAME_DEG = 0.005, 0.3
"""Calibrations that differ by less agree: half a per cent of a length, and degrees."""
RECTIFIED_SIZE = (688, 512)


@dataclass(frozen=True)
class StereoFile:
    """A stereo calibration from a file of the data set.

    Attributes:
        path: of the file.
        left, right: entries of `raw_camera` in a calibration file.
        left_T_right: (4, 4).
    """

    path: Path
    left: dict[str, Any]
    right: dict[str, Any]
    left_T_right: Array

    def __post_init__(self) -> None:
        low, high = PLAUSIBLE_BASELINE_M
        if not low <= self.baseline_m <= high:
            unit = "millimetres" if self.path.suffix == ".cal" else "metres"
            raise CalibrationError(f"{self.path}: a baseline of {self.baseline_m:.3g} m: are its lengths {unit}?")
        for side, one in (("left", self.left), ("right", self.right)):
            if not PLAUSIBLE_FOCAL[0] <= one["fx"] / max(one["width"], 1) <= PLAUSIBLE_FOCAL[1]:
                text = f"the {side} camera has a focal length of {one['fx']:.6g} for a width of {one['width']}"
                raise CalibrationError(f"{self.path}: {text}: expected pixels")

    @property
    def baseline_m(self) -> float:
        """Distance of the cameras."""
        return float(np.linalg.norm(self.left_T_right[:3, 3]))

    def entries(self) -> dict[str, Any]:
        """`raw_camera` of a calibration file."""
        shift, turn = self.left_T_right[:3, 3].tolist(), to_quaternion(self.left_T_right).tolist()
        pair = {"left": self.left, "right": self.right, "left_T_right": {"translation": shift, "quaternion": turn}}
        return {"raw_camera": pair | {"width": RECTIFIED_SIZE[0], "height": RECTIFIED_SIZE[1]}}


def read_calde(path: Path) -> StereoFile:
    """A `.cal` file of DLR CalDe: `camera.N.KEY=VALUE`, matrices as `[a b; c d]`, millimetres.

    R and T of camera 1 are its pose in camera 0.

    Raises:
        CalibrationError: the file is missing, cut, of other content, or in other units; one line.
    """
    cameras: dict[str, dict[str, str]] = {}
    try:
        lines = list(read_lines(path, BagError))
    except BagError as error:
        raise CalibrationError(str(error)) from None
    for line in lines:
        head, _, value = line.strip().partition("=")
        words = head.split(".", 2)
        if len(words) == 3 and words[0] == "camera" and value:
            cameras.setdefault(words[1], {})[words[2].strip()] = value.strip()
    if not {"0", "1"} <= set(cameras):
        raise CalibrationError(f"{path} is no calibration of CalDe: camera.0 and camera.1 are not both there")
    left, right = (_calde_camera(path, number, cameras[number], cameras) for number in ("0", "1"))
    turn = _numbers(path, "camera.1.R", cameras["1"].get("R"), 9).reshape(3, 3)
    shift = _numbers(path, "camera.1.T", cameras["1"].get("T"), 3)
    return StereoFile(path, left, right, _rigid(path, turn, shift / 1000))


def _calde_camera(
    path: Path, number: str, values: dict[str, str], cameras: dict[str, dict[str, str]]
) -> dict[str, Any]:
    matrix = _numbers(path, f"camera.{number}.A", values.get("A"), 9).reshape(3, 3)
    distortion = [
        float(_numbers(path, f"camera.{number}.{k}", values.get(k, "0"), 1)[0]) for k in ("k1", "k2", "p1", "p2")
    ]
    size = []
    for name in ("width", "height"):
        told = [values.get(name, "0"), *(one.get(name, "0") for one in cameras.values())]
        found = [float(_numbers(path, f"camera.{number}.{name}", text, 1)[0]) for text in told]
        size.append(int(next((one for one in found if one > 0), 0)))  # one of the two may say 0
    return _pinhole(size, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], distortion)


def _pinhole(
    size: Sequence[int], fx: float, fy: float, cx: float, cy: float, distortion: Sequence[float]
) -> dict[str, Any]:
    values = {"fx": float(fx), "fy": float(fy), "cx": float(cx), "cy": float(cy)}
    return {"width": int(size[0]), "height": int(size[1]), **values, "distortion": [float(one) for one in distortion]}


def _numbers(path: Path, name: str, text: str | None, count: int) -> Array:
    try:
        found = np.array((text or "").strip("[] ").replace(";", " ").replace(",", " ").split(), float)
    except ValueError:
        found = np.empty(0)
    if len(found) != count or not np.isfinite(found).all():
        told = "is missing" if text is None else f"is {text[:40]!r}"
        raise CalibrationError(f"{path}: {name} {told}: expected {count} number{'s' if count > 1 else ''}")
    return found


def _rigid(path: Path, turn: Array, shift: Array) -> Array:
    if np.abs(turn @ turn.T - np.eye(3)).max() > 1e-3 or np.linalg.det(turn) < 0:
        raise CalibrationError(f"{path}: the pose between the cameras holds no rotation")
    return make_pose(turn, shift)


def read_camchain(path: Path) -> StereoFile:
    """A Kalibr `camchain.yaml` of two pinhole cameras; metres.

    Raises:
        CalibrationError: the file is missing, cut, of other content, or in other units; one line.
    """
    try:
        content = read_yaml(path)
    except ConfigError as error:
        raise CalibrationError(str(error)) from None
    if not isinstance(content, dict) or not all(isinstance(content.get(name), dict) for name in ("cam0", "cam1")):
        raise CalibrationError(f"{path} is no camchain of Kalibr: cam0 and cam1 are not both there")
    left, right = (_camchain_camera(path, name, content[name]) for name in ("cam0", "cam1"))
    right_T_left = _pose(path, "cam1.T_cn_cnm1", content["cam1"].get("T_cn_cnm1"))
    return StereoFile(path, left, right, invert(right_T_left))


def _camchain_camera(path: Path, name: str, values: dict[str, Any]) -> dict[str, Any]:
    models = values.get("camera_model"), values.get("distortion_model")
    if models[0] != "pinhole" or models[1] not in ("radtan", "none"):
        raise CalibrationError(f"{path}: {name} is {models[0]}-{models[1]}; only pinhole-radtan can be read")
    found = {}
    for key, counts in (("intrinsics", (4,)), ("distortion_coeffs", (0, 4, 5)), ("resolution", (2,))):
        numbers = values.get(key, [])
        plain = isinstance(numbers, list) and all(isinstance(one, int | float) for one in numbers)
        if not plain or len(numbers) not in counts or not np.isfinite(np.array(numbers, float)).all():
            raise CalibrationError(f"{path}: {name}.{key} is {str(numbers)[:40]}: expected {counts[-1]} numbers")
        found[key] = numbers
    fx, fy, cx, cy = found["intrinsics"]
    return _pinhole(found["resolution"], fx, fy, cx, cy, found["distortion_coeffs"])


def _pose(path: Path, name: str, rows: Any) -> Array:
    try:
        pose = np.array(rows, float).reshape(4, 4)
    except (TypeError, ValueError):
        raise CalibrationError(f"{path}: {name} is no 4 x 4 matrix") from None
    return _rigid(path, pose[:3, :3], pose[:3, 3])


def contradictions(files: Sequence[StereoFile], names: Sequence[str], launch_baseline_m: float) -> list[str]:
    """Lines about calibrations that say different things, with both numbers.

    Args:
        files: calibrations of one rig.
        names: what each is called.
        launch_baseline_m: that of the launch file's transforms, which the package's own calibration holds.
    """
    told = []
    baselines = {"launch file": launch_baseline_m} | dict(zip(names, (one.baseline_m for one in files), strict=True))
    for name, value in list(baselines.items())[1:]:
        if abs(value / launch_baseline_m - 1) > SAME_SHARE:
            percent = 100 * (value / launch_baseline_m - 1)
            told.append(
                f"the stereo baseline is {launch_baseline_m:.5f} m by the launch file and {value:.5f} m by {name} "
                f"({percent:+.1f} %)"
            )
    for (name, one), (another, other) in pairwise(zip(names, files, strict=True)):
        share = other.left["fx"] / one.left["fx"] - 1
        turn_deg = np.degrees(rotation_angle(invert(one.left_T_right) @ other.left_T_right))
        if abs(share) > SAME_SHARE:
            focal = f"{one.left['fx']:.1f} px by {name} and {other.left['fx']:.1f} px by {another}"
            told.append(f"fx of the left camera is {focal} ({100 * share:+.1f} %)")
        if turn_deg > SAME_DEG:
            told.append(f"{name} and {another} differ by {turn_deg:.2f} deg in how the cameras are turned")
    return told


Pair = tuple[str, str, float]


def read_pairs(path: Path) -> list[Pair]:
    """The toolkit's list of pairs of images that see the same ground, and the share of it.

    Raises:
        UmfError: the file is damaged, empty, of other columns, or its shares are none; one line.
    """
    content = load_pickle(path)
    if not isinstance(content, list) or not content:
        raise UmfError(f"{path} is no list of overlapping pairs")
    for row in content:
        if not isinstance(row, tuple | list) or len(row) != 3 or not all(isinstance(one, str) for one in row[:2]):
            raise UmfError(f"{path}: expected rows (image, image, overlap), found {str(row)[:60]}")
        if not isinstance(row[2], int | float | np.floating) or not 0 <= row[2] <= 1.001:
            raise UmfError(f"{path}: an overlap of {str(row[2])[:20]}: expected a share between 0 and 1")
    return [(str(row[0]), str(row[1]), float(row[2])) for row in content]


def image_key(path: str) -> str:
    """Sequence and name of an image at `.../SEQUENCE/images/NAME`, which are the same on any machine."""
    parts = Path(path).parts
    return "/".join((parts[-3], parts[-1])) if len(parts) >= 3 else path


@dataclass
class S3liSequence:
    """The files of one sequence; None and empty where there are none.

    Attributes:
        name: as published.
        recording: ROS 1 bag, or what rosbags-convert made of it.
        export: folder of VSLAM-LAB's export.
        odometry: trajectory of the IMU, TUM.
        truth: files of positions by satellites that may be of its time.
        pickle: the toolkit's samples.
        calibrations: stereo calibrations that hold for it, the best first.
        missing: lines about what is not there, and what that costs.
    """

    name: str
    recording: Path | None = None
    export: Path | None = None
    odometry: Path | None = None
    truth: list[Path] = field(default_factory=list)
    pickle: Path | None = None
    calibrations: list[Path] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)

    @property
    def dataset(self) -> str:
        """s3li-etna or s3li-vulcano."""
        return DATASETS[self.name]

    @property
    def there(self) -> bool:
        """Whether there is anything of it."""
        return any((self.recording, self.export, self.pickle))


@dataclass(frozen=True)
class S3liFolder:
    """A download.

    Attributes:
        root: where it lies.
        sequences: those of which there is anything, in the order of publication.
        pairs: the toolkit's list of pairs by data set.
        absent: names of the sequences of which there is nothing.
    """

    root: Path
    sequences: list[S3liSequence]
    pairs: dict[str, Path]
    absent: list[str]


def find_s3li(root: Path) -> S3liFolder:
    """Find everything of S3LI below a folder, in the layouts of Etna, Vulcano, the toolkit and VSLAM-LAB.

    Raises:
        UmfError: there is no folder, or nothing of S3LI in it.
    """
    if not root.is_dir():
        raise UmfError(f"there is no folder {root}")
    files = [path for path in sorted(root.rglob("*")) if path.is_file() and path.suffix != ".png"]
    found = [_sequence(name, files) for name in DATASETS]
    there = [one for one in found if one.there]
    if not there:
        raise UmfError(f"{root} holds no recording of S3LI: expected {ETNA[0]}.bag, capo_grillo.bag or the like")
    lists = [path for path in files if path.suffix == ".pkl" and "pairs" in path.stem]
    pairs = {}
    for dataset, word in (("s3li-etna", "etna"), ("s3li-vulcano", "vulcano")):
        named = [path for path in lists if word in path.stem.lower()]
        if named:
            pairs[dataset] = named[0]
    return S3liFolder(root, there, pairs, [one.name for one in found if not one.there])


def _sequence(name: str, files: list[Path]) -> S3liSequence:
    one = S3liSequence(name)
    recordings = [path for path in files if path.stem == name and path.suffix in (".bag", ".mcap", ".db3")]
    converted = [path.parent for path in files if path.name == "metadata.yaml" and path.parent.name == name]
    one.recording = next(iter([*recordings[:1], *converted]), None)
    exports = [path.parent for path in files if path.name == "rgb.csv" and path.parent.name in (name, f"{name}_raw")]
    one.export = next(iter(exports), None)
    trajectories = [path for path in files if path.suffix == ".txt" and path.parent.name == name and _is_eval(path)]
    one.odometry = min(trajectories, key=lambda path: ("basalt" not in str(path).lower(), str(path)), default=None)
    one.pickle = next((path for path in files if path.name == f"{name}.pkl"), None)
    positions = [path for path in files if path.suffix == ".pos" and "baseline" not in path.stem]
    own = [path for path in positions if name in (path.parent.name, path.stem)]
    shared = [path for path in positions if path.parent.name.lower() == "d-gnss"]
    one.truth = own or (shared if one.dataset == "s3li-vulcano" else [])
    if one.dataset == "s3li-vulcano":
        day = VULCANO_DAYS[name]
        one.calibrations = [path for path in files if path.suffix == ".cal" and day in path.stem]
        one.calibrations += [path for path in files if path.suffix in (".yaml", ".yml") and "camchain" in path.stem]
    one.missing = list(_missing(one)) if one.there else []
    return one


def _is_eval(path: Path) -> bool:
    return any(part.lower() == "eval" for part in path.parts)


def _missing(one: S3liSequence) -> Iterator[str]:
    if one.recording is None:
        what = "closures by images alone, from the export" if one.export else "nothing is replayed"
        yield f"{one.name}: no recording: {what}"
    if one.odometry is None:
        yield f"{one.name}: no trajectory below Eval: closures only, no pose graph, no error of a trajectory"
    if not one.truth:
        yield f"{one.name}: no positions by satellites (.pos): nothing can be judged"
    if one.pickle is None:
        yield f"{one.name}: no {one.name}.pkl of the toolkit: MPRF's protocol is left out"
    if one.dataset == "s3li-vulcano" and not one.calibrations:
        yield f"{one.name}: neither .cal nor camchain: intrinsics are nominal, depth by stereo is not to be trusted"


def truth_of(one: S3liSequence, start_ns: int, end_ns: int) -> tuple[Path, Trajectory] | None:
    """The file of positions that covers most of a recording's time, and what it holds; None where none does.

    Raises:
        BagError: a file is damaged; names the line.
    """
    best: tuple[int, Path, Trajectory] | None = None
    for path in one.truth:
        track = read_rtklib(path)
        within = int(((track.stamps_ns >= start_ns) & (track.stamps_ns <= end_ns)).sum())
        if within and (best is None or within > best[0]):
            best = within, path, track
    return best[1:] if best else None


def read_stereo(path: Path) -> StereoFile:
    """A stereo calibration by the kind of its file; raises as `read_calde` and `read_camchain`."""
    return read_calde(path) if path.suffix == ".cal" else read_camchain(path)
