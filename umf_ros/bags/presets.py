"""Which data set a recording belongs to."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from umf_ros.bags.reader import Bag
from umf_ros.config import Settings, load_settings
from umf_ros.errors import BagError
from umf_ros.topics import TOPICS

Dataset = Literal["simulated", "s3li-etna", "s3li-vulcano"]

GROUND_TRUTH_TOPIC = "/ground_truth/pose"


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
