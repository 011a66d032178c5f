"""The way of a message into the synchronizer: the same live and offline."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from umf_ros.config import Topics
from umf_ros.errors import MessageError
from umf_ros.sensors.messages import (
    OdometrySample,
    decode_camera_info,
    decode_cloud,
    decode_image,
    decode_odometry,
    stamp_ns,
)
from umf_ros.sensors.sessions import Input
from umf_ros.sensors.synchronizer import SILENCE_NS, Synchronizer


def wanted_inputs(topics: Topics) -> set[Input]:
    """Inputs of the synchronizer for which there is a topic."""
    names: dict[Input, str] = {
        "left": topics.left_image,
        "right": topics.right_image,
        "cloud": topics.cloud,
        "odometry": topics.odometry,
        "camera_info": topics.left_info,
    }
    return {name for name, topic in names.items() if topic}


class Intake:
    """Decodes the messages of the input topics and adds them to a synchronizer.

    A message that cannot be used is counted by kind and skipped; the first of each kind is told.
    """

    def __init__(
        self,
        synchronizer: Synchronizer,
        topics: Topics,
        warn: Callable[[str], None],
        hear_odometry: Callable[[OdometrySample], None] = lambda _: None,
    ) -> None:
        """Warn with one line per kind of fault and topic; `hear_odometry` gets every sample at its full rate."""
        self._synchronizer = synchronizer
        self._hear_odometry = hear_odometry
        self._warn = warn
        self._warned: set[tuple[str, str]] = set()
        self._stereo_info = bool(topics.right_info and topics.right_image)
        self._infos: dict[str, Any] = {}
        self._used: set[str] = set()
        self._handlers: dict[str, tuple[Input, Callable[[Any], None]]] = {
            topics.left_image: ("left", self._left),
            topics.right_image: ("right", self._right),
            topics.cloud: ("cloud", self._cloud),
            topics.odometry: ("odometry", self._odometry),
            topics.left_info: ("camera_info", self._left_info),
            topics.right_info: ("camera_info", self._right_info),
        }
        self._handlers.pop("", None)

    @property
    def topics(self) -> list[str]:
        """Topics whose messages are taken."""
        return list(self._handlers)

    def take(self, topic: str, message: Any) -> None:
        """Add one message."""
        try:
            self._handlers[topic][1](message)
        except MessageError as error:
            self.refuse(topic, error)

    def take_odometry(self, sample: OdometrySample) -> None:
        """Add one pose of the odometry."""
        self._hear_odometry(sample)
        self._synchronizer.add_odometry(sample.stamp_ns, sample.odom_T_body)

    def refuse(self, topic: str, error: MessageError) -> None:
        """Count a message that cannot be used."""
        self._synchronizer.reject(self._handlers[topic][0], error.kind)
        if (topic, error.kind) not in self._warned:
            self._warned.add((topic, error.kind))
            self._warn(f"{topic}: {error}; such messages are skipped")

    def _left(self, message: Any) -> None:
        self._synchronizer.add_left(stamp_ns(message), decode_image(message))

    def _right(self, message: Any) -> None:
        self._synchronizer.add_right(stamp_ns(message), decode_image(message))

    def _cloud(self, message: Any) -> None:
        self._synchronizer.add_cloud(stamp_ns(message), decode_cloud(message))

    def _odometry(self, message: Any) -> None:
        self.take_odometry(decode_odometry(message))

    def _left_info(self, message: Any) -> None:
        self._use_info("left", message)

    def _right_info(self, message: Any) -> None:
        self._use_info("right", message)

    def _use_info(self, side: str, message: Any) -> None:
        """Use the first camera_info of the pair, or the left one alone when the right camera stays silent."""
        left = self._infos.setdefault(side, message) if side == "left" else self._infos.get("left")
        right = self._infos.setdefault(side, message) if side == "right" else self._infos.get("right")
        if left is None or self._used == set(self._infos):
            return
        if right is None and self._stereo_info and stamp_ns(message) - stamp_ns(left) < SILENCE_NS:
            return
        self._used = set(self._infos)
        self._synchronizer.use_camera(decode_camera_info(left, right))
