"""Contents of a recording, and whether a replay would work."""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.inputs import Advice, absent_inputs, input_counts, present_topics, useless_inputs
from umf_ros.bags.presets import detect_dataset, settings_for
from umf_ros.bags.reader import Bag, decode
from umf_ros.core.config import AUTO, ParameterSource, Settings, Topics, load_preset, load_settings
from umf_ros.core.errors import BagError, MessageError, UmfError, command_line, either, printable
from umf_ros.core.frames import Frame
from umf_ros.core.trajectory import Trajectory, bracket
from umf_ros.lab.imported import OPTICAL, pose_entry, with_notes
from umf_ros.runs.findings import gap_remedy
from umf_ros.sensors.calibration import TO_BE_MEASURED, load_calibration
from umf_ros.sensors.decode import OdometrySample, decode_camera_info, decode_cloud, decode_image, decode_pose, stamp_ns
from umf_ros.sensors.sensor_check import SensorCheck, SensorReport
from umf_ros.sensors.tf import StaticTransforms
from umf_ros.sensors.topic_finder import find_topics

SAMPLES = 20
"""Messages of a topic that are decoded."""
FRAMES = 20
"""First frames that are read as a replay reads them."""
FEW_PAIRS = 0.5
"""Share of the scans with an image, by hand, below which something is wrong."""

LATE_S = 0.5
"""By hand: difference between the delays of two sensors that is reported; a scan takes up to 0.2 s."""
ENGINE = "vgicp"
BODIES = ("base_link", "base_footprint", "body", "imu_link")
RAW = "camera: the images look raw: rectify them, or see raw_camera in config/calibration/s3li_vulcano.yaml"


@dataclass
class Inspected:
    """Findings about a recording.

    Attributes:
        settings: that a replay would have, or that those of a parameter file by `umf inspect --write` would be.
        topics: those of its inputs that the recording has; empty for others.
        ambiguous: topics of inputs for which several fit, and no parameter names one.
        unknown: why a replay needs such a file; empty where it does without.
        found: words about each input, by its name in `Topics`, and about `pairs` of scan and image.
        messages: the first usable one of each input, by its name in `Topics`; of the first topic where several fit.
        is_live: whether the topics are those of a running robot.
        advice: what is wrong or missing, with what helps.
    """

    settings: Settings
    topics: Topics
    ambiguous: dict[str, list[str]] = field(default_factory=dict)
    unknown: str = ""
    found: dict[str, str] = field(default_factory=dict)
    messages: dict[str, Any] = field(default_factory=dict)
    is_live: bool = False
    advice: list[Advice] = field(default_factory=list)

    @property
    def fault(self) -> Advice | None:
        """Why no replay can find anything; None where one can."""
        return next((one for one in self.advice if one.severity == "fault"), None)


def inspect(bag: Bag, source: ParameterSource = None, for_file: bool = False, is_live: bool = False) -> Inspected:
    """Look at a recording as a replay with these parameters would: its topics, their messages, and the first frames.

    `for_file` takes topics by their type also where the recording lacks those of its data set, to write them. Some
    seconds of a running robot (`is_live`) may be too short for a closure.

    Raises:
        ConfigError: the parameters are wrong.
    """
    found = _settings_of(bag, source)
    found.is_live = is_live
    if for_file:
        by_type = find_topics(bag.types)[0].model_dump().items()
        named = load_settings(source).topics.model_fields_set
        lacking = {name: topic for name, topic in by_type if name not in named and not getattr(found.topics, name)}
        found.topics = found.topics.model_copy(update=lacking)
    for name, fits in found.ambiguous.items():
        again = ("doctor", "--live") if is_live else ("inspect", bag.path)
        command = command_line(*again, "--set", f"topics.{name}={fits[0]}")
        found.advice.append(Advice("fault", f"several topics fit {name}: {either(fits)}", f"name one: {command}"))
    _read_samples(bag, found)
    for rule in (_about_inputs, _about_frames, _about_odometry, _about_pairs, _about_clocks, _about_gaps):
        found.advice += rule(bag, found)
    return found


