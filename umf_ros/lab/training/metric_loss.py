"""The sum of losses that metric learning minimises [UMF 3.1, 4.5.2]."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor, nn

from umf_ros.lab.datasets.labels import Places, Rule, distances, label
from umf_ros.lab.evaluation.protocol import NEAR_M
from umf_ros.lab.training.batches import TrainingBatch
from umf_ros.lab.training.losses import (
    batch_hard_triplet,
    correspondence,
    decorrelation,
    graded,
    multi_similarity,
    neighbourhood_components,
    neighbours,
    super_contrastive,
    wasted_saliency,
)
from umf_ros.lab.training.settings import MetricSettings
from umf_ros.networks.config import NetworkConfig
from umf_ros.networks.umf import UMF, Features


class Bank:
    """Descriptors of past batches, as further references (cross-batch memory [Wang 2020])."""

    def __init__(self, size: int, dimension: int) -> None:
        self._size = size
        self.descriptors = torch.zeros(0, dimension)
        self.places = Places(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0), np.zeros(0))

    def add(self, descriptors: Tensor, places: Places) -> None:
        """Remember a batch, forgetting the oldest."""
        kept = self._size
        if kept == 0:
            return
        self.descriptors = torch.cat([self.descriptors, descriptors.detach().float().cpu()])[-kept:]
        self.places = _join(self.places, places, kept)

    def state(self) -> dict[str, Tensor]:
        """For a checkpoint."""
        arrays = {field.name: getattr(self.places, field.name) for field in fields(Places)}
        return {"descriptors": self.descriptors} | {name: torch.from_numpy(array) for name, array in arrays.items()}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Inverse of `state`."""
        self.descriptors = state["descriptors"]
        self.places = Places(*(state[field.name].numpy() for field in fields(Places)))


def _join(a: Places, b: Places, kept: int) -> Places:
    joined = (np.concatenate([getattr(a, field.name), getattr(b, field.name)]) for field in fields(Places))
    return Places(*(values[-kept:] for values in joined))


@dataclass(frozen=True, slots=True)
class Relations:
    """How the rows of a batch relate to its references (the batch, then the bank).

    Attributes:
        positive, negative: (B, M) bool.
        comparable: (B, B) bool, pairs of one world with like headings.
        metres: (B, B), infinite between worlds.
    """

    positive: Tensor
    negative: Tensor
    comparable: Tensor
    metres: Tensor


def relate(places: Places, bank: Places, rule: Rule, device: torch.device) -> Relations:
    """Relations of a batch to itself and to the bank."""
    count = len(places.world)
    references = _join(places, bank, count + len(bank.world))
    positive, negative = label(places, references, rule)
    positive[:, :count] &= ~np.eye(count, dtype=bool)
    metres, turn = distances(places, places)
    comparable = np.isfinite(metres) & (turn < np.radians(rule.positive_deg)) & ~np.eye(count, dtype=bool)
    tensors = [torch.from_numpy(array).to(device) for array in (positive, negative, comparable, metres)]
    return Relations(*tensors)


def attenuate(values: Tensor, share: float) -> Tensor:
    """The same values, but only this share of the gradient goes back through them."""
    return values * share + values.detach() * (1 - share)


