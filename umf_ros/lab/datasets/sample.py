"""One sample of a data set, whatever the data set."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from numpy.typing import NDArray

from umf_ros.core.frames import Image, Points, StereoCamera
from umf_ros.core.geometry import Array


@dataclass(frozen=True, slots=True)
class Sample:
    """An image, a scan and where they were taken.

    Attributes:
        image: (h, w) uint8, the whole view at any resolution and aspect, or None.
        points: (N, 3) float32 metres, body frame, or None.
        intensity: (N,) float32 in the sensor's unit, or None.
        world_T_body: true pose; None: heading unknown is not allowed in training.
        camera: intrinsics at the camera's full resolution.
        body_T_camera: pose of the camera in the body frame.
        depth: (h', w') float32 metres along the optical axis over the whole view, 0 where there is none, or None.
    """

    image: Image | None
    points: Points | None
    intensity: Points | None
    world_T_body: Array
    camera: StereoCamera
    body_T_camera: Array
    depth: Points | None = None


class SampleSequence(Protocol):
    """Samples of one place, in order of time.

    Attributes:
        name: for people, unique.
        place: sequences of one place share its coordinates and this name.
        world_T_body: (N, 4, 4) true poses.
        pass_index: (N,) which traverse of the place a sample belongs to, from 0; fractions count on along a
            drive without beginning or end. Two passes differ by one at least.
        setting: "easy", "hard" or "real".
    """

    name: str
    place: str
    world_T_body: Array
    pass_index: NDArray
    setting: str

    def __len__(self) -> int: ...

    def sample(self, index: int) -> Sample:
        """The sample at `index`."""
        ...