def _settings_of(bag: Bag, source: ParameterSource) -> Inspected:
    """Return the settings and topics of a replay, or those that a first parameter file would have."""
    settings, unknown = load_settings(source), ""
    named, (by_type, several) = settings.topics.model_fields_set, find_topics(bag.types)
    try:
        settings, several = settings_for(bag, source, AUTO), {}
    except UmfError as error:
        own = {name: getattr(settings.topics, name) for name in named}
        several = {name: fits for name, fits in several.items() if name not in named}
        settings, unknown = settings.model_copy(update={"topics": by_type.model_copy(update=own)}), str(error)
        if not several and not isinstance(error, BagError):
            raise
    return Inspected(settings, present_topics(bag, settings), several, unknown)


def _read_samples(bag: Bag, found: Inspected) -> None:
    """Decode the first messages of each input and tell what they are."""
    topics = found.topics.model_dump() | {name: fits[0] for name, fits in found.ambiguous.items()}
    names = {topic: name for name, topic in topics.items() if topic}
    left: dict[str, int] = dict.fromkeys(names, SAMPLES)
    faults: dict[str, str] = {}
    for raw in bag.raw_messages(list(names)):
        name = names[raw.topic]
        if left[raw.topic] <= 0:
            if not any(left.values()):
                break
            continue
        left[raw.topic] -= 1
        try:
            message = decode(raw)
            found.found[name] = _DESCRIBE[name](message)
            found.messages[name], left[raw.topic] = message, 0
        except MessageError as error:
            faults[name] = str(error)
    for name, fault in faults.items():
        if name not in found.found:
            topic = getattr(found.topics, name)
            found.advice.append(Advice("fault", f"{topic}: {fault}", "no message of the first ones can be used"))


def _image_words(message: Any) -> str:
    image = decode_image(message)
    kind = getattr(message, "encoding", "") or message.format
    return f"{image.shape[1]} x {image.shape[0]}, {kind}, grey values vary by {image.std():.0f}"


def _cloud_words(message: Any) -> str:
    cloud = decode_cloud(message)
    words = [f"{len(cloud.points)} returns"]
    words.append("no intensity" if cloud.intensity is None else f"intensity up to {cloud.intensity.max(initial=0):.4g}")
    times = cloud.time_offset_ns
    span_s = 0.0 if times is None or not len(times) else float(np.ptp(times)) * 1e-9
    words.append("no time per point" if times is None else f"{span_s:.2f} s per scan")
    return ", ".join(words)


def _info_words(message: Any) -> str:
    camera = decode_camera_info(message)
    distorted = np.any(np.asarray(message.d, float))
    model = f", with distortion ({printable(message.distortion_model)})" if distorted else ""
    return f"{camera.width} x {camera.height}, fx {camera.fx:.1f}{model}"


def _odometry_words(message: Any) -> str:
    stamp_ns(message), decode_pose(message.pose.pose)
    child, parent = (printable(name) or "no named frame" for name in (message.child_frame_id, message.header.frame_id))
    return f"of {child} in {parent}"


_DESCRIBE: dict[str, Any] = {
    "left_image": _image_words,
    "right_image": _image_words,
    "cloud": _cloud_words,
    "left_info": _info_words,
    "right_info": _info_words,
    "odometry": _odometry_words,
}


def _about_inputs(bag: Bag, found: Inspected) -> Iterator[Advice]:
    topics = found.topics
    if not topics.left_image and not topics.cloud and not found.ambiguous:
        yield Advice("fault", "neither images nor scans", "nothing to recognise a place by")
    yield from absent_inputs(bag, found.settings, odometry_from_file=True)
    if topics.left_image and not topics.left_info and found.unknown:
        yield Advice("note", "no camera_info: the calibration must say the intrinsics")


def _about_frames(bag: Bag, found: Inspected) -> Iterator[Advice]:
    """Read the first frames as a replay does, which tells what it would say."""
    if found.unknown or not (found.topics.left_image or found.topics.cloud):
        return
    told: list[str] = []
    try:
        reader = FrameReader(bag, found.settings, warn=told.append)
        frames = list(islice(reader, FRAMES))
    except UmfError as error:
        yield Advice("fault", str(error))
        return
    yield from (Advice("warning", text) for text in told if text != bag.warning)
    has_depth = any(one.points is not None or (one.left is not None and one.right is not None) for one in frames)
    for one in useless_inputs(input_counts(reader.counters)):
        yield replace(one, severity="warning") if has_depth else one


