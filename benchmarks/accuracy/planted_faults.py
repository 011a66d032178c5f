"""Plants ten faults in recordings or their settings, and prints the first sentence of each report.

    python benchmarks/accuracy/planted_faults.py data/demo_seed1.mcap --out /tmp/planted
    python benchmarks/accuracy/planted_faults.py data/demo_seed1.mcap --offsets  # what clocks are measured to be off
    python benchmarks/accuracy/planted_faults.py *.mcap --good  # what is said of recordings as they are
    python benchmarks/accuracy/planted_faults.py *.mcap --axes  # when impossible axes are named

Each run must name its own fault, and the run without a fault none.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.presets import settings_for
from umf_ros.bags.reader import Bag, RawMessage, message_types, open_bag, open_files
from umf_ros.bags.trajectories import read_ground_truth
from umf_ros.core.config import Settings, load_preset, load_settings, topics_of
from umf_ros.core.frames import Frame
from umf_ros.core.geometry import from_quaternion, make_pose, to_quaternion
from umf_ros.core.trajectory import Trajectory, write_tum
from umf_ros.lab.evaluation.inspection import check_sensors
from umf_ros.lab.program import UMF, run
from umf_ros.lab.simulation.bag_writer import BagWriter
from umf_ros.runs.findings import about_sensors
from umf_ros.sensors.decode import decode_pose
from umf_ros.sensors.sensor_check import SensorCheck

Change = Callable[[str, Any], Any]
"""From topic and message to the message that is recorded instead; None drops it."""


CLOCK_OFF_S = 0.5


TURN_DEG = 10.0


@dataclass
class Planted:
    """A fault and where it is planted.

    Attributes:
        name: of the fault.
        words: that the first sentence of the report must have.
        change: of the messages, or None.
        calibration: changes the content of the calibration file, or None.
        settings: further settings.
        options: further options of `umf replay`.
    """

    name: str
    words: tuple[str, ...]
    change: Change | None = None
    calibration: Callable[[dict[str, Any]], None] | None = None
    settings: dict[str, Any] = field(default_factory=dict)
    options: Callable[[Bag, Path], list[str]] = lambda bag, folder: []


def faults(settings: Settings) -> list[Planted]:
    """The ten faults, and none."""
    topics = topics_of(settings)

    def without_clouds(topic: str, message: Any) -> Any:
        return None if topic == topics.cloud else message

    def weak_intensity(topic: str, message: Any) -> Any:
        if topic == topics.cloud:
            field_of = next(one for one in message.fields if one.name == "intensity")
            records = np.frombuffer(message.data, np.uint8).reshape(-1, message.point_step).copy()
            numbers = records[:, field_of.offset : field_of.offset + 4].copy().view("<u4")
            weak = np.minimum(numbers, 10 + numbers % 5).astype("<u4")  # all below the calibration's 15
            records[:, field_of.offset : field_of.offset + 4] = weak.view(np.uint8)
            message.data = records.ravel()
        return message

    def empty_right(topic: str, message: Any) -> Any:
        if topic == topics.right_image:
            message.data = np.full_like(np.asarray(message.data), 7)
        return message

    def long_baseline(topic: str, message: Any) -> Any:
        if topic == topics.right_info:
            projection = np.array(message.p)
            projection[3] *= 1.5
            message.p = projection
        return message

    return [
        Planted("none", ()),
        Planted("no cloud", ("no scans on", topics.cloud), without_clouds),
        Planted("wrong intensity", ("min_intensity",), weak_intensity),
        Planted("wrong extrinsics", ("LiDAR's mounting is off by", "deg"), calibration=_turned),
        Planted("clock offset", ("LiDAR's clock is about +", "s off"), _late({topics.cloud}, CLOCK_OFF_S)),
        Planted("gap rules", ("gap rules exclude every pair",), settings={"loop": {"min_time_gap_s": 3600.0}}),
        Planted("wrong odometry frame", ("odometry is not that of the body",), options=_camera_poses),
        Planted("empty right image", ("right images are empty",), empty_right),
        Planted("wrong baseline", ("baseline is wrong",), long_baseline, calibration=_long),
        Planted("all closures pending", ("all closures are pending",), options=_short_odometry),
        Planted("truth of another clock", ("ground truth has another clock",), options=_other_clock),
    ]


def _lidar_axes(topic_of_cloud: str, axes: np.ndarray) -> Change:
    def change(topic: str, message: Any) -> Any:
        if topic == topic_of_cloud:
            records = np.frombuffer(message.data, np.uint8).reshape(-1, message.point_step).copy()
            places = [next(one.offset for one in message.fields if one.name == name) for name in "xyz"]
            points = np.hstack([records[:, at : at + 4].copy().view("<f4") for at in places]) @ axes.T
            for at, column in zip(places, points.astype("<f4").T, strict=True):
                records[:, at : at + 4] = np.ascontiguousarray(column)[:, None].view(np.uint8)
            message.data = records.ravel()
        return message

    return change


def axes_faults(settings: Settings) -> list[Planted]:
    """Impossible axes and mountings, and none; the words are those of the contradiction."""
    topics = topics_of(settings)
    down, mirrored, exchanged = np.diag([1.0, -1, -1]), np.diag([1.0, -1, 1]), np.eye(3)[[0, 2, 1]]
    optical = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])

    def lidar(axes: np.ndarray) -> Change:
        return _lidar_axes(topics.cloud, axes)

    def never(pose: np.ndarray) -> np.ndarray:
        return make_pose(np.eye(3), pose[:3, 3])

    def odometry(turn: Callable[[np.ndarray], np.ndarray]) -> Change:
        def change(topic: str, message: Any) -> Any:
            if topic == topics.odometry:
                pose, at, q = (
                    turn(decode_pose(message.pose.pose)),
                    message.pose.pose.position,
                    message.pose.pose.orientation,
                )
                at.x, at.y, at.z = map(float, pose[:3, 3])
                q.x, q.y, q.z, q.w = map(float, to_quaternion(pose))
                turning = message.twist.twist.angular  # would be integrated in place of a constant orientation
                turning.x = turning.y = turning.z = 0.0
            return message

        return change

    def other_axes(axes: np.ndarray) -> Change:
        around = make_pose(axes, np.zeros(3))
        return odometry(lambda pose: around @ pose @ around.T)

    def camera(turn: Callable[[np.ndarray], np.ndarray]) -> Callable[[dict[str, Any]], None]:
        def change(calibration: dict[str, Any]) -> None:
            pose = calibration["body_T_camera"]
            wrong = turn(from_quaternion((0, 0, 0), pose["quaternion"])[:3, :3])
            pose["quaternion"] = [float(one) for one in to_quaternion(make_pose(wrong, np.zeros(3)))]

        return change

    def about(axis: str, degrees: float) -> np.ndarray:
        return Rotation.from_euler(axis, degrees, degrees=True).as_matrix()

    off, seen = ("LiDAR's mounting is off",), ("camera's mounting is off",)
    return [
        Planted("none", ()),
        Planted("LiDAR upside down", off, lidar(down)),
        Planted("LiDAR off by 90 deg", off, lidar(about("z", 90))),
        Planted("LiDAR off by 45 deg", off, lidar(about("x", 45))),
        Planted("LiDAR off by 20 deg", off, lidar(about("z", 20))),
        Planted("LiDAR with optical axes", off, lidar(optical)),
        Planted("LiDAR left-handed", ("LiDAR's axes are left-handed",), lidar(mirrored)),
        Planted("LiDAR y and z exchanged", ("LiDAR's axes are left-handed",), lidar(exchanged)),
        Planted("odometry NED", ("odometry is not that of the body",), other_axes(down)),
        Planted("odometry optical", ("odometry is not that of the body",), other_axes(optical.T)),
        Planted("odometry left-handed", ("odometry's axes are left-handed",), other_axes(mirrored)),
        Planted("odometry never turns", ("orientation is constant",), odometry(never)),
        Planted(
            "camera off by 90 deg", ("camera's mounting is off",), calibration=camera(lambda it: it @ about("z", 90))
        ),
        Planted("camera with body axes", seen, calibration=camera(lambda it: np.eye(3))),
    ]


def first_contradiction(bag: Bag, fault: Planted, folder: Path, seconds: float) -> tuple[float, str]:
    """Return when (s after the first frame) and how a fault is named within so many seconds; infinity if it is not."""
    settings = settings_for(bag, None, "auto")
    if fault.calibration is not None:
        settings = load_settings(plant(fault, bag, {}, folder)[2])
    check, start_ns, named = SensorCheck(), None, (math.inf, "")
    stream = FrameReader(ChangedBag(bag, fault.change or (lambda _, message: message)), settings).stream()
    for frame in (item for item in stream if isinstance(item, Frame)):
        start_ns = start_ns or frame.stamp_ns
        if (after_s := (frame.stamp_ns - start_ns) * 1e-9) > seconds:
            break
        check.take(frame)
        what = "; ".join(one.what for one in check.contradictions)
        named = (min(named[0], after_s), what) if what else (math.inf, "")
    return named


def _late(topics: set[str], seconds: float) -> Change:
    """Stamps the messages of some topics later than they were measured."""

    def change(topic: str, message: Any) -> Any:
        if topic in topics:
            late = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec + round(seconds * 1e9)
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(late, 10**9)
        return message

    return change


def _turned(calibration: dict[str, Any]) -> None:
    pose = calibration["body_T_lidar"]
    half = np.radians(TURN_DEG) / 2
    turn = from_quaternion((0, 0, 0), (0, 0, np.sin(half), np.cos(half)))
    wrong = turn @ from_quaternion((0, 0, 0), pose["quaternion"])
    pose["quaternion"] = [float(value) for value in to_quaternion(wrong)]


def _long(calibration: dict[str, Any]) -> None:
    if "camera" in calibration:
        calibration["camera"]["baseline"] *= 1.5
    else:
        across = calibration["raw_camera"]["left_T_right"]
        across["translation"] = [1.5 * metres for metres in across["translation"]]


def _odometry(bag: Bag) -> Trajectory:
    found = [
        (message.header.stamp.sec * 10**9 + message.header.stamp.nanosec, decode_pose(message.pose.pose))
        for _, _, message in bag.messages(["/odom"])
    ]
    return Trajectory(np.array([stamp for stamp, _ in found], np.int64), np.stack([pose for _, pose in found]))


def _camera_poses(bag: Bag, folder: Path) -> list[str]:
    """Odometry of the camera's optical frame, said to be the body's."""
    optical = from_quaternion((0.3, 0.1, 1.2), (-0.5, 0.5, -0.5, 0.5))
    body = _odometry(bag)
    write_tum(folder / "camera.tum", Trajectory(body.stamps_ns, np.linalg.inv(optical) @ body.poses @ optical))
    return ["--odometry", str(folder / "camera.tum")]


def _short_odometry(bag: Bag, folder: Path) -> list[str]:
    """Odometry that ends before the first place is seen again."""
    whole = _odometry(bag)
    early = whole.stamps_ns < whole.stamps_ns[0] + (whole.stamps_ns[-1] - whole.stamps_ns[0]) // 3
    write_tum(folder / "short.tum", Trajectory(whole.stamps_ns[early], whole.poses[early]))
    return ["--odometry", str(folder / "short.tum")]


def _other_clock(bag: Bag, folder: Path) -> list[str]:
    truth = read_ground_truth(bag)
    if truth is None:
        truth = _odometry(bag)
    write_tum(folder / "truth.tum", Trajectory(truth.stamps_ns - 10**18, truth.poses))
    return ["--ground-truth", str(folder / "truth.tum")]


def plant(fault: Planted, bag: Bag, base: dict[str, Any], folder: Path) -> list[str]:
    """Write what the fault needs into the folder; returns the arguments of `umf replay`."""
    folder.mkdir(parents=True, exist_ok=True)
    path = bag.path
    if fault.change is not None:
        path = folder / "planted.mcap"
        with BagWriter(path) as writer:
            for topic, log_ns, message in bag.messages():
                changed = fault.change(topic, message)
                if changed is not None:
                    writer.write(topic, changed, log_ns)
    dataset = settings_for(bag, None, "auto").dataset
    settings = {**base, **fault.settings}
    if fault.calibration is not None:
        right = Path(base.get("calibration") or load_preset(dataset).calibration)
        content = yaml.safe_load(right.read_text(encoding="utf-8"))
        fault.calibration(content)
        (folder / "calibration.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
        settings["calibration"] = str(folder / "calibration.yaml")
    settings["dataset"] = dataset
    (folder / "config.yaml").write_text(yaml.safe_dump(settings), encoding="utf-8")
    return [str(path), "--config", str(folder / "config.yaml"), *fault.options(bag, folder)]


def first_sentences(path: Path, out: Path, base: dict[str, Any], only: str = "") -> Iterator[tuple[Planted, int, str]]:
    """Run every fault whose name holds `only`; gives it with the exit status and the report's first sentence."""
    bag = open_bag(path)
    for fault in faults(settings_for(bag, None, "auto")):
        if only not in fault.name:
            continue
        folder = out / fault.name.replace(" ", "_")
        arguments = plant(fault, bag, base, folder)
        done = run((*UMF, "replay", *arguments, "--out", str(folder / "runs")))
        report = folder / "runs" / "latest" / "report.html"
        page = report.read_text(encoding="utf-8") if report.is_file() else ""
        (folder / "console.txt").write_text(done.output, encoding="utf-8")
        yield fault, done.status, first_sentence(page) if page else done.output.strip()


