"""Files beside S3LI's bags: positions by satellites, trajectories, calibrations, the toolkit's pickles and pairs."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
import yaml

from umf_ros.core.errors import writing
from umf_ros.core.geometry import Array, from_quaternion, heading, invert, to_quaternion, transform, wrap_angle
from umf_ros.core.io import atomic_write, write_atomically
from umf_ros.core.resources import find
from umf_ros.core.trajectory import Trajectory, write_tum
from umf_ros.lab.simulation.bag_writer import CLOUD_TYPE
from umf_ros.lab.simulation.lidar import Layout
from umf_ros.lab.simulation.motion_sensors import GnssTrack, measure_gnss, rtklib_text, to_geodetic
from umf_ros.lab.simulation.simulator import CLOUD_TOPIC, START_NS, Simulator, stamp_ns

SAMPLE_M = 0.8
"""Way between the toolkit's samples."""
TOOLKIT_ROOTS = {True: "/home_local/giub_ri/s3li-etna", False: "/home_local/giub_ri/s3li-vulcano"}
"""Where images lay when the toolkit wrote its pickles, on another machine."""
ODOMETRY_DIRECTORIES = {True: "Eval/BASALT", False: "eval/rvio2"}
IMAGE_SCALE = 0.25
CAMCHAIN = "cfgs/kalibr_stereo_inertial_calibration/vulcano_stereorgb_imu_lidar_2023-07-05-17-43-18-camchain.yaml"
IMU_T_LEFT = from_quaternion((0.00749803, 0.25481334, 0.00961434), (-0.50047531, 0.50210171, -0.50009389, 0.49731723))
LEFT_T_LIDAR = from_quaternion((0.15, -0.02, -0.02), (0.72531834, -0.0018133, -0.00172103, 0.68840908))
"""TF of Vulcano's launch file: yaw -0.005, roll 1.623 rad."""
LAUNCH_BASELINE_M, EXPORT_BASELINE_M = 0.0892, 0.09066
TOOLKIT_CAMERA_T_LIDAR = from_quaternion((0.1, 0.0, 0.0), (0.711917, -0.0208134, -0.00745561, 0.701916))
"""With Etna's correction of the yaw left out; the toolkit uses it on Vulcano too."""
VISIBLE_M, WIDEST_TURN_DEG, APART_S, LEAST_OVERLAP = (3.0, 20.0), 45.0, 30.0, 0.5
"""Of the toolkit's pairs."""


@dataclass(frozen=True, slots=True)
class Disorders:
    """Faults of the originals; each can be left out.

    Attributes:
        late_scans: Etna's scans are stamped 0.1 s too early.
        dummies: pulses without a return are points at 1 m.
        right_lost: some right images are missing.
        gps_time: positions are in GPS time, 18 s ahead of UTC.
        missing_fixes: there are seconds without a position.
        poor_fixes: some positions are of float or single solutions.
        imu_frame: trajectories are of the IMU, not of the body or the camera.
        gaps: trajectories have gaps.
        drift: trajectories drift.
        imu_rate: a YAML file says 100 Hz of an IMU of 400.
        baseline: the stereo baseline is not the one of the launch file.
    """

    late_scans: bool = True
    dummies: bool = True
    right_lost: bool = True
    gps_time: bool = True
    missing_fixes: bool = True
    poor_fixes: bool = True
    imu_frame: bool = True
    gaps: bool = True
    drift: bool = True
    imu_rate: bool = True
    baseline: bool = True


