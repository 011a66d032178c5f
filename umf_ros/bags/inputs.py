"""Inputs that a recording lacks, or whose messages could not be used, with remedies."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from umf_ros.bags.reader import Bag
from umf_ros.core.config import Settings, Topics, topics_of
from umf_ros.core.errors import command_line, either
from umf_ros.sensors.decode import TYPES
from umf_ros.sensors.sessions import Input
from umf_ros.sensors.synchronizer import InputCounter

Severity = Literal["fault", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("fault", "warning", "note")
_ABSENT: dict[str, tuple[Severity, str]] = {
    "left_image": ("warning", "no images on {}: running LiDAR-only"),
    "right_image": ("note", "no right images on {}: image depth from the scans only"),
    "cloud": ("warning", "no scans on {}: running camera-only"),
    "odometry": ("warning", "no odometry on {}: closures only, the pose graph is skipped"),
}
_NAMES: dict[str, str] = {"left": "left images", "right": "right images", "cloud": "scans", "odometry": "odometry"}
_HELP = {
    "size": "the calibration is for images of another size: width, height, fx, fy, cx, cy",
    "fields": "the cloud needs fields x, y and z",
    "stamp": "the driver must set header.stamp",
    "pose": "the odometry must send unit quaternions",
    "position jump": "the odometry's positions must be in metres and continuous",
    "transforms": "calibration names a file that says how the sensors are mounted",
    "camera_info": "calibration names a file with the intrinsics",
    "late": "a larger sync.max_wait_s waits longer",
    "queue full": "a larger sync.queue_size keeps more",
}
"""Remedy by the reason for which messages are dropped."""
MUCH_LOST = 0.2
"""Least share of lost messages of an input that is reported."""


@dataclass(frozen=True, slots=True)
class Advice:
    """Advice to the user.

    Attributes:
        severity: a fault spoils the result, a warning may, a note is information.
        what: the problem, with its figures; a sentence without a full stop.
        remedy: the remedy, likewise, or empty.
    """

    severity: Severity
    what: str
    remedy: str = ""

    @property
    def line(self) -> str:
        """Both on one line."""
        return f"{self.what}; {self.remedy}" if self.remedy else self.what


def present_topics(bag: Bag, settings: Settings) -> Topics:
    """Return the topics of the settings that the recording has, the others empty."""
    topics = topics_of(settings)
    counts = {name: bag.topics[topic].count for name, topic in topics.model_dump().items() if topic in bag.topics}
    return topics.model_copy(update=dict.fromkeys([name for name in topics.model_dump() if not counts.get(name)], ""))


def absent_inputs(bag: Bag, settings: Settings, odometry_from_file: bool = False) -> Iterator[Advice]:
    """Yield inputs that the settings name and the recording lacks, first whether there is any depth."""
    topics, present = topics_of(settings).model_dump(), present_topics(bag, settings)
    if present.left_image and not present.cloud and not present.right_image:
        what = "no depth: one camera, no scans and no right images; places are recognised, but no closure is metric"
        helps = [name for name in ("cloud", "right_image") if _others(name, bag, present)]
        remedies = [_remedy(name, bag, present) for name in helps]
        yield Advice("fault", what, either(remedies) or "record scans or a stereo pair")
    for name, (severity, text) in _ABSENT.items():
        if getattr(present, name):
            continue
        if topics[name] and not (name == "odometry" and odometry_from_file):
            yield Advice(severity, text.format(topics[name]), _remedy(name, bag, present))
        elif name == "odometry" and not odometry_from_file:
            yield Advice("note", text.replace(" on {}", ""), _remedy(name, bag, present))


def _others(name: str, bag: Bag, present: Topics) -> list[str]:
    """Return topics of the type of an input that no input has."""
    used = set(present.model_dump().values())
    return sorted(
        one for one, info in bag.topics.items() if info.type in TYPES[name] and info.count and one not in used
    )


def _remedy(name: str, bag: Bag, present: Topics) -> str:
    others = _others(name, bag, present)
    if not others and name == "odometry":
        return "--odometry FILE.tum supplies it"
    if not others:
        return f"there is no other {TYPES[name][0]}"
    return f"--set topics.{name}={others[0]}" + (f" (or {either(others[1:])})" if others[1:] else "")


def input_counts(counters: Mapping[Input, InputCounter]) -> dict[str, Any]:
    """Return the `inputs` entry of a summary: messages received, used and dropped, with reasons."""
    return {
        name: {"received": counter.received, "used": counter.used, "dropped": dict(counter.dropped)}
        for name, counter in counters.items()
    }


def useless_inputs(inputs: Mapping[str, Any], bag: object = None) -> Iterator[Advice]:
    """Yield inputs of which all or many messages could not be used; `bag` is the path of the recording, if known."""
    for name, count in inputs.items():
        lost = Counter({reason: number for reason, number in count["dropped"].items() if reason != "surplus"})
        if not count["received"] or lost.total() <= MUCH_LOST * count["received"]:
            continue
        reasons = ", ".join(f"{reason} {number}" for reason, number in lost.most_common())
        messages = f"{lost.total()} of {count['received']} messages of the {_NAMES.get(name, name)}"
        details = "" if bag is None else f"details: {command_line('inspect', bag)}"
        remedy = _HELP.get(lost.most_common(1)[0][0], details)
        what = f"{messages} could not be used ({reasons})"
        yield Advice("warning" if count["used"] else "fault", what, remedy)