def first_sentence(page: str) -> str:
    """The verdict up to its first full stop."""
    from html import unescape

    verdict = page.split('<p class="verdict', 1)[1].split(">", 1)[1].split("</p>", 1)[0]
    return unescape(verdict).split(". ")[0]


class ChangedBag(Bag):
    """A recording whose messages are changed as they are read."""

    def __init__(self, bag: Bag, change: Change) -> None:
        super().__init__(bag.path, open_files(bag.path))
        self._change = change

    def raw_messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Serialised messages, changed."""
        types = message_types()
        for raw in super().raw_messages(topics):
            message = self._change(raw.topic, types.deserialize_cdr(raw.data, raw.type))
            yield replace(raw, data=bytes(types.serialize_cdr(message, raw.type)))


def measured_offset(bag: Bag, sensor: str, seconds: float) -> float | None:
    """By how much a sensor's clock is said to be off when it is off by so many seconds; None where nothing is said."""
    settings = settings_for(bag, None, "auto")
    topics = topics_of(settings)
    images = {topics.left_image, topics.right_image, topics.left_info, topics.right_info}
    seen = check_sensors(ChangedBag(bag, _late({topics.cloud} if sensor == "lidar" else images, seconds)), settings)
    found = seen.lidar if sensor == "lidar" else seen.camera
    return None if found is None or found.lag_s is None else -found.lag_s


