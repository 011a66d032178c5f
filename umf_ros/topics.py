"""What each data set calls its topics."""

from __future__ import annotations

from umf_ros.config import Settings, Topics

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