def _about_odometry(bag: Bag, found: Inspected) -> Iterator[Advice]:
    if not found.topics.odometry:
        imu = [topic for topic, info in bag.topics.items() if info.type == "sensor_msgs/msg/Imu"]
        also = f"; {imu[0]} is an IMU, which is no odometry" if imu else ""
        if found.topics.cloud and found.is_live:
            made = f"loop_closure_node makes it from {found.topics.cloud} (odometry.engine: {ENGINE})"
            yield Advice("note", f"no odometry{also}: {made}")
        elif found.topics.cloud and (apart_s := _period_s(bag, found)) > found.settings.sync.max_odometry_gap_s:
            what = f"no odometry{also}, and scans {apart_s:.1f} s apart, from which none can be made"
            yield Advice("warning", what, "are the stamps in seconds? --odometry FILE.tum gives that of another system")
        elif found.topics.cloud:
            what = f"no odometry{also}: umf replay, umf slam and umf map make it from {found.topics.cloud} (vgicp)"
            yield Advice("note", what, "--odometry FILE.tum takes that of another system")
        else:
            remedy = "publish its poses" if found.is_live else "give its poses with --odometry FILE.tum"
            what = f"no odometry: closures only, the pose graph is skipped{also}"
            yield Advice("warning", what, f"run one (Basalt on the images) and {remedy}")


def _period_s(bag: Bag, found: Inspected) -> float:
    return bag.duration_s / max(bag.topics[found.topics.cloud].count - 1, 1)


def _stamps(bag: Bag, topics: Collection[str]) -> dict[str, NDArray[np.int64]]:
    """Return (N, 2) stamps and times of recording in ns, by topic of messages with a header."""
    found: dict[str, list[tuple[int, int]]] = {topic: [] for topic in topics if topic}
    for raw in bag.raw_messages(list(found)):
        seconds, nanoseconds = struct.unpack_from("<iI" if raw.data[1] & 1 else ">iI", raw.data, 4)
        found[raw.topic].append((seconds * 10**9 + nanoseconds, raw.log_ns))
    return {topic: np.array(rows, np.int64) for topic, rows in found.items()}


def _about_pairs(bag: Bag, found: Inspected) -> Iterator[Advice]:
    """How many scans will have an image, by their stamps alone."""
    topics, slop_s = found.topics, found.settings.sync.slop_s
    if not topics.left_image or not topics.cloud:
        return
    stamps = _stamps(bag, (topics.left_image, topics.cloud))
    scans, images = stamps[topics.cloud][:, 0], np.sort(stamps[topics.left_image][:, 0])
    before, after, _ = bracket(images, scans)
    away_ns = np.minimum(np.abs(scans - images[before]), np.abs(scans - images[after]))
    pairs, median_s = int((away_ns <= slop_s * 1e9).sum()), float(np.median(away_ns)) * 1e-9
    told = f"{pairs} of {len(scans)} scans have an image within {slop_s:g} s, {median_s:.3f} s in the median"
    found.found["pairs"] = told
    if pairs < FEW_PAIRS * len(scans):
        what = f"only {pairs} of {len(scans)} scans have an image, {median_s:.2f} s away in the median"
        yield Advice("warning" if pairs else "fault", what, "two clocks? sync.slop_s, or the driver's stamps")


def _about_clocks(bag: Bag, found: Inspected) -> Iterator[Advice]:
    """Compare how long after their stamps the messages of a running robot arrive."""
    inputs = [topic for name, topic in found.topics.model_dump().items() if not name.endswith("info")]
    stamps = _stamps(bag, inputs) if found.is_live else {}
    late_s = {topic: float(np.median(rows[:, 1] - rows[:, 0])) * 1e-9 for topic, rows in stamps.items()}
    first = min(late_s, key=lambda topic: late_s[topic], default="")
    for topic, delay_s in late_s.items():
        if (behind_s := delay_s - late_s[first]) > LATE_S:
            what = f"stamps of {topic} are {behind_s:.1f} s behind those of {first}"
            yield Advice("warning", what, "two clocks? synchronise them, or correct the driver's stamps")


def _about_gaps(bag: Bag, found: Inspected) -> Iterator[Advice]:
    settings = found.settings
    if not bag.duration_s:
        yield Advice("fault", "all messages have the same time", "record when each was taken")
    elif bag.duration_s < settings.loop.min_time_gap_s and not found.is_live:
        gap = f"loop.min_time_gap_s, {settings.loop.min_time_gap_s:g} s"
        what = f"{bag.duration_s:.1f} s are shorter than {gap}: no match is allowed"
        has_odometry = found.topics.odometry or found.topics.cloud  # of the scans
        remedy = gap_remedy(bag.duration_s, None if has_odometry else 0.0, settings)
        yield Advice("fault", what, f"drive longer, or set {remedy}")


