"""Recall on worlds never trained on: later passes of a world against its first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from umf_ros.datasets.sample import SampleSequence
from umf_ros.geometry import Array
from umf_ros.networks.umf import UMF, to_device
from umf_ros.training.batches import stack_views
from umf_ros.training.labels import distances, places_of
from umf_ros.training.views import ViewMaker

MODES = ("fused", "image", "cloud")


@dataclass(frozen=True, slots=True)
class Retrieval:
    """How well the best match of each query is a true one.

    Attributes:
        recall1: share of queries whose best match lies within 12 m and 30 deg.
        recall5: share with such a match among the best five.
        recall1_5m: share whose best match lies within 5 m and 30 deg.
        recall_at_precision1: share of queries found above the similarity of the best wrong match.
        queries: queries that have a true match.
    """

    recall1: float
    recall5: float
    recall1_5m: float
    recall_at_precision1: float
    queries: int


def retrieve(
    queries: Array, query_poses: Array, references: Array, reference_poses: Array, radius_m: float = 12.0
) -> Retrieval:
    """Score queries (Q, D) against references (R, D); poses (Q, 4, 4) and (R, 4, 4) of one world."""
    metres, turn = distances(places_of(0, query_poses), places_of(0, reference_poses))
    alike = turn < np.radians(30)
    true = (metres < radius_m) & alike
    answerable = true.any(1)
    if not answerable.any():
        unknown = float("nan")
        return Retrieval(unknown, unknown, unknown, unknown, 0)
    true, near = true[answerable], ((metres < 5) & alike)[answerable]
    similarity = queries[answerable] @ references.T
    order = np.argsort(-similarity, axis=1, kind="stable")[:, :5]
    hits = np.take_along_axis(true, order, 1)
    best = np.take_along_axis(similarity, order[:, :1], 1)[:, 0]
    wrong = best[~hits[:, 0]].max(initial=-np.inf)
    return Retrieval(
        recall1=float(hits[:, 0].mean()),
        recall5=float(hits.any(1).mean()),
        recall1_5m=float(np.take_along_axis(near, order[:, :1], 1).mean()),
        recall_at_precision1=float((hits[:, 0] & (best > wrong)).mean()),
        queries=int(answerable.sum()),
    )


def describe(
    network: UMF, sequence: SampleSequence, rows: NDArray[np.int64], batch: int = 32
) -> dict[str, NDArray[np.float32]]:
    """Descriptors (N, D) of some samples of a sequence, by mode: fused, image, cloud."""
    device = next(network.parameters()).device
    maker = ViewMaker(network.config)
    found: dict[str, list[NDArray[np.float32]]] = {mode: [] for mode in MODES}
    network.eval()
    for start in range(0, len(rows), batch):
        views = [maker.plain(sequence.sample(int(row))) for row in rows[start : start + batch]]
        with torch.inference_mode():
            inputs = to_device(stack_views(views, network.config), device)
            present = inputs.coarse_mask.any(1)
            features = network.encode(inputs)
            nothing = torch.zeros_like(present)
            fused = network.fuse(features, inputs.image_present, present)
            image = network.fuse(features, inputs.image_present, nothing)
            cloud = network.fuse(features, nothing, present)
        for mode, result in zip(MODES, (fused, image, cloud), strict=True):
            found[mode].append(result.descriptor.float().cpu().numpy())
    return {mode: np.concatenate(parts) for mode, parts in found.items()}


def validate(network: UMF, sequences: Sequence[SampleSequence], stride: int = 1) -> dict[str, dict[str, Retrieval]]:
    """Retrieval by sequence and mode; every `stride`-th sample is used.

    Queries of a pass in the opposite direction have no true match and do not count.
    """
    results = {}
    for sequence in sequences:
        rows = np.arange(0, len(sequence), stride)
        first = np.asarray(sequence.pass_index)[rows] == 0
        poses = np.asarray(sequence.world_T_body)[rows]
        descriptors = describe(network, sequence, rows)
        results[sequence.name] = {
            mode: retrieve(found[~first], poses[~first], found[first], poses[first])
            for mode, found in descriptors.items()
        }
    return results


def mean_of(results: dict[str, dict[str, Retrieval]], mode: str, name: str) -> float:
    """Mean over the worlds of one number of one mode."""
    values = [getattr(by_mode[mode], name) for by_mode in results.values() if by_mode[mode].queries]
    return float(np.mean(values)) if values else float("nan")
