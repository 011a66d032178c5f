"""Route messages into the synchronizer: the same live and offline."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from umf_ros.core.config import Topics
from umf_ros.core.errors import MessageError, printable
from umf_ros.sensors.decode import (
    GreyRange,
    OdometrySample,
    decode_camera_info,
    decode_cloud,
    decode_image,
    stamp_ns,
    window_of,
)
from umf_ros.sensors.odometry import OdometryDecoder
from umf_ros.sensors.point_times import PointTimes
from umf_ros.sensors.sessions import ODOMETRY, Input
from umf_ros.sensors.synchronizer import SILENCE_NS, Synchronizer
from umf_ros.sensors.tf import BodyFrames

_INPUTS: dict[str, Input] = {
    "left_image": "left",
    "right_image": "right",
    "cloud": "cloud",
    "odometry": ODOMETRY,
    "left_info": "camera_info",
    "right_info": "camera_info",
}
"""The input of every topic, by its name in `Topics`."""


EARLY_IMAGES = 60
"""Most images that wait for their first camera_info."""


def wanted_inputs(topics: Topics) -> set[Input]:
    """Return the inputs of the synchronizer for which there is a topic; the right camera_info alone does not count."""
    return {name for entry, name in _INPUTS.items() if getattr(topics, entry) and entry != "right_info"}


class MessageRouter:
    """Decoder of the input topics, which adds their messages to a synchronizer.

    A message that cannot be used is counted by kind and skipped, with a warning for the first of each kind and topic.
    """

    def __init__(
        self,
        synchronizer: Synchronizer,
        topics: Topics,
        warn: Callable[[str], None],
        on_odometry: Callable[[OdometrySample], None] = lambda _: None,
        frames: BodyFrames | None = None,
    ) -> None:
        """Pass every sample to `on_odometry`; without `frames` sensors are as calibrated, odometry is the body's."""
        self._frames = frames
        self._read_odometry = frames.odometry if frames is not None else OdometryDecoder(warn).decode
        self._synchronizer = synchronizer
        self._on_odometry = on_odometry
        self._warn = lambda text: warn(printable(text))  # topics come from outside
        self._warned = set[object]()
        self._is_raw = "rect" not in topics.left_image
        self._stereo_info = bool(topics.right_info and topics.right_image)
        self._infos: dict[str, tuple[Any, Any]] = {}
        self._said: dict[str, Any] = {}
        self._used: tuple[Any, Any, Any] | None = None
        self._times, self._grey = PointTimes(lambda text: self._warn(f"{topics.cloud}: {text}")), GreyRange()
        self._early: list[tuple[str, Any]] = []
        self._size: tuple[int, int] | None = None
        self._topics = topics
        self._entries = {getattr(topics, entry): entry for entry in _INPUTS}
        self._entries.pop("", None)

    @property
    def topics(self) -> list[str]:
        """Topics whose messages are taken."""
        return list(self._entries)

    def take(self, topic: str, message: Any) -> None:
        """Add one message."""
        with self.refusing(topic):
            self._take(self._entries[topic], message)

    def _take(self, entry: str, message: Any) -> None:
        if entry == ODOMETRY:
            self.take_odometry(self._read_odometry(message))
        elif entry in ("left_info", "right_info"):
            self._use_info(entry, message)
        else:
            self._take_sensor(entry, message)

    def _take_sensor(self, entry: str, message: Any) -> None:
        """Add an image or a scan; images before the first camera_info wait for it."""
        awaits = self._synchronizer.awaits_camera
        if entry != "cloud" and awaits and len(self._early) < EARLY_IMAGES:
            self._early.append((entry, message))
            return
        early, self._early = ([], self._early) if awaits else (self._early, [])
        for held in early:
            self.take(getattr(self._topics, held[0]), held[1])
        if self._frames is not None and entry != "right_image":
            sensor = "lidar" if entry == "cloud" else "camera"
            self._synchronizer.use_mounting(self._frames.mounting(sensor, message.header.frame_id))
        value: Any = decode_cloud(message, self._times) if entry == "cloud" else decode_image(message, self._grey)
        if entry == "left_image" and value.shape[::-1] != self._size:
            self._size = value.shape[::-1]
            self._use_infos(stamp_ns(message))
        self._synchronizer.add(_INPUTS[entry], stamp_ns(message), value)

    @contextmanager
    def refusing(self, topic: str) -> Iterator[None]:
        """Refuse a message whose processing raises any exception: it is faulty."""
        try:
            yield
        except MessageError as error:
            self.refuse(topic, error)
        except Exception as error:
            text = f"message raises {type(error).__name__}: {error}"
            self.refuse(topic, MessageError("unusable", text))

    def take_odometry(self, sample: OdometrySample) -> None:
        """Add one pose of the odometry."""
        self._on_odometry(sample)
        self._synchronizer.add(ODOMETRY, sample.stamp_ns, sample.odom_T_body)

    def refuse(self, topic: str, error: MessageError) -> None:
        """Count a message that cannot be used, warn of the first of its kind; also for other consumers' topics."""
        if topic in self._entries:
            self._synchronizer.reject(_INPUTS[self._entries[topic]], error.kind)
            self._stereo_info &= self._entries[topic] != "right_info"  # not waited for
        self._say(f"{topic}: {error}; such messages are skipped", (topic, error.kind))

    def _say(self, text: str, kind: object = None) -> None:
        """Warn of the first of a kind, by default of the same text."""
        if (kind or text) not in self._warned:
            self._warned.add(kind or text)
            self._warn(text)

    def _use_info(self, entry: str, message: Any) -> None:
        """Use the camera_info of the pair, or the left one alone when the right camera is silent.

        The first is used at once. A later one with other contents replaces it when it comes twice in a row:
        one message may be damaged, a camera with new settings repeats them.
        """
        content = (window_of(message), bytes(np.array(message.k)), bytes(np.array(message.p)))
        repeated, self._said[entry] = self._said.get(entry) == content, content
        known = self._infos.get(entry, (None, None))[0]
        if content != known and (known is None or repeated):
            self._synchronizer.use_window(window_of(message))
            decode_camera_info(message)
            if self._is_raw and self._frames is not None and self._frames.is_open and np.any(np.array(message.d)):
                lens = f"lens distortion ({message.distortion_model or 'of no named model'})"
                text = f"the images are raw, with {lens}: rectify them (image_proc), or name a calibration"
                raise MessageError("raw", text)
            self._infos[entry] = content, message
        self._use_infos(stamp_ns(message))

    def _use_infos(self, now_ns: int) -> None:
        """Use the latest camera_info for images of the size that was seen; the left one if they make no pair."""
        left, right = (self._infos.get(name, (None, None)) for name in ("left_info", "right_info"))
        if left[1] is None or self._used == (left[0], right[0], self._size):
            return
        if right[1] is None and self._stereo_info and now_ns - stamp_ns(left[1]) < SILENCE_NS:
            return
        before, self._used = self._used, (left[0], right[0], self._size)
        try:
            camera = decode_camera_info(left[1], right[1], self._size, self._say)
        except MessageError as error:
            self._say(f"{self._topics.right_info}: {error}; the left camera is used alone")
            camera = decode_camera_info(left[1], None, self._size)
        self._synchronizer.use_camera(camera)
        if before is not None and before[:2] != self._used[:2] and right[1] is not None:
            self._warn("camera_info: the intrinsics changed; the new ones are used from now on")