def write_vulcano_rig(area: Path, seed: int, baseline: bool = True) -> Path:
    """Write the calibration that Vulcano's drives are simulated with, intrinsics drawn by seed; returns its path.

    The cameras' axes are those of the simulated rover; LiDAR and IMU are mounted to them as the launch file says.
    """
    rng = np.random.default_rng([seed, 21])
    content = yaml.safe_load(find("config/calibration/simulated_vulcano.yaml").read_text(encoding="utf-8"))
    for side in ("left", "right"):
        fx, centre = 1739 * rng.uniform(0.97, 1.03), rng.normal((1031.5, 771.5), 12)
        distortion = rng.normal((-0.1, 0.08, 0, 0), (0.01, 0.01, 4e-4, 4e-4))
        values = {"width": 2064, "height": 1544, "fx": fx, "fy": fx * rng.normal(1, 5e-4)}
        values |= {"cx": centre[0], "cy": centre[1], "distortion": distortion.tolist()}
        content["raw_camera"][side] = {name: _plain(value) for name, value in values.items()}
    shift = np.array(content["raw_camera"]["left_T_right"]["translation"])
    shift *= (EXPORT_BASELINE_M if baseline else LAUNCH_BASELINE_M) / np.linalg.norm(shift)
    content["raw_camera"]["left_T_right"]["translation"] = shift.tolist()
    body_T_left = from_quaternion(content["body_T_camera"]["translation"], content["body_T_camera"]["quaternion"])
    for name, pose in (("body_T_lidar", body_T_left @ LEFT_T_LIDAR), ("body_T_imu", body_T_left @ invert(IMU_T_LEFT))):
        content[name] = {"translation": pose[:3, 3].tolist(), "quaternion": to_quaternion(pose).tolist()}
    path = area.parent / "truth" / f"{area.name}.yaml"
    _write_text(path, yaml.safe_dump(content, sort_keys=False))
    return path


def _plain(value: Any) -> Any:
    return float(value) if isinstance(value, np.floating) else value


def _write_text(path: Path, text: str) -> None:
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, text)


class Samples:
    """The toolkit's samples of one drive: watches the messages as they are written, and keeps some images and scans."""

    def __init__(self, simulator: Simulator, name: str, files: SideFiles) -> None:
        self._simulator, self._folder = simulator, files.area / "dataset" / name / "images"
        self._layout, self._develop = files.layout, files.develop
        self._next_m = 0.0
        self.images: list[tuple[int, Any]] = []
        self.points: dict[int, Array] = {}

    def watch(self, topic: str, message: Any) -> None:
        """Look at a message of the drive's own clock."""
        stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        if topic == self._layout.images[0]:
            driven = float(self._simulator.motion.path_length((stamp - START_NS) * 1e-9))
            if driven >= self._next_m:
                self._next_m = driven + SAMPLE_M
                picture = np.asarray(message.data).reshape(message.height, message.width)
                self.images.append((stamp, self._develop(picture)))
        elif topic == CLOUD_TOPIC and self.images:
            taken = stamp + self._layout.scan_behind_ns
            if abs(taken - self.images[-1][0]) < 50_000_000:
                records = np.asarray(message.data).view(CLOUD_TYPE)
                kept = (records["intensity"] > 15) & (np.abs(records["z"]) < 7)
                points = np.stack([records[axis][kept] for axis in "xyz"], 1)
                self.points[self.images[-1][0]] = transform(TOOLKIT_CAMERA_T_LIDAR, points).astype(np.float32)

    def save(self, shift_ns: int) -> list[tuple[int, str, Array]]:
        """Write the images with a scan; returns their stamps, their names and the points (N, 3) in the camera."""
        found = []
        self._folder.mkdir(parents=True, exist_ok=True)
        for stamp, picture in self.images:
            if stamp in self.points:
                name = f"img{(stamp + shift_ns) * 1e-9:.6f}.png"
                cv2.imwrite(str(self._folder / name), picture)
                found.append((stamp, name, self.points[stamp]))
        return found