class MetricLoss(nn.Module):
    """Losses of a network on one batch."""

    def __init__(self, config: NetworkConfig, settings: MetricSettings, rule: Rule) -> None:
        super().__init__()
        self._settings = settings
        self._rule = rule
        self._near: Tensor
        height, width = config.image_size
        self.register_buffer("_near", neighbours(height // 4, width // 4), persistent=False)

    def forward(self, network: UMF, batch: TrainingBatch, bank: Bank) -> tuple[dict[str, Tensor], Tensor]:
        """Losses by name, "total" among them, and the fused descriptors.

        Args:
            network: to be judged.
            batch: the batch, on the network's device.
            bank: past descriptors; none are used while it is empty.
        """
        branch = self._settings.branch
        image_kept, cloud_kept = batch.image_kept, batch.cloud_kept
        features = network.encode(batch.input, branch)
        if branch != "both":
            nothing = torch.zeros_like(image_kept)
            image_kept = batch.input.image_present if branch == "image" else nothing
            cloud_kept = batch.input.coarse_mask.any(1) if branch == "cloud" else nothing
        fused = network.fuse(features, image_kept, cloud_kept).descriptor
        relations = relate(batch.places, bank.places, self._rule, fused.device)
        alone = _alone(network, features, batch) if branch == "both" else {}
        # similarities need all their digits: at first they differ in the third
        with torch.autocast(fused.device.type, enabled=False):
            losses, active = self._global(fused, (image_kept, cloud_kept), alone, bank, relations)
        if len(batch.local_rows):
            losses |= self._local(network, features, batch, relations.negative[:, : len(fused)])
        weights = self._weights()
        total = sum((weights[name] * value for name, value in losses.items()), start=fused.new_zeros(()))
        return losses | {"total": total, "active": active}, fused

    def _weights(self) -> dict[str, float]:
        s = self._settings
        return {
            "fused": 1.0,
            "image": s.weight_image,
            "cloud": s.weight_cloud,
            "graded": s.weight_graded,
            "cells": s.weight_local,
            "voxels": s.weight_local,
            "wasted": s.weight_local,
            "super": s.weight_super,
        }

    def _global(
        self,
        fused: Tensor,
        present: tuple[Tensor, Tensor],
        alone: dict[str, tuple[Tensor, Tensor]],
        bank: Bank,
        relations: Relations,
    ) -> tuple[dict[str, Tensor], Tensor]:
        count = len(fused)
        similarity = fused @ torch.cat([fused, bank.descriptors.to(fused.device)]).T
        # an image and a scan alone have nothing in common: no pair to learn from
        shared = torch.ones_like(relations.positive)
        images, clouds = (there[:, None] & there[None] for there in present)
        shared[:, :count] = images | clouds
        losses: dict[str, Tensor] = {}
        losses["fused"], active = self._metric(similarity, relations.positive & shared, relations.negative & shared)
        comparable = relations.comparable & shared[:, :count]
        losses["graded"] = self._graded(similarity[:, :count], relations, comparable)
        for name, (descriptor, there) in alone.items():
            both = there[:, None] & there[None]
            positive, negative = relations.positive[:, :count] & both, relations.negative[:, :count] & both
            losses[name], share = self._metric(descriptor @ descriptor.T, positive, negative)
            active = torch.maximum(active, share)
        return losses, active

    def _metric(self, similarity: Tensor, positive: Tensor, negative: Tensor) -> tuple[Tensor, Tensor]:
        if self._settings.loss == "triplet":
            return batch_hard_triplet(similarity, positive, negative)
        if self._settings.loss == "neighbourhood":
            return neighbourhood_components(similarity, positive, negative), similarity.new_ones(())
        return multi_similarity(similarity, positive, negative), similarity.new_ones(())

    def _graded(self, similarity: Tensor, relations: Relations, comparable: Tensor) -> Tensor:
        if self._settings.loss != "neighbourhood":
            return graded(similarity, relations.metres, comparable)
        right = relations.positive[:, : len(similarity)] & comparable
        near = right & (relations.metres < NEAR_M)
        return neighbourhood_components(similarity, near, right & ~near)

    def _local(self, network: UMF, features: Features, batch: TrainingBatch, negative: Tensor) -> dict[str, Tensor]:
        rows, share = batch.local_rows, self._settings.local_gradient
        fine_image = attenuate(features.fine_image[rows], share)
        fine_cloud = attenuate(features.fine_cloud[rows], share)
        image = network.image_local(fine_image)
        index, mask = batch.input.fine_index[rows], batch.input.fine_mask[rows]
        cloud = network.cloud_local(fine_cloud, network.voxels[index], mask)
        count = len(rows) // 2
        first = torch.arange(count, device=rows.device)
        pairs = first, first + count
        losses = {
            "cells": correspondence(image, *pairs, batch.cells, self._near),
            "voxels": correspondence(cloud, *pairs, batch.voxels, None),
            "wasted": wasted_saliency(image.saliency, batch.useful_cells),
        }
        if self._settings.weight_super:
            different = negative[rows][:, rows]
            supers = [
                network.super_image(image.tokens, image.mask),
                network.super_cloud(cloud.tokens, cloud.mask),
            ]
            parts = [super_contrastive(found, *pairs, different) + decorrelation(found) for found in supers]
            losses["super"] = parts[0] + parts[1]
        return losses


def _alone(network: UMF, features: Features, batch: TrainingBatch) -> dict[str, tuple[Tensor, Tensor]]:
    """Descriptors (B, D) of each modality without the other, and which frames (B,) have it.

    The other modality's tokens must not be there: what is learned with them at hand is not the image's own.
    """
    images, clouds = batch.input.image_present, batch.input.coarse_mask.any(1)
    nothing = torch.zeros_like(images)
    return {
        "image": (network.fuse(features, images, nothing).descriptor, images),
        "cloud": (network.fuse(features, nothing, clouds).descriptor, clouds),
    }
