"""Frames of a recording, in order."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import numpy as np

from umf_ros.absolute.measurement import ABSOLUTE_TYPES, AbsoluteDecoder, AbsoluteMeasurement, Aid
from umf_ros.bags.inputs import present_topics
from umf_ros.bags.presets import GROUND_TRUTH_TOPIC
from umf_ros.bags.reader import Bag, RawMessage, decode, stamp_span
from umf_ros.bags.trajectories import decode_ground_truth
from umf_ros.core import watchdog
from umf_ros.core.config import Settings, Topics, topics_of
from umf_ros.core.errors import BagError, MessageError, either
from umf_ros.core.frames import Frame
from umf_ros.core.trajectory import Trajectory
from umf_ros.embedding import check_inputs
from umf_ros.sensors.calibration import calibration_of
from umf_ros.sensors.decode import TYPES, OdometrySample, stamp_ns
from umf_ros.sensors.router import MessageRouter, wanted_inputs
from umf_ros.sensors.sessions import ODOMETRY, Input
from umf_ros.sensors.synchronizer import InputCounter, Synchronizer
from umf_ros.sensors.tf import MOVING_TOPIC, BodyFrames, StaticTransforms, constant_transforms, transform_topics

_log = logging.getLogger(__name__)

IMU_HINT = "; an IMU is no odometry: leave topics.odometry empty for that of the scans, or give --odometry FILE.tum"


class FrameReader:
    """Frames of a recording, read once, with counts of its messages.

    Messages that cannot be used are counted and skipped, the first of each kind with a warning. Inputs without a topic
    in the recording are not waited for. `progress` is the part of the recording that was read, 0 to 1.
    """

    def __init__(
        self,
        bag: Bag,
        settings: Settings,
        odometry: Trajectory | None = None,
        warn: Callable[[str], None] = _log.warning,
    ) -> None:
        """Take the odometry from a trajectory instead of the recording's topic, if given.

        Raises:
            BagError: there are neither images nor scans, they have other types, or the trajectory covers another time.
            CalibrationError: the calibration cannot be read.
            ConfigError: the embedding method reads only images, or only scans, and there are none.
        """
        topics = _checked_topics(bag, settings)
        check_inputs(settings.embedding.method, bag.path, bool(topics.left_image), bool(topics.cloud))
        if odometry is not None:
            _check_overlap(odometry, bag, {topics.cloud, topics.left_image})
            topics = topics.model_copy(update={"odometry": ""})
        inputs = wanted_inputs(topics) | ({ODOMETRY} if odometry is not None else set())
        calibration = calibration_of(settings)
        self.progress = 0.0
        self._bag, self._odometry, self._rows_taken = bag, odometry, 0
        self._synchronizer = Synchronizer(settings.sync, calibration, inputs, warn)
        self._samples: list[OdometrySample | AbsoluteMeasurement] = []
        self._truth: list[RawMessage] = []
        transforms = read_transforms(bag, calibration.is_open) if settings.uses_transforms else StaticTransforms()
        known = transforms.version or calibration.is_open
        frames = BodyFrames(settings.frames, transforms, warn, 0.0, calibration) if known else None
        self._router = MessageRouter(self._synchronizer, topics, warn, self._samples.append, frames)
        self._absolute = _absolute_topics(settings, bag)
        find = frames.pose_of if frames is not None else lambda _: None
        self._decoder = AbsoluteDecoder(calibration.antenna, calibration.body_T_imu, find)
        if bag.warning:
            warn(bag.warning)

    @property
    def counters(self) -> dict[Input, InputCounter]:
        """Used and dropped messages of each input."""
        return self._synchronizer.counters

    def __iter__(self) -> Iterator[Frame]:
        """Yield frames in the order of their stamps."""
        return (item for item in self.stream() if isinstance(item, Frame))

    @property
    def ground_truth(self) -> Trajectory | None:
        """The recording's ground truth as far as `stream` was read; None without; raises a `BagError`."""
        return decode_ground_truth(self._bag, self._truth)

    def stream(self) -> Iterator[Frame | OdometrySample | AbsoluteMeasurement]:
        """Yield odometry and absolute measurements in their order, and the frames when they are complete."""
        for raw in self._bag.raw_messages([*self._router.topics, *self._absolute, GROUND_TRUTH_TOPIC]):
            watchdog.feed()
            if raw.topic == GROUND_TRUTH_TOPIC:
                self._truth.append(raw)
                continue
            with self._router.refusing(raw.topic):
                self._take(raw.topic, decode(raw))
            self.progress = (raw.log_ns - self._bag.start_ns) / max(1, self._bag.end_ns - self._bag.start_ns)
            yield from self._samples
            self._samples.clear()
            yield from self._synchronizer.pop()
        yield from self._synchronizer.flush()

    def _take(self, topic: str, message: Any) -> None:
        if topic in self._absolute:
            measurement = self._decoder.decode(self._absolute[topic], message, stamp_ns(message))
            self._samples += [] if measurement is None else [measurement]
        else:
            self._add_odometry(message)
            self._router.take(topic, message)

    def _add_odometry(self, message: Any) -> None:
        """Add the poses of the trajectory up to the message's stamp that were not added before."""
        if self._odometry is None:
            return
        with suppress(MessageError):  # the router reports it
            end = int(np.searchsorted(self._odometry.stamps_ns, stamp_ns(message), side="right"))
            for row in range(self._rows_taken, end):
                sample = OdometrySample(int(self._odometry.stamps_ns[row]), self._odometry.poses[row])
                self._router.take_odometry(sample)
            self._rows_taken = max(self._rows_taken, end)


