"""The UMF network as an embedder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.frames import Embedding, Frame, LocalFeatures, Points, SuperFeatures
from umf_ros.core.geometry import Array, invert, transform
from umf_ros.core.levelling import level
from umf_ros.embedding import FeatureRequest
from umf_ros.embedding.inputs import VoxelScan, is_blank, pack, prepare_image, prepare_scan
from umf_ros.embedding.runtimes import SCAN_TOKENS, SCENE_MAP, Outputs, make_runtime, name_outputs, outputs_of
from umf_ros.networks.config import locate_weights, read_config

KEYPOINTS = 400
MIN_SALIENCY = 0.01
"""In fair shares of attention; limits the features of a poor view, as `KEYPOINTS` those of a rich one."""
PREPROCESSING = b"scans without the tilt of their mount"
"""Part of the name of the descriptors; it changes with the preprocessing."""


def select_salient(saliency: Points, group: NDArray[np.int64], threshold: float, limit: int) -> NDArray[np.int64]:
    """Select the most salient features, spread over the regions.

    The k-th best feature of every region precedes the (k+1)-th of any region; ties go to the lower index.

    Args:
        saliency: (N,) attention received; 1 is the fair share.
        group: (N,) region of each feature.
        threshold: features below are dropped.
        limit: maximum number of features.

    Returns:
        Indices of the selected features, most salient first.
    """
    candidates = np.flatnonzero(saliency >= threshold)
    by_region = candidates[np.lexsort((candidates, -saliency[candidates], group[candidates]))]
    regions = group[by_region]
    starts = np.r_[True, regions[1:] != regions[:-1]] if len(regions) else np.empty(0, bool)
    start_of = np.maximum.accumulate(np.where(starts, np.arange(len(regions)), 0))
    rank = np.arange(len(regions)) - start_of
    fair = by_region[np.lexsort((by_region, -saliency[by_region], rank))[:limit]]
    return fair[np.lexsort((fair, -saliency[fair]))]


def cell_regions(rows: int, columns: int, side: int = 4) -> NDArray[np.int64]:
    """Return the region (rows * columns,) of each cell of a map: squares of `side` cells."""
    row, column = np.divmod(np.arange(rows * columns), columns)
    return row // side * (columns // side + 1) + column // side


def ground_regions(points: Points, side_m: float = 4.0) -> NDArray[np.int64]:
    """Return the region (N,) of each point: squares of `side_m` on the ground."""
    cell = np.floor(points[:, :2] / side_m).astype(np.int64) + 1000
    return cell[:, 0] * 10000 + cell[:, 1]


def local_vectors(cells: Points) -> NDArray[np.int8]:
    """Return the directions (N, C) of cells (C, ...), each scaled to 127 at its largest component."""
    cells = cells.reshape(len(cells), -1).T
    largest = np.maximum(np.abs(cells).max(axis=1, keepdims=True), np.float32(1e-9))
    return np.rint(cells * (127 / largest)).astype(np.int8)


class UmfEmbedder:
    """Embedder with the UMF network: descriptor and local features of a frame.

    Image features are the centres of the fine cells, in pixels of the full-resolution image; cloud features are the
    means of the points of a voxel.

    Args:
        settings: weights (a safetensors file, or the shipped ones), runtime, device and threads.
        asked: local features to compute.

    Raises:
        WeightsError: the weights cannot be used.
        ConfigError: the runtime or the device cannot be used.
    """

    def __init__(
        self,
        settings: EmbeddingSettings,
        asked: FeatureRequest = FeatureRequest(),  # noqa: B008 (a tuple)
    ) -> None:
        path = locate_weights(Path(settings.weights) if settings.weights else None)
        self._config = read_config(path)
        self.dimension = self._config.length
        self._asked = asked
        rows, columns = (side // 4 for side in self._config.image_size)
        self._regions = cell_regions(rows, columns)
        outputs = outputs_of(asked) + (SCAN_TOKENS,) + ((SCENE_MAP,) if self._config.scene else ())
        self._runtime = make_runtime(path, settings, outputs)
        self.name = name_outputs(path, self._runtime, PREPROCESSING)

    def embed(self, frame: Frame) -> Embedding:
        """Embed one frame; a black image and an empty scan count as missing."""
        image = None if frame.left is None or is_blank(frame.left) else frame.left
        level_T_body = np.eye(4) if frame.points is None else level(frame.points, keep_slope=True)
        points = None if frame.points is None else transform(level_T_body, frame.points)
        scan = prepare_scan(points, frame.intensity, self._config)
        found = self._runtime.run(pack([prepare_image(image, self._config)], [scan], self._config))
        supers = self._supers(found) if self._asked.supers else (None, None)
        cells = found.get(SCENE_MAP) if image is not None else found[SCAN_TOKENS][scan.coarse_mask].T
        return Embedding(
            descriptor=found["descriptor"],
            image=self._image_features(found, image.shape[:2]) if self._asked.image and image is not None else None,
            cloud=self._cloud_features(found, scan, level_T_body) if scan.fine_mask.any() else None,
            super_image=None if image is None else supers[0],
            super_cloud=supers[1] if scan.fine_mask.any() else None,
            scene=None if cells is None or not cells.size else local_vectors(cells),
        )

    def _image_features(self, found: Outputs, shape: tuple[int, int]) -> LocalFeatures:
        saliency = found["image_saliency"]
        chosen = select_salient(saliency, self._regions, MIN_SALIENCY, KEYPOINTS)
        rows, columns = (side // 4 for side in self._config.image_size)
        row, column = np.divmod(chosen, columns)
        across, down = shape[1] / columns, shape[0] / rows
        pixels = np.stack([(column + 0.5) * across - 0.5, (row + 0.5) * down - 0.5], axis=1).astype(np.float32)
        return _features(pixels, np.full((len(chosen), 3), np.nan, np.float32), found["image_local"], saliency, chosen)

    def _cloud_features(self, found: Outputs, scan: VoxelScan, level_T_body: Array) -> LocalFeatures:
        saliency = np.where(scan.fine_mask, found["cloud_saliency"], 0)
        chosen = select_salient(saliency, ground_regions(scan.centroids), MIN_SALIENCY, KEYPOINTS)
        points = transform(invert(level_T_body), scan.centroids[chosen])
        return _features(points, points, found["cloud_local"], saliency, chosen)

    def _supers(self, found: Outputs) -> tuple[SuperFeatures, SuperFeatures]:
        image = SuperFeatures(found["super_image"].astype(np.float16), found["super_image_strength"])
        return image, SuperFeatures(found["super_cloud"].astype(np.float16), found["super_cloud_strength"])


make = UmfEmbedder


def _features(
    positions: Points, points: Points, descriptors: Points, saliency: Points, chosen: np.ndarray
) -> LocalFeatures:
    return LocalFeatures(positions, descriptors[chosen].astype(np.float16), saliency[chosen].astype(np.float32), points)
