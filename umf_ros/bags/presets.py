"""Data set of a recording, and the settings to read it with."""

from __future__ import annotations

from contextlib import suppress
from itertools import islice
from typing import Any

from umf_ros.bags.reader import Bag, decode
from umf_ros.core.config import ParameterSource, Settings, load_preset, load_settings
from umf_ros.core.errors import BagError, MessageError
from umf_ros.sensors.calibration import load_calibration
from umf_ros.sensors.tf import MOVING_TOPIC, transform_topics
from umf_ros.sensors.tf import TOPIC as TRANSFORMS_TOPIC
from umf_ros.sensors.topic_finder import known_dataset, must_find, with_topics

SAMPLES = 5
"""Number of camera_info messages that are read: a single one may be damaged."""
GROUND_TRUTH_TOPIC = "/ground_truth/pose"


def detect_dataset(bag: Bag, own_calibration: bool = False) -> str:
    """Return the data set of a recording: the one with most topics present; its mark counts as one more.

    Its camera_info must be of the data set's cameras, unless the calibration is the user's own.

    Raises:
        BagError: the recording is of no known data set.
    """
    best = known_dataset(bag.topics)
    if not best:
        topics = ", ".join(sorted(bag.topics)) or "none"
        raise BagError(f"the recording has no topic of a known data set (topics: {topics})")
    if not own_calibration and (reason := _contradiction(bag, best)):
        raise BagError(reason)
    return best


def _contradiction(bag: Bag, name: str) -> str:
    """Return the reason why a recording with the topics of a data set is of another camera, else empty."""
    topics = load_preset(name).topics
    infos = {topics.left_info, f"{topics.left_image.rpartition('/')[0]}/camera_info"}
    infos = {topic for topic in infos if bag.types.get(topic) == "sensor_msgs/msg/CameraInfo"}
    sizes: list[tuple[int, int]] = []
    for raw in islice(bag.raw_messages(infos), SAMPLES) if infos else ():
        with suppress(MessageError):
            info = decode(raw)
            sizes.append((info.width, info.height))
    expected = load_calibration(name).image_size if sizes else (0, 0)
    if not sizes or expected in sizes:
        return ""
    found = f"{sizes[0][0]} x {sizes[0][1]} pixels, and the camera of that data set has {expected[0]} x {expected[1]}"
    return f"the recording has topics of {name}, but {' or '.join(sorted(infos))} is for images of {found}"


def settings_for(bag: Bag, config: ParameterSource, dataset: str, **overrides: Any) -> Settings:
    """Return settings to read a recording with: those of a parameter file and overrides as in `load_settings`.

    A data set that is named goes before that of the file; "auto" takes it from the file, or from the recording's
    topics. In a recording of no known data set, topics that the file does not name are found by type.

    Raises:
        ConfigError: the file cannot be read, a name, type or value is wrong, or several topics fit.
        BagError: the recording's data set is not known, nor how its sensors are mounted.
    """
    named = None if dataset == "auto" else dataset
    settings = load_settings(config, dataset=named, **overrides)
    if not must_find(settings):
        return settings
    try:
        found = detect_dataset(bag, own_calibration=bool(settings.calibration))
    except BagError as error:
        has_transforms = transform_topics(bag.types) or transform_topics(bag.types, MOVING_TOPIC)
        if not settings.calibration and not has_transforms:
            advice = f"the parameter calibration names a file, and umf inspect {bag.path} --write config writes one"
            text = f"{error}, and without {TRANSFORMS_TOPIC} the mountings of its sensors are unknown; {advice}"
            raise BagError(text) from None
        return with_topics(settings, bag.types)
    return settings.model_copy(update={"dataset": found})