def read_transforms(bag: Bag, also_repeated: bool = False) -> StaticTransforms:
    """Return the static transforms of a recording, published at any time, as they are latched, in any namespace.

    Where there are none, those on `/tf` that never change can be taken.
    """
    transforms = StaticTransforms()
    for _, _, message in bag.messages(transform_topics(bag.types)):
        transforms.add(message)
    if transforms.version or not also_repeated:
        return transforms
    return constant_transforms(message for _, _, message in bag.messages(transform_topics(bag.types, MOVING_TOPIC)))


def _absolute_topics(settings: Settings, bag: Bag) -> dict[str, Aid]:
    """Return the topics of absolute measurements; raise a `BagError` if a named one is missing or of another type."""
    found = {}
    for source, topic in ((Aid.GNSS, settings.absolute.gnss), (Aid.GRAVITY, settings.absolute.imu)):
        if not topic:
            continue
        info = bag.topics.get(topic)
        if info is None or info.type != ABSOLUTE_TYPES[source]:
            others = ", ".join(name for name, one in bag.topics.items() if one.type == ABSOLUTE_TYPES[source])
            text = f"{bag.path}: no {ABSOLUTE_TYPES[source]} on {topic}"
            raise BagError(f"{text} (topics of that type: {others or 'none'})")
        found[topic] = source
    return found


def _checked_topics(bag: Bag, settings: Settings) -> Topics:
    """Return the topics with messages in the recording; the others empty.

    Raises:
        BagError: a topic is of another type than expected, or there are neither images nor scans.
    """
    for name, topic in topics_of(settings).model_dump().items():
        info = bag.topics.get(topic)
        if info is not None and info.type not in TYPES[name]:
            text = f"{bag.path}: {topic} is of type {info.type}, expected {either(TYPES[name])}"
            raise BagError(text + (IMU_HINT if info.type == "sensor_msgs/msg/Imu" else ""))
    present = present_topics(bag, settings)
    if not present.left_image and not present.cloud:
        raise BagError(f"{bag.path} has neither images nor scans on the expected topics; see --dataset and --config")
    return present


def _check_overlap(odometry: Trajectory, bag: Bag, topics: set[str]) -> None:
    first_ns, last_ns = stamp_span(bag, topics)
    if odometry.stamps_ns[-1] < first_ns or odometry.stamps_ns[0] > last_ns:
        seconds = " to ".join(f"{stamp * 1e-9:.1f}" for stamp in (odometry.stamps_ns[0], odometry.stamps_ns[-1]))
        recorded = f"{first_ns * 1e-9:.1f} to {last_ns * 1e-9:.1f}"
        raise BagError(f"the odometry file covers none of the recording: {seconds} s against {recorded} s")
