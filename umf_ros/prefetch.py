"""One keyframe ahead of a replay: the network is at the next one while this one is verified."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

from umf_ros.core.config import KeyframePolicy
from umf_ros.core.frames import Frame
from umf_ros.core.keyframes import KeyframeSelector
from umf_ros.sensors.decode import OdometrySample

Item = Frame | OdometrySample


def one_ahead(stream: Iterable[Item], policy: KeyframePolicy, prefetch: Callable[[Frame], None]) -> Iterator[Item]:
    """The stream as it is, each keyframe held back until the next one has been foreseen.

    Args:
        stream: of a recording.
        policy: what makes a frame a keyframe, as the detector has it.
        prefetch: is told of every keyframe, in order, before the one ahead of it is handed on.
    """
    selector = KeyframeSelector(policy)
    held: list[Item] = []
    for item in stream:
        if isinstance(item, Frame) and selector.select(item):
            prefetch(item)
            yield from held
            held.clear()
        held.append(item)
    yield from held
