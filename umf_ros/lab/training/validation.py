"""Recall on worlds never trained on: later passes of a world against its first."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from umf_ros.lab.datasets.sample import Rule, SampleSequence
from umf_ros.lab.datasets.views import ViewMaker
from umf_ros.lab.evaluation.results import Scores, percent, score
from umf_ros.lab.evaluation.retrieval import THESIS_RULE, place_recognition, rank, revisits
from umf_ros.lab.training.batches import stack_views
from umf_ros.networks.umf import UMF

MODES = ("fused", "image", "cloud")

Results = dict[str, dict[str, Scores]]
"""Scores by sequence and mode."""

_FIGURES = ("queries", "recall1", "recall5", "recall1_within_5m", "recall_at_precision1")


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
            inputs = stack_views(views, network.config).to(device)
            present = inputs.coarse_mask.any(1)
            features = network.encode(inputs)
            nothing = torch.zeros_like(present)
            fused = network.fuse(features, inputs.image_present, present)
            image = network.fuse(features, inputs.image_present, nothing)
            cloud = network.fuse(features, nothing, present)
        for mode, result in zip(MODES, (fused, image, cloud), strict=True):
            found[mode].append(result.descriptor.float().cpu().numpy())
    return {mode: np.concatenate(parts) for mode, parts in found.items()}


def validate(network: UMF, sequences: Sequence[SampleSequence], stride: int = 1, rule: Rule = THESIS_RULE) -> Results:
    """Retrieval by sequence and mode; every `stride`-th sample is used.

    In a simulated world later passes are asked for the first, in a recording each sample for all earlier passes.
    Queries of a pass in the opposite direction have no true match and do not count.
    """
    results = {}
    for sequence in sequences:
        rows = np.arange(0, len(sequence), stride)
        protocol = revisits if sequence.setting == "real" else place_recognition
        task = protocol(np.asarray(sequence.world_T_body)[rows], np.asarray(sequence.pass_index)[rows], rule)
        results[sequence.name] = {
            mode: score(task, rank(found[task.queries] @ found[task.references].T, task.admissible))
            for mode, found in describe(network, sequence, rows).items()
        }
    return results


def answerable(results: Results) -> bool:
    """Whether any place of these sequences is visited twice."""
    return any(found.queries for by_mode in results.values() for found in by_mode.values())


def figures(found: Scores) -> dict[str, float | None]:
    """The figures that a card keeps, by name; None for what could not be measured."""
    values = {name: getattr(found, name) for name in _FIGURES}
    return {name: value if math.isfinite(value) else None for name, value in values.items()}


def mean_of(results: Results, mode: str, name: str) -> float:
    """Mean over the worlds of one number of one mode."""
    values = [getattr(by_mode[mode], name) for by_mode in results.values() if by_mode[mode].queries]
    return float(np.mean(values)) if values else float("nan")


def table(results: Results) -> tuple[list[str], list[list[str]]]:
    """A row per sequence and mode."""
    head = ["sequence, modality", "queries", "R@1 %", "R@5 %", "top 1 %", "within 5 m %"]
    rows = []
    for name, by_mode in results.items():
        for mode, found in by_mode.items():
            shares = found.recall1, found.recall5, found.recall_top_percent, found.recall1_within_5m
            rows.append([f"{name}, {mode}", str(found.queries), *map(percent, shares)])
    return head, rows


def means(results: Results) -> dict[str, float | int | None]:
    """Means over the sequences by name."""
    names = ("recall1", "recall5", "recall_top_percent", "recall1_within_5m")
    return {f"{name}_{mode}_mean": round(mean_of(results, mode, name), 4) for mode in MODES for name in names}
