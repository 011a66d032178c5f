"""Which data set a recording belongs to."""

from __future__ import annotations

from typing import Literal

from umf_ros.bags.reader import Bag
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
