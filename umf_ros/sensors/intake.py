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
from umf_ros.sensors.sessions import ODOMETRY, Input
from umf_ros.sensors.synchronizer import SILENCE_NS, Synchronizer

_INPUTS: dict[str, Input] = {
    "left_image": "left",
    "right_image": "right",
    "cloud": "cloud",
    "odometry": ODOMETRY,
    "left_info": "camera_info",
    "right_info": "camera_info",
}
"""The input of every topic, by its name in `Topics`."""


def wanted_inputs(topics: Topics) -> set[Input]:
    """Inputs of the synchronizer for which there is a topic; the right camera_info alone says nothing."""
    return {name for entry, name in _INPUTS.items() if getattr(topics, entry) and entry != "right_info"}


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
        self._entries = {getattr(topics, entry): entry for entry in _INPUTS}
        self._entries.pop("", None)

    @property
    def topics(self) -> list[str]:
        """Topics whose messages are taken."""
        return list(self._entries)

    def take(self, topic: str, message: Any) -> None:
        """Add one message."""
        entry = self._entries[topic]
        try:
            if entry == ODOMETRY:
                self.take_odometry(decode_odometry(message))
            elif entry in ("left_info", "right_info"):
                self._use_info(entry, message)
            else:
                decode = decode_cloud if entry == "cloud" else decode_image
                self._synchronizer.add(_INPUTS[entry], stamp_ns(message), decode(message))
        except MessageError as error:
            self.refuse(topic, error)

    def take_odometry(self, sample: OdometrySample) -> None:
        """Add one pose of the odometry."""
        self._hear_odometry(sample)
        self._synchronizer.add(ODOMETRY, sample.stamp_ns, sample.odom_T_body)

    def refuse(self, topic: str, error: MessageError) -> None:
        """Count a message that cannot be used."""
        self._synchronizer.reject(_INPUTS[self._entries[topic]], error.kind)
        if (topic, error.kind) not in self._warned:
            self._warned.add((topic, error.kind))
            self._warn(f"{topic}: {error}; such messages are skipped")

    def _use_info(self, entry: str, message: Any) -> None:
        """Use the first camera_info of the pair, or the left one alone when the right camera stays silent."""
        self._infos.setdefault(entry, message)
        left, right = self._infos.get("left_info"), self._infos.get("right_info")
        if left is None or self._used == set(self._infos):
            return
        if right is None and self._stereo_info and stamp_ns(message) - stamp_ns(left) < SILENCE_NS:
            return
        self._used = set(self._infos)
        self._synchronizer.use_camera(decode_camera_info(left, right))
