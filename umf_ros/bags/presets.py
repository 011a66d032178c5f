"""What each data set calls its topics."""

from __future__ import annotations

from typing import Literal

from umf_ros.bags.reader import Bag
from umf_ros.config import Settings, Topics
from umf_ros.errors import BagError

Dataset = Literal["simulated", "s3li-etna", "s3li-vulcano"]

GROUND_TRUTH_TOPIC = "/ground_truth/pose"

TOPICS: dict[str, Topics] = {
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


def topics_of(settings: Settings) -> Topics:
    """Input topics: those of the data set, except where the settings differ from the defaults."""
    defaults = Topics().model_dump()
    own = {name: topic for name, topic in settings.topics.model_dump().items() if topic != defaults[name]}
    return TOPICS[settings.dataset].model_copy(update=own)


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