def write_settings(found: Inspected, calibration: str) -> str:
    """A first parameter file: the topics, and the calibration beside it; an input without a topic is left out by ""."""
    notes = ["Found by umf inspect; docs/parameters.md lists everything that may stand here."]
    notes += [f"topics.{name}: one of {', '.join(fits)}" for name, fits in found.ambiguous.items()]
    topics = {name: topic for name, topic in found.topics.model_dump().items() if name not in found.ambiguous}
    parameters: dict[str, Any] = {"calibration": calibration, "topics": topics}
    if found.topics.cloud and not found.topics.odometry:
        parameters["odometry"] = {"engine": ENGINE}
    return with_notes(notes, {"/**": {"ros__parameters": parameters}}, flow=False)


def calibration_of_dataset(found: Inspected, bag: Bag) -> Path | None:
    """File of the data set that a recording is of; None where there is none, or its images have another size."""
    try:
        name = detect_dataset(bag)
    except BagError:
        return None
    image = found.messages.get("left_image")
    size = None if image is None else decode_image(image).shape[::-1]
    return load_preset(name).calibration if size in (None, load_calibration(name).image_size) else None


def write_calibration(found: Inspected, transforms: StaticTransforms) -> str:
    """A first calibration: intrinsics of the camera_info, mountings of /tf_static, and what has to be measured.

    It has entries of the sensors that the recording has.
    """
    frames = {name: printable(message.header.frame_id) for name, message in found.messages.items()}
    named = [frames[name] for name in ("cloud", "left_image") if frames.get(name)]
    bodies = [body for frame in named for body in BODIES if transforms.find(body, frame) is not None]
    notes = ["Written by umf inspect. Metres, quaternions x y z w; poses in the body frame (x ahead, y left, z up)."]
    entries: dict[str, Any] = {}
    if "left_image" in frames:
        entries["camera"], note = _camera(found)
        notes += [note] if note else []
    for key, name, usual in (("body_T_camera", "left_image", OPTICAL), ("body_T_lidar", "cloud", np.eye(4))):
        if name in frames:
            known = transforms.find(bodies[0], frames[name]) if bodies and frames[name] else None
            source = f"{key}: of {frames[name]} in {bodies[0]}, by static transforms" if known is not None else ""
            notes.append(source or f"{TO_BE_MEASURED}: {key}")
            entries[key] = pose_entry(usual if known is None else known)
    offsets = {"lidar_time_offset_s": 0.0, "min_intensity": 0.0, "max_height_m": 0.0}
    return with_notes(notes, entries | {"body_T_imu": pose_entry(np.eye(4))} | offsets)


def _camera(found: Inspected) -> tuple[dict[str, Any], str]:
    """Return the entry `camera` of a calibration and a note about it."""
    left, right = (found.messages.get(name) for name in ("left_info", "right_info"))
    names = ("width", "height", "fx", "fy", "cx", "cy", "baseline")
    if left is None:
        height, width = decode_image(found.messages["left_image"]).shape
        numbers = width, height, 0.8 * width, 0.8 * width, width / 2, height / 2, 0.0
        return dict(zip(names, numbers, strict=True)), f"{TO_BE_MEASURED}: camera"
    try:
        camera = decode_camera_info(left, right)
    except MessageError:
        camera = decode_camera_info(left)
    raw = np.any(np.asarray(left.d, float)) and "rect" not in found.topics.left_image
    return {name: getattr(camera, name) for name in names}, RAW if raw else ""


def check_sensors(
    bag: Bag, settings: Settings, odometry: Trajectory | None = None, instead: Trajectory | None = None
) -> SensorReport:
    """Check the sensors of a recording against its odometry.

    Args:
        bag: the recording.
        settings: to read it with.
        odometry: that of a file, which replaces that of the recording.
        instead: odometry for a recording without any.
    """
    check, samples = SensorCheck(), list[OdometrySample]()
    for item in FrameReader(bag, settings, odometry, warn=lambda _: None).stream():
        if isinstance(item, Frame):
            check.take(item)
        elif isinstance(item, OdometrySample):
            samples.append(item)
    return check.report(Trajectory.rising(one[:2] for one in samples) or instead)
