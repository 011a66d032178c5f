"""What every format of recordings gives: topics and serialised messages, told by the types of ROS 2."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import cache
from typing import Protocol

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from umf_ros.sensors.message_kinds import LIVOX, LIVOX_DEFINITION

LARGEST_CHUNK = 2**28
"""Bytes of a chunk after unpacking, and of any record; recorders write some megabytes."""


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """A topic of a recording.

    Attributes:
        type: message type, as in `sensor_msgs/msg/Image`.
        count: number of messages.
    """

    type: str
    count: int


@dataclass(frozen=True, slots=True)
class RawMessage:
    """A recorded message.

    Attributes:
        topic: where.
        log_ns: when it was recorded.
        type: message type.
        data: the message as ROS 2 serialises it (CDR), whatever the format of the recording.
    """

    topic: str
    log_ns: int
    type: str
    data: bytes


class Storage(Protocol):
    """One recording in one format."""

    topics: dict[str, TopicInfo]
    start_ns: int
    end_ns: int
    warning: str

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """Messages of some topics in the order of their recording."""
        ...


@cache
def message_types() -> Typestore:
    """The message definitions of ROS 2 Jazzy, and those of Livox."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for kind in LIVOX:
        definition = LIVOX_DEFINITION.format(package=kind.split("/")[0])
        store.register(get_types_from_msg(definition, kind))
    return store
