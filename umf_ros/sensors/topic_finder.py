"""Find the input topics of a rover by the types of their messages, in the ROS graph or in a recording."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping

from umf_ros.core.config import TRANSFORMS, Settings, Topics, load_preset, topics_of
from umf_ros.core.errors import ConfigError, either
from umf_ros.core.resources import dataset_names
from umf_ros.sensors.decode import COMPRESSED, TYPES

FRONT_END = tuple(TYPES)
BACK_END = ("odometry",)
SETTLING_S = 3.0
"""Drivers and players announce their topics within this of each other, as a rule within a tenth of it."""
_OWN = ("/loop_closures", "/pose_graph_node/", "/loop_closure_node/", "/map_node/")
# names that image_pipeline gives to one camera's images, the best first: those of several are the same pictures
_IMAGES = ("image_rect", "image_rect_color", "image_mono", "image", "image_color", "image_raw")
_NO_PICTURES = ("depth", "mask", "semantic")


def is_own(topic: str) -> bool:
    """Return whether this package publishes a topic: closures have the type of odometry, maps that of scans."""
    return any(own in topic for own in _OWN)


def find_topics(types: Mapping[str, str]) -> tuple[Topics, dict[str, list[str]]]:
    """Choose the topic of each input by message type (`types` by topic): the only one, or none.

    The candidates of inputs for which there are several are returned too, by input.

    An image is of the camera in whose namespace it is. Two cameras are a pair where one is called right or r as the
    other is called left or l. Cameras without a camera_info count where no camera has one.
    """
    fits = {
        name: sorted(topic for topic, kind in types.items() if kind in kinds and not is_own(topic))
        for name, kinds in TYPES.items()
    }
    cameras = _cameras({topic: types[topic] for topic in fits["left_image"]})
    infos = {camera: info for camera, topic in cameras.items() if (info := _info(topic)) in fits["left_info"]}
    seeing = sorted(camera for camera in infos or cameras if camera is not None)
    left, right = _pair(seeing)
    chosen = {name: fits[name][0] if len(fits[name]) == 1 else "" for name in ("cloud", "odometry")}
    ambiguous = {name: fits[name] for name in chosen if len(fits[name]) > 1}
    if seeing and left is None:
        ambiguous["left_image"] = [cameras[camera] for camera in seeing]
    for side, camera in (("left", left), ("right", right)):
        chosen[f"{side}_image"], chosen[f"{side}_info"] = cameras.get(camera, ""), infos.get(camera, "")
    return Topics(**chosen), ambiguous


def _cameras(images: Mapping[str, str]) -> dict[str | None, str]:
    """The best topic of each camera, by its namespace; an image of an unusual name is a camera of its own."""
    found: dict[str | None, tuple[int, bool, str]] = {}
    for topic, kind in images.items():
        namespace, _, name = topic.removesuffix("/compressed").rpartition("/")
        if not _is_picture(topic):
            continue
        usual = name in _IMAGES
        camera = namespace if usual else f"{namespace}/{name}"
        best = _IMAGES.index(name) if usual else 0, kind == COMPRESSED, topic
        found[camera] = min(best, found.get(camera, best))
    return {camera: topic for camera, (*_, topic) in found.items()}


def _is_picture(image: str) -> bool:
    return not any(word in image.lower() for word in _NO_PICTURES)


def _info(image: str) -> str:
    """The camera_info beside an image."""
    return f"{image.removesuffix('/compressed').rpartition('/')[0]}/camera_info"


def _pair(cameras: list[str]) -> tuple[str | None, str | None]:
    """Left and right of a pair, a single camera, or none of several."""
    if len(cameras) == 1:
        return cameras[0], None
    if len(cameras) == 2:
        for left, right in (cameras, cameras[::-1]):
            if "left" in left and left.replace("left", "right") == right:
                return left, right
            if right == re.sub(r"(?<![a-z])l(?![a-z])", "r", left):
                return left, right
    return None, None


def known_dataset(topics: Collection[str]) -> str:
    """The data set most of whose topics are there, its mark counting as one more; empty where there is none."""
    scores = {name: _score(name, set(topics)) for name in dataset_names()}
    best = max(scores, key=lambda name: scores[name])
    return best if scores[best] else ""


def _score(dataset: str, known: set[str]) -> int:
    preset = load_preset(dataset)
    if not known & {preset.topics.left_image, preset.topics.cloud} or (preset.mark and preset.mark not in known):
        return 0
    return len(known.intersection(preset.topics.model_dump().values())) + bool(preset.mark)


def must_find(settings: Settings, wanted: Collection[str] = FRONT_END) -> bool:
    """Whether there are wanted inputs whose topics neither a data set nor a parameter names."""
    return "dataset" not in settings.model_fields_set and not settings.topics.model_fields_set.issuperset(wanted)


def with_topics(settings: Settings, types: Mapping[str, str], wanted: Collection[str] = FRONT_END) -> Settings:
    """The settings with the wanted topics that are found by type where no parameter names them.

    Without a calibration file, `/tf_static` and camera_info say how the rig is built.

    Raises:
        ConfigError: several topics fit.
    """
    named = settings.topics.model_fields_set
    topics, ambiguous = find_topics(types)
    several = [f"{name}: {either(topics)}" for name, topics in ambiguous.items() if name in set(wanted) - named]
    if several:
        raise ConfigError(f"several topics fit, name one of each as topics.NAME: {'; '.join(several)}")
    own = {name: getattr(settings.topics, name) for name in named}
    update = {"topics": topics.model_copy(update=own), "calibration": settings.calibration or TRANSFORMS}
    return settings.model_copy(update=update)


class TopicFinder:
    """Finds the topics of a node in the ROS graph, when nothing new has been announced for a while."""

    def __init__(self, settings: Settings, namespace: str, wanted: Collection[str]) -> None:
        self._settings, self._wanted = settings, wanted
        self._namespace = namespace.rstrip("/")
        self._seen: dict[str, str] = {}
        self._since_s = 0.0

    def look(self, types: Mapping[str, str], now_s: float, settling_s: float = SETTLING_S) -> Settings | None:
        """Settings with the topics of the graph; None while there are none, or new ones come.

        A node in a namespace takes the topics of that alone: a namespace is a robot.

        Args:
            types: message type by topic that has a publisher.
            now_s: time on any clock.
            settling_s: so long nothing new may have come.

        Raises:
            ConfigError: several topics fit.
        """
        prefix = f"{self._namespace}/"
        # the map's cloud has the type of a scan, and is there before any sensor
        seen = {topic: kind for topic, kind in types.items() if topic.startswith(prefix) and not is_own(topic)}
        if seen != self._seen:
            self._seen, self._since_s = seen, now_s
        if now_s - self._since_s < settling_s or not self._suffices(seen):
            return None
        dataset = known_dataset([topic.removeprefix(self._namespace) for topic in seen])
        # images of that name are usual: live, the scans have to be the data set's too
        if dataset and load_preset(dataset).topics.cloud in [topic.removeprefix(self._namespace) for topic in seen]:
            return self._settings.model_copy(update={"dataset": dataset})
        return with_topics(self._settings, seen, self._wanted)

    def _suffices(self, seen: Mapping[str, str]) -> bool:
        """Whether there is anything to work with: a scan or an image, where one is wanted."""
        names = [name for name in ("cloud", "left_image") if name in self._wanted] or self._wanted
        return any(
            kind in TYPES[name] and (name == "cloud" or _is_picture(topic))
            for name in names
            for topic, kind in seen.items()
        )


def describe_inputs(settings: Settings, wanted: Collection[str] = FRONT_END) -> str:
    """One line: which topics were found, which were not, and which parameters name others."""
    if settings.calibration != TRANSFORMS and "dataset" in settings.model_fields_set:
        return f"inputs: topics and calibration of the data set {settings.dataset} (parameter dataset)"
    topics = {name: topic for name, topic in topics_of(settings).model_dump().items() if name in wanted}
    chosen = ", ".join(f"{name} {topic}" for name, topic in topics.items() if topic)
    absent = ", ".join(f"topics.{name}" for name, topic in topics.items() if not topic)
    rig = "/tf_static and camera_info" if settings.calibration == TRANSFORMS else settings.calibration
    text = f"inputs: {chosen or 'none'}" + (f"; not found: {absent}" if absent else "")
    return text + (f"; rig: {rig} (parameter calibration)" if set(wanted) > set(BACK_END) else "")