class SideFiles:
    """Writes all that is not a bag.

    Attributes:
        area: folder of Etna or Vulcano.
        layout: of its recordings.
        develop: makes the toolkit's picture of a published one.
    """

    def __init__(self, area: Path, etna: bool, seed: int, layout: Layout, disorders: Disorders) -> None:
        self.area, self.layout = area, layout
        self._etna, self._seed, self._disorders = etna, seed, disorders
        self._calibration = layout.load()
        self._fov_deg = 2 * np.degrees(np.arctan(688 / 2 / 579.5))
        self._rows: list[tuple[int, str, Array, float]] = []
        self._tracks: dict[str, str] = {}
        self.develop: Callable[[Any], Any] = (lambda picture: picture.copy()) if etna else self._undistorting()

    def bag(self, name: str) -> Path:
        """Path of a recording."""
        return self.area / ("Bagfiles" if self._etna else "bagfiles") / f"{name}.bag"

    def write(self, name: str, simulator: Simulator, shift_ns: int, samples: Samples) -> None:
        """Write the files of one sequence, whose stamps are `shift_ns` later than the drive's own."""
        rng = np.random.default_rng([self._seed, 22, len(self._rows)])
        track = self._positions(simulator, rng)
        self._write_track(name, track, shift_ns)
        trajectory = self._write_trajectory(name, simulator, shift_ns, rng)
        columns: dict[str, list[Any]] = {column: [] for column in COLUMNS}
        for stamp, image, points in samples.save(shift_ns):
            slam, known = trajectory.at(np.array([stamp + shift_ns]))
            nearest = int(np.abs(track.times_s - (stamp - START_NS) * 1e-9).argmin())
            if not known[0] or abs(track.times_s[nearest] - (stamp - START_NS) * 1e-9) > 1.0:
                continue
            folder = f"{TOOLKIT_ROOTS[self._etna]}/dataset/{name}"
            pose = simulator.pose(stamp)
            yaw = float(heading(pose))
            x, y, z, w = to_quaternion(slam[0])
            row = [name, (stamp + shift_ns) * 1e-9, f"{folder}/images/{image}", f"{folder}/overlays/{image}", points]
            row += [*track.geodetic[nearest].tolist(), yaw, [w, x, y, z], slam[0, :3, 3].tolist()]
            for column, value in zip(COLUMNS, row, strict=True):
                columns[column].append(value)
            self._rows.append((stamp + shift_ns, str(row[2]), pose[:2, 3], yaw))
        write_data_frame(self.area / "dataset" / name / f"{name}.pkl", columns)

    def finish(self) -> None:
        """Write what is of all sequences: calibrations and pairs that see the same ground."""
        for day, text in self._tracks.items():
            _write_text(self.area / "d-gnss" / f"{day}.pos", text)
        (self._write_etna_cfgs if self._etna else self._write_vulcano_cfgs)()
        stamps = np.array([row[0] for row in self._rows], float) * 1e-9
        places = np.array([row[2] for row in self._rows]).reshape(-1, 2)
        # Web Mercator's metres are longer than true ones away from the equator
        places = places / np.cos(np.radians(to_geodetic(np.zeros((1, 3)))[0, 0]))
        yaws = np.array([row[3] for row in self._rows])
        pairs = [
            (self._rows[i][1], self._rows[j][1], overlap)
            for i, j, overlap in overlapping_pairs(stamps, places, yaws, self._fov_deg)
        ]
        with atomic_write(self.area / "dataset" / f"{self.area.name}_pairs.pkl") as part:
            part.write_bytes(pickle.dumps(pairs, protocol=4))

    def _positions(self, simulator: Simulator, rng: np.random.Generator) -> GnssTrack:
        area = np.random.default_rng([self._seed, 23])
        antenna = self._calibration.body_T_imu[:3, 3] + [*area.uniform(-0.04, 0.04, 2), area.uniform(0.1, 0.4)]
        track = measure_gnss(simulator.motion, simulator.duration_s, simulator.seed, antenna)
        times, quality, geodetic = track.times_s, track.quality.copy(), track.geodetic.copy()
        deviation, kept = track.deviation_m.copy(), np.full(len(times), True)
        if not self._disorders.poor_fixes:
            clean = simulator.motion.poses(times)
            geodetic = to_geodetic(clean[:, :3, 3] + clean[:, :3, :3] @ antenna + rng.normal(0, 0.012, (len(times), 3)))
            quality, deviation = np.ones_like(quality), np.full(len(times), 0.012)
        else:
            start = rng.uniform(0.2, 0.8) * times[-1]
            single = (times > start) & (times < start + 3)
            quality[single], deviation[single] = 5, 2.5
            geodetic[single] += rng.normal(0, (2e-5, 2e-5, 4), (int(single.sum()), 3))
        if self._disorders.missing_fixes:
            for _ in range(1 + int(times[-1] // 200)):
                start = rng.uniform(0, times[-1])
                kept &= (times < start) | (times > start + rng.uniform(1, 6))
        return GnssTrack(times[kept], geodetic[kept], deviation[kept], quality[kept])

    def _write_track(self, name: str, track: GnssTrack, shift_ns: int) -> None:
        ahead_s = 18 if self._disorders.gps_time else 0
        text = rtklib_text(track, START_NS + shift_ns, weeks=not self._etna, ahead_s=ahead_s)
        if self._etna:
            _write_text(self.area / "GT" / name / "global_lle.pos", text)
            return
        day = f"{datetime.fromtimestamp((START_NS + shift_ns) * 1e-9, UTC):%Y-%m-%d}"
        self._tracks[day] = self._tracks.get(day, "") + text

    def _write_trajectory(self, name: str, simulator: Simulator, shift_ns: int, rng: np.random.Generator) -> Trajectory:
        run, calibration = simulator.odometry, self._calibration
        body_T_sensor = calibration.body_T_imu if self._disorders.imu_frame else calibration.body_T_camera
        kept = run.times_s > 0.4
        if self._disorders.gaps:
            for length_s in rng.uniform(0.3, 3.0, 1 + int(run.times_s[-1] // 300)):
                start = rng.uniform(0.1, 0.9) * run.times_s[-1]
                kept &= (run.times_s < start) | (run.times_s > start + length_s)
        stamps = np.array([stamp_ns(time_s) + shift_ns for time_s in run.times_s[kept]], np.int64)
        trajectory = Trajectory(stamps, run.poses[kept] @ body_T_sensor)
        path = self.area / ODOMETRY_DIRECTORIES[self._etna] / name / f"{name}.txt"
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        write_tum(path, trajectory)
        return trajectory

    def _write_etna_cfgs(self) -> None:
        camera = self._calibration.camera
        for number, side in enumerate(("left", "right")):
            numbers = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
            none = dict.fromkeys(("k1", "k2", "p1", "p2"), 0)
            content = {"model_type": "PINHOLE", "camera_name": f"camera_{side}", "image_width": camera.width}
            content |= {"image_height": camera.height, "distortion_parameters": none, "projection_parameters": numbers}
            text = yaml.safe_dump(content, sort_keys=False)
            _write_text(self.area / "Cfgs" / f"cam{number}_pinhole.yaml", f"%YAML:1.0\n---\n{text}")
        imu_T_camera = invert(self._calibration.body_T_imu) @ self._calibration.body_T_camera
        rate = 100 if self._disorders.imu_rate else 400
        text = f"%YAML:1.0\nCamera.fx: {camera.fx}\nCamera.bf: {camera.fx * camera.baseline}\nIMU.Frequency: {rate}\n"
        data = ", ".join(f"{value:.8f}" for value in imu_T_camera.ravel())
        text += f"IMU.NoiseGyro: 1e-4\nTbc: !!opencv-matrix\n   rows: 4\n   cols: 4\n   dt: f\n   data: [{data}]\n"
        _write_text(self.area / "Cfgs" / "orbslam_config.yaml", text)

    def _write_vulcano_cfgs(self) -> None:
        rate = 100 if self._disorders.imu_rate else 400
        _write_text(self.area / "cfgs" / "calibration.yaml", f"%YAML:1.0\nIMU.Frequency: {rate}.0\n")
        content = yaml.safe_load(Path(self.layout.calibration).read_text(encoding="utf-8"))["raw_camera"]
        left_T_right = from_quaternion(*content["left_T_right"].values())
        rng = np.random.default_rng([self._seed, 24])
        for day in ("2023-07-04", "2023-07-05", "2023-07-06"):
            _write_text(self.area / "cfgs" / f"{day}.cal", _calde_text(content, left_T_right, rng))
        chain = {}
        for number, side in enumerate(("left", "right")):
            one = content[side]
            T_cam_imu = invert(IMU_T_LEFT if number == 0 else IMU_T_LEFT @ left_T_right)
            entry = {"T_cam_imu": T_cam_imu.tolist(), "camera_model": "pinhole", "distortion_model": "radtan"}
            entry |= {"distortion_coeffs": one["distortion"], "intrinsics": [one[k] for k in ("fx", "fy", "cx", "cy")]}
            entry |= {"resolution": [one["width"], one["height"]], "rostopic": self.layout.images[number]}
            entry["timeshift_cam_imu"] = 0.009
            chain[f"cam{number}"] = entry | ({"T_cn_cnm1": invert(left_T_right).tolist()} if number else {})
        _write_text(self.area / CAMCHAIN, yaml.safe_dump(chain, sort_keys=False))

    def _undistorting(self) -> Callable[[Any], Any]:
        """As the toolkit shrinks and undistorts Vulcano's left images."""
        one = yaml.safe_load(Path(self.layout.calibration).read_text(encoding="utf-8"))["raw_camera"]["left"]
        matrix = np.array([[one["fx"], 0, one["cx"]], [0, one["fy"], one["cy"]], [0, 0, 1]])
        distortion, size = np.array(one["distortion"]), (one["width"], one["height"])
        wider, _ = cv2.getOptimalNewCameraMatrix(matrix, distortion, size, 1, size)
        self._fov_deg = 2 * np.degrees(np.arctan(size[0] / 2 / wider[0, 0]))
        wider = wider * np.array([[IMAGE_SCALE], [IMAGE_SCALE], [1.0]])
        small = (int(size[0] * IMAGE_SCALE), int(size[1] * IMAGE_SCALE))
        maps = cv2.initUndistortRectifyMap(matrix, distortion, np.eye(3), wider, small, cv2.CV_32FC1)
        return lambda raw: cv2.remap(cv2.cvtColor(raw, cv2.COLOR_BayerRG2RGB), *maps, cv2.INTER_LINEAR)


def _calde_text(content: dict[str, Any], left_T_right: Array, rng: np.random.Generator) -> str:
    """A calibration of DLR CalDe: the right camera's pose in the left one, in millimetres."""
    lines = ["# DLR CalLab"]
    for number, (side, pose) in enumerate((("left", np.eye(4)), ("right", left_T_right))):
        one = content[side]
        shift = 1000 * pose[:3, 3] * rng.normal(1, 2e-4)
        turn = "; ".join(" ".join(f"{value:.9f}" for value in row) for row in pose[:3, :3])
        fx, fy, cx, cy = (one[name] for name in ("fx", "fy", "cx", "cy"))
        k1, k2, p1, p2 = one["distortion"]
        entries = {"A": f"[{fx} 0 {cx}; 0 {fy} {cy}; 0 0 1]", "k1": k1, "k2": k2, "p1": p1, "p2": p2}
        entries |= {"R": f"[{turn}]", "T": "[" + " ".join(f"{value:.6f}" for value in shift) + "]"}
        entries |= {"width": one["width"], "height": one["height"]}
        lines += [f"camera.{number}.{name}={value}" for name, value in entries.items()]
    return "\n".join(lines) + "\n"


def overlapping_pairs(stamps_s: Array, places: Array, yaws: Array, fov_deg: float) -> list[tuple[int, int, float]]:
    """Ordered pairs of views that share ground, as the toolkit counts them, and the share.

    Args:
        stamps_s: (N,) s.
        places: (N, 2) m.
        yaws: (N,) rad from east, counter-clockwise.
        fov_deg: horizontal field of view.
    """
    found = []
    for i in range(len(stamps_s)):
        near = np.linalg.norm(places - places[i], axis=1) < 2 * VISIBLE_M[1] / np.cos(np.radians(fov_deg / 2))
        near &= np.abs(stamps_s - stamps_s[i]) >= APART_S
        near &= np.abs(wrap_angle(yaws - yaws[i])) <= np.radians(WIDEST_TURN_DEG)
        for j in np.flatnonzero(near):
            overlap = view_overlap(places[i], yaws[i], places[j], yaws[j], fov_deg)
            if overlap > LEAST_OVERLAP:
                found.append((i, int(j), overlap))
    return found


def view_overlap(place: Array, yaw: float, other: Array, other_yaw: float, fov_deg: float) -> float:
    """Share of the ground between 3 and 20 m before one view that the other sees too, as a share of one's area."""
    if abs(wrap_angle(yaw - other_yaw)) > np.radians(WIDEST_TURN_DEG):
        return 0.0
    area, _ = cv2.intersectConvexConvex(
        _ground_seen(place * 0, yaw, fov_deg), _ground_seen(other - place, other_yaw, fov_deg)
    )
    near, far = VISIBLE_M
    return float(area / (np.tan(np.radians(fov_deg / 2)) * (far**2 - near**2)))


def _ground_seen(place: Array, yaw: float, fov_deg: float) -> Any:
    """(4, 2) float32 corners, m."""
    slope = np.tan(np.radians(fov_deg / 2))
    corners = np.array(
        [[d, side * d * slope] for d, side in zip((*VISIBLE_M, *VISIBLE_M[::-1]), (1, 1, -1, -1), strict=True)]
    )
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    return (corners @ turn.T + place).astype(np.float32)


COLUMNS = (
    *("seq_name", "time_stamp", "img_path", "overlay", "point_cloud", "latitude", "longitude", "elevation"),
    *("orientation", "slam_orientation", "slam_position"),
)
"""Of the toolkit's DataFrame."""
_NUMBERS = ("time_stamp", "latitude", "longitude", "elevation", "orientation")


class _Name:
    """Stands for a class or function of pandas, which need not be installed."""

    def __init__(self, module: str, name: str) -> None:
        self.module, self.name = module, name

    def __call__(self) -> None:
        """Do nothing: only its name is written."""


@dataclass(frozen=True)
class _Made:
    """An object that pandas makes of arguments, and of a state."""

    by: _Name
    arguments: tuple[Any, ...]
    state: Any = None

    def __reduce__(self) -> tuple[Any, ...]:
        return (self.by, self.arguments) if self.state is None else (self.by, self.arguments, self.state)


class _FramePickler(pickle._Pickler):
    """Writes names of pandas as they are."""

    dispatch: ClassVar[dict[Any, Any]] = dict(pickle._Pickler.dispatch)

    def _save_name(self, name: _Name) -> None:
        self.write(pickle.GLOBAL + f"{name.module}\n{name.name}\n".encode())  # type: ignore[attr-defined]

    dispatch[_Name] = _save_name


def write_data_frame(path: Path, columns: dict[str, list[Any]]) -> None:
    """Write columns as `pandas.DataFrame.to_pickle` does (pandas 2)."""
    names = list(columns)
    count = len(next(iter(columns.values())))
    unpickled, blocks = _Name("pandas._libs.internals", "_unpickle_block"), []
    for chosen, kind in ((_NUMBERS, float), (tuple(name for name in names if name not in _NUMBERS), object)):
        values = np.empty((len(chosen), count), kind)
        for row, name in enumerate(chosen):
            for place, value in enumerate(columns[name]):
                values[row, place] = value
        rows = np.array([names.index(name) for name in chosen], np.int64)
        blocks.append(_Made(unpickled, (values, rows, 2)))
    index, new = "pandas.core.indexes.base", _Name("pandas.core.indexes.base", "_new_Index")
    heads = np.empty(len(names), object)
    heads[:] = names
    axes = [_Made(new, (_Name(index, "Index"), {"data": heads, "name": None}))]
    numbered = {"name": None, "start": 0, "stop": count, "step": 1}
    axes.append(_Made(new, (_Name("pandas.core.indexes.range", "RangeIndex"), numbered)))
    manager = _Made(_Name("pandas.core.internals.managers", "BlockManager"), (tuple(blocks), axes))
    state = {
        "_mgr": manager,
        "_typ": "dataframe",
        "_metadata": [],
        "attrs": {},
        "_flags": {"allows_duplicate_labels": True},
    }
    with atomic_write(path) as part, part.open("wb") as stream:
        _FramePickler(stream, 4).dump(_Made(_Name("pandas.core.frame", "DataFrame"), (), state))
