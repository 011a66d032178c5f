"""Data set of a recording, and the settings to read it with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from umf_ros.bags.reader import Bag
from umf_ros.core.config import DatasetPreset, Settings, load_preset, load_settings
from umf_ros.core.errors import BagError
from umf_ros.core.resources import dataset_names
from umf_ros.sensors.calibration import load_calibration

GROUND_TRUTH_TOPIC = "/ground_truth/pose"


def detect_dataset(bag: Bag, own_calibration: bool = False) -> str:
    """Data set of a recording: the one most of whose topics are there; its mark counts as one more.

    Its camera_info must be of the data set's cameras, unless the calibration is the user's own.

    Raises:
        BagError: the recording is of no known data set.
    """
    known = set(bag.topics)
    scores = {name: _match(load_preset(name), known) for name in dataset_names()}
    contradiction = ""
    for name in sorted(scores, key=lambda name: -scores[name]):
        other = "" if own_calibration or not scores[name] else _contradiction(bag, name)
        if scores[name] and not other:
            return name
        contradiction = contradiction or other
    names = ", ".join(sorted(known)) or "none"
    reason = contradiction or f"the recording has no topic of a known data set (topics: {names})"
    raise BagError(f"{reason}; name yours in a config file: umf inspect {bag.path} --write . writes a first one")


def _contradiction(bag: Bag, name: str) -> str:
    """Reason why a recording with the topics of a data set is of another camera, else empty."""
    topics = load_preset(name).topics
    infos = {topics.left_info, f"{topics.left_image.rpartition('/')[0]}/camera_info"}
    kind = "sensor_msgs/msg/CameraInfo"
    infos = {topic for topic in infos if topic in bag.topics and bag.topics[topic].type == kind}
    for topic, _, info in bag.messages(infos) if infos else ():
        width, height = load_calibration(name).image_size
        if (info.width, info.height) == (width, height):
            break
        sizes = f"images of {info.width} x {info.height} pixels, and the camera of that data set has {width} x {height}"
        return f"the recording has topics of {name}, but {topic} is for {sizes}"
    return ""


def _match(preset: DatasetPreset, known: set[str]) -> int:
    topics = preset.topics
    if not known & {topics.left_image, topics.cloud} or (preset.mark and preset.mark not in known):
        return 0
    return len(known.intersection(topics.model_dump().values())) + bool(preset.mark)


def settings_for(bag: Bag, config: Path | None, dataset: str, **overrides: Any) -> Settings:
    """Settings to read a recording with.

    Args:
        bag: the recording.
        config: parameter file; None gives the defaults.
        dataset: name of the data set, before whatever the file says; "auto" takes it from the file,
            or from the recording's topics where the file names neither a data set nor topics.
        overrides: as in `load_settings`.

    Raises:
        ConfigError: the file cannot be read, or a name, type or value is wrong.
        BagError: the recording's data set is not known.
    """
    named = None if dataset == "auto" else dataset
    settings = load_settings(config, dataset=named, **overrides)
    if named is None and not settings.model_fields_set & {"dataset", "topics"}:
        settings = settings.model_copy(
            update={"dataset": detect_dataset(bag, own_calibration=bool(settings.calibration))}
        )
    return settings
