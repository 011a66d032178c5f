"""Which data set a recording belongs to, and what its settings and its preset say together."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from umf_ros.bags.reader import Bag
from umf_ros.core.config import DatasetPreset, Settings, load_preset, load_settings
from umf_ros.core.errors import BagError
from umf_ros.core.resources import dataset_names

GROUND_TRUTH_TOPIC = "/ground_truth/pose"


def detect_dataset(bag: Bag) -> str:
    """Data set of a recording: the one most of whose topics are there; its mark counts as one more.

    Raises:
        BagError: neither the images nor the scans of a known data set are there.
    """
    known = set(bag.topics)
    found = {name: _match(load_preset(name), known) for name in dataset_names()}
    best = max(found, key=lambda name: found[name])
    if not found[best]:
        names = ", ".join(sorted(known)) or "none"
        raise BagError(f"the recording has no topic of a known data set; name yours in a config file (topics: {names})")
    return best


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
        settings = settings.model_copy(update={"dataset": detect_dataset(bag)})
    return settings
