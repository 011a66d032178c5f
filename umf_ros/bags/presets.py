"""Data sets known by name: the topics and the rig of their recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from umf_ros.bags.reader import Bag
from umf_ros.config import Dataset, Settings, Topics, load_settings
from umf_ros.errors import BagError
from umf_ros.sensors.calibration import Calibration, load_calibration

GROUND_TRUTH_TOPIC = "/ground_truth/pose"

TOPICS: dict[Dataset, Topics] = {
    "simulated": Topics(),
    "s3li-etna": Topics(),
    "s3li-vulcano": Topics(
        left_image="/g319c_left/image_raw",
        right_image="/g319c_right/image_raw",
        # not in the recordings; what the data set's own node publishes there is no standard camera_info
        left_info="",
        right_info="",
    ),
}


def detect_dataset(bag: Bag) -> Dataset:
    """Data set of a recording, by its topics.

    Raises:
        BagError: neither the images nor the scans of a known data set are there.
    """
    known = set(bag.topics)
    if TOPICS["s3li-vulcano"].left_image in known:
        return "s3li-vulcano"
    etna = TOPICS["s3li-etna"]
    if not known & {etna.left_image, etna.cloud}:
        names = ", ".join(sorted(known)) or "none"
        raise BagError(f"the recording has no topic of a known data set; name yours in a config file (topics: {names})")
    return "simulated" if GROUND_TRUTH_TOPIC in known else "s3li-etna"


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
        settings = settings.model_copy(update={"dataset": detect_dataset(bag)})
    return settings


def topics_of(settings: Settings) -> Topics:
    """Input topics: those of the data set, except where the settings differ from the defaults."""
    defaults = Topics().model_dump()
    own = {name: topic for name, topic in settings.topics.model_dump().items() if topic != defaults[name]}
    return TOPICS[settings.dataset].model_copy(update=own)


def calibration_of(settings: Settings) -> Calibration:
    """The calibration the settings name, else that of the data set.

    Raises:
        CalibrationError: the file cannot be read, or a key is missing, unknown or wrong.
    """
    return load_calibration(settings.calibration or settings.dataset)
