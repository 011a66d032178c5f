"""Fine-tune the network's heads on a rover's own drive."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from umf_ros.lab.training.drives import Drive, Labels, Mask, label_drive
from umf_ros.lab.training.losses import neighbourhood_components
from umf_ros.networks.fusion import Fused
from umf_ros.networks.umf import UMF

HELD_OUT = 0.3
"""Share of a drive's revisits, the last ones."""
FEWEST = 20
"""Revisits held out that can decide."""
GAINED = 0.01
"""Mean gain of recall@1 from which the result is kept."""
LOST = 0.01
"""What no modality may lose."""
SURE = 1.64
"""Standard deviations of chance by which what is found now must outweigh what is found no more (a sign test)."""
PARTS = ("descriptor", "image", "cloud")


@dataclass(frozen=True, slots=True)
class Adaptation:
    """How the heads are fitted.

    Attributes:
        steps: of one drive each.
        learning_rate: of Adam; `scene_rate` that of the scene's projection, whose numbers are small.
        pull: weight of the squared relative distance from the start.
        way: from the start to what was fitted, how far to go.
        seed: of the order of the drives.
    """

    steps: int = 150
    learning_rate: float = 5e-4
    scene_rate: float = 1e-5
    pull: float = 10.0
    way: float = 0.5
    seed: int = 0


class Recall(NamedTuple):
    """Recall@1 of the revisits held out, by what is asked; NaN where a modality is absent.

    Attributes:
        fused, image, lidar: shares.
        revisits: so many.
        hits: (Q,) bool, of all that was asked, in an order that another network's hits share.
    """

    fused: float
    image: float
    lidar: float
    revisits: int
    hits: NDArray[np.bool_]

    def said(self) -> str:
        """For people."""
        shown = zip(("both", "image", "LiDAR"), self[:3], strict=True)
        return ", ".join(f"{name} {100 * value:.1f} %" for name, value in shown if np.isfinite(value))

    def gain_over(self, before: Recall) -> float:
        """Mean gain; negative where any modality lost, 0 at most where it may be chance."""
        gains = np.array(self[:3]) - np.array(before[:3])
        gains = gains[np.isfinite(gains)]
        if not len(gains) or gains.min() < -LOST:
            return -1.0
        won, lost = int((self.hits & ~before.hits).sum()), int((before.hits & ~self.hits).sum())
        sure = won - lost > SURE * np.sqrt(won + lost)
        return float(gains.mean() if sure else min(gains.mean(), 0.0))


class Lesson:
    """One drive as tensors: what to learn from, and what is held out."""

    def __init__(self, drive: Drive) -> None:
        self._drive = drive
        labels = label_drive(drive)
        revisits = labels.revisits
        kept = max(1, round(HELD_OUT * len(revisits))) if len(revisits) else 0
        self.held_out = revisits[len(revisits) - kept :]
        hidden = _with_their_places(labels, self.held_out)
        self.learned = np.setdiff1d(revisits, np.flatnonzero(hidden))
        self.same, self.other = torch.from_numpy(labels.same), torch.from_numpy(labels.other)
        self._shown = torch.from_numpy(~hidden)

    def describe(self, network: UMF) -> Fused:
        """Descriptors (N, ...) of all keyframes."""
        assert network.scene is not None
        drive = self._drive
        seen, felt, cells = (torch.from_numpy(each).float() for each in (drive.seen, drive.felt, drive.cells))
        present = torch.from_numpy(drive.image_present), torch.from_numpy(drive.cloud_present)
        return network.fusion.describe(seen, felt, *present, network.scene.project(cells))

    def loss(self, network: UMF) -> Tensor:
        """Of what is not held out: both halves and the whole."""
        rows = torch.from_numpy(self.learned)
        found = self.describe(network)
        same, other = (mask[rows] & self._shown for mask in (self.same, self.other))
        parts = [getattr(found, name) for name in self._parts()]
        return torch.stack([neighbourhood_components(part[rows] @ part.T, same, other) for part in parts]).sum()

    def hits(self, network: UMF) -> dict[str, NDArray[np.bool_]]:
        """Whether each revisit held out finds its place, by what is asked."""
        rows = torch.from_numpy(self.held_out)
        with torch.inference_mode():
            found = self.describe(network)
            asked = self.same[rows] | self.other[rows]
            hits = {}
            for name in self._parts():
                part = getattr(found, name)
                best = (part[rows] @ part.T).masked_fill(~asked, -2).argmax(1)
                hits[name] = self.same[rows, best].numpy()
        return hits

    def _parts(self) -> list[str]:
        """The whole, and the halves of the modalities that the drive has."""
        present = True, bool(self._drive.image_present.any()), bool(self._drive.cloud_present.any())
        return [name for name, there in zip(PARTS, present, strict=True) if there]


def measure(network: UMF, lessons: Sequence[Lesson]) -> Recall:
    """Recall@1 of all revisits that are held out."""
    hits = [lesson.hits(network) for lesson in lessons if len(lesson.held_out)]
    fused, image, lidar = (_share([found[name] for found in hits if name in found]) for name in PARTS)
    every = [found[name] for found in hits for name in PARTS if name in found]
    revisits = sum(len(lesson.held_out) for lesson in lessons)
    return Recall(fused, image, lidar, revisits, np.concatenate(every) if every else np.empty(0, bool))


def adapt(
    network: UMF, lessons: Sequence[Lesson], settings: Adaptation, report: Callable[[int], None] = lambda _: None
) -> None:
    """Fit the heads in place.

    Args:
        network: with a scene.
        lessons: of drives with revisits that are not held out.
        settings: of the fit.
        report: called with the steps done.
    """
    assert network.scene is not None
    usable = [lesson for lesson in lessons if len(lesson.learned)]
    fusion, projection = network.fusion, network.scene.projection.weight
    heads = [*fusion.image_head.parameters(), *fusion.cloud_head.parameters(), *fusion.weigh.parameters()]
    chosen = [*heads, projection]
    start = [each.detach().clone() for each in chosen]
    groups = [
        {"params": heads, "lr": settings.learning_rate},
        {"params": [projection], "lr": settings.scene_rate},
    ]
    optimiser = torch.optim.Adam(groups)
    luck = np.random.default_rng(settings.seed)
    for step in range(settings.steps):
        strayed = [_strayed(now, then) for now, then in zip(chosen, start, strict=True)]
        loss = usable[int(luck.integers(len(usable)))].loss(network) + settings.pull * torch.stack(strayed).sum()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        report(step + 1)
    with torch.no_grad():
        for now, then in zip(chosen, start, strict=True):
            now.lerp_(then, 1 - settings.way)


def _strayed(now: Tensor, start: Tensor) -> Tensor:
    """Squared distance from the start, relative to it."""
    return ((now - start) ** 2).sum() / (start**2).sum().clamp(min=1e-6)


def _with_their_places(labels: Labels, rows: NDArray[np.int64]) -> Mask:
    """(N,) bool: some keyframes, and all that show the same places."""
    hidden: Mask = np.asarray(labels.same[rows].any(axis=0))
    hidden[rows] = True
    return hidden


def _share(hits: Sequence[NDArray[np.bool_]]) -> float:
    return float(np.concatenate(hits).mean()) if hits else float("nan")