def print_findings(path: Path) -> bool:
    """Print the findings about a recording's sensors; return whether there are none."""
    bag = open_bag(path)
    settings = settings_for(bag, None, "auto")
    seen = check_sensors(bag, settings)
    found = [one.what for one in about_sensors(seen)]
    print(f"{path.stem}: {'; '.join(found) or 'nothing wrong'} ({seen.lidar}, {seen.camera})", flush=True)
    return not found


OFFSETS_S = (-1.0, -0.5, -0.2, -0.1, 0.0, 0.1, 0.2, 0.5, 1.0)


def print_offsets(path: Path, sensors: Sequence[str]) -> bool:
    """Print planted and measured offsets; returns whether all are within a tenth of a second."""
    bag, good = open_bag(path), True
    for sensor in sensors:
        for seconds in OFFSETS_S:
            found = measured_offset(bag, sensor, seconds)
            good &= found is not None and abs(found - seconds) < 0.1
            told = "nothing said" if found is None else f"{found:+.2f} s measured"
            print(f"{path.stem} {sensor}: {seconds:+.1f} s planted, {told}", flush=True)
    return good


def print_axes(path: Path, out: Path, only: str) -> bool:
    """Print when impossible axes are named; returns whether all are before the first closure, and none without one."""
    bag, wrong = open_bag(path), 0
    settings = settings_for(bag, None, "auto")
    for fault in axes_faults(settings):
        if only not in fault.name:
            continue
        after_s, what = first_contradiction(bag, fault, out / "axes", settings.loop.min_time_gap_s)
        right = all(word in what for word in fault.words) and bool(what) == bool(fault.words)
        wrong += not right
        print(f"{'ok  ' if right else 'MISS'} {path.stem} {fault.name}: {after_s:.1f} s, {what or '-'}", flush=True)
    return not wrong


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bags", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, default=Path("results/planted_faults"))
    parser.add_argument("--only", default="", help="faults whose names contain this")
    parser.add_argument("--settings", default="{}", help="further settings as JSON")
    parser.add_argument("--offsets", action="store_true", help="only measure clock offsets of -1 to 1 s")
    parser.add_argument("--sensors", default="lidar,camera", help="sensors whose clocks are shifted")
    parser.add_argument("--good", action="store_true", help="only check recordings without faults")
    parser.add_argument("--axes", action="store_true", help="only check when impossible axes are named")
    given = parser.parse_args()
    if given.axes:
        sys.exit(not all([print_axes(path, given.out / path.stem, given.only) for path in given.bags]))
    if given.offsets:
        sys.exit(not all([print_offsets(path, given.sensors.split(",")) for path in given.bags]))
    if given.good:
        sys.exit(not all([print_findings(path) for path in given.bags]))
    sys.exit(not all([print_faults(path, given.out / path.stem, given) for path in given.bags]))


def print_faults(path: Path, out: Path, given: argparse.Namespace) -> bool:
    """Print the first sentence of every fault's report; returns whether all are named, and none where there is none."""
    named = total = wrong = 0
    for fault, status, sentence in first_sentences(path, out, json.loads(given.settings), given.only):
        right = all(word.lower() in sentence.lower() for word in fault.words) and bool(fault.words or status == 0)
        named, total = named + (right and fault.name != "none"), total + (fault.name != "none")
        wrong += not right
        print(f"{'ok  ' if right else 'MISS'} {status} {fault.name}: {sentence}", flush=True)
    print(f"{path.stem}: {named} of {total} faults named")
    return not wrong


if __name__ == "__main__":
    main()
