"""A world without rays: places on a line, an embedder that knows them, and local features that belong to them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from conftest import CAMERA
from scipy.spatial.transform import Rotation

from umf_ros.core.frames import Embedding, Frame, LocalFeatures, SuperFeatures
from umf_ros.core.geometry import Array, make_pose
from umf_ros.lab.evaluation.worlds import FIRST, OPPOSITE, REVISIT, SAME_LIGHT, Visit

SPACING_M = 8.0
PLACES = 12
CONFUSED = {3: 9, 6: 11}
"""Places whose descriptors look like another's, though their local features do not."""


def at(place: int, heading_deg: float = 0.0, shift_m: float = 0.0) -> Array:
    rotation = Rotation.from_euler("z", heading_deg, degrees=True).as_matrix()
    return make_pose(rotation, [place * SPACING_M, shift_m, 0.0])


def frame_of(stamp: int, place: int) -> Frame:
    """The place is written into the image and into the scan."""
    image = np.full((48, 64), 100, np.uint8)
    image[0, 0], image[0, 1] = place, 200  # not blank
    points = np.zeros((30, 3), np.float32)
    points[0, 0] = place
    return Frame(stamp, CAMERA, np.eye(4), np.eye(4), left=image, points=points, intensity=np.zeros(30, np.float32))


class LineWorld:
    """Two passes, one turned around and one under the first light; enough for a `WorldEvaluation`."""

    name = "line 0"
    revisits = PLACES

    def __len__(self) -> int:
        return 4 * PLACES

    def __iter__(self) -> Iterator[Visit]:
        for number, heading in ((FIRST, 0.0), (REVISIT, 12.0), (SAME_LIGHT, 12.0), (OPPOSITE, 180.0)):
            for place in range(PLACES):
                stamp = 1000 * number + place
                yield Visit(frame_of(stamp, place), at(place, heading, shift_m=float(number)), number)


class LandmarkEmbedder:
    """Descriptors that are right except for `CONFUSED` places; wrong without the image; local features always right."""

    name = "landmarks"
    dimension = PLACES

    def embed(self, frame: Frame) -> Embedding:
        image, points = frame.left, frame.points
        seen = image is not None and image.max() > 0
        scanned = points is not None and len(points) > 0
        place = int(image[0, 0]) if seen else int(points[0, 0]) if scanned else 0
        later = frame.stamp_ns >= 1000
        shown = CONFUSED.get(place, place) if later else place
        if not seen:
            shown = (shown + later) % PLACES
        descriptor = np.full(PLACES, 0.1, np.float32)
        descriptor[shown] = 1.0
        descriptor[place] += 0.87
        return Embedding(
            descriptor / np.linalg.norm(descriptor),
            image=_features(place, 2) if seen else None,
            cloud=_features(place, 3) if scanned else None,
            super_image=_supers(place) if seen else None,
            super_cloud=_supers(place + 100) if scanned else None,
        )


def _features(place: int, axes: int, count: int = 40) -> LocalFeatures:
    rng = np.random.default_rng([place, axes])
    positions = rng.uniform(0, 300 if axes == 2 else 20, (count, axes)).astype(np.float32)
    descriptors = rng.standard_normal((count, 16))
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    points = np.full((count, 3), np.nan, np.float32) if axes == 2 else positions
    return LocalFeatures(positions, descriptors.astype(np.float16), np.ones(count, np.float32), points)


def _supers(place: int, count: int = 12) -> SuperFeatures:
    rng = np.random.default_rng(place)
    descriptors = rng.standard_normal((count, 16))
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    return SuperFeatures(descriptors.astype(np.float16), np.ones(count, np.float32))
