"""Losses of metric learning."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from umf_ros.lab.datasets.sample import Places, Rule, distances, label
from umf_ros.lab.evaluation.retrieval import NEAR_M
from umf_ros.lab.training.batches import TrainingBatch
from umf_ros.lab.training.networks import Branch, MetricSettings
from umf_ros.networks.config import NetworkConfig, NetworkInput
from umf_ros.networks.fusion import Tokens
from umf_ros.networks.local_features import LocalMap, SuperMap
from umf_ros.networks.umf import UMF, Features


def multi_similarity(
    similarity: Tensor, positive: Tensor, negative: Tensor, alpha: float = 2.0, beta: float = 30.0, base: float = 0.5
) -> Tensor:
    """Multi-similarity loss [Wang 2019]: every pair pulls as hard as it is wrong among its rivals.

    Args:
        similarity: (B, M) cosine similarities of anchors and references.
        positive: (B, M) bool.
        negative: (B, M) bool.
        alpha: sharpness for positives.
        beta: sharpness for negatives.
        base: the similarity that divides them.
    """
    absent = torch.finfo(similarity.dtype).min
    pull = (-alpha * (similarity - base)).masked_fill(~positive, absent)
    push = (beta * (similarity - base)).masked_fill(~negative, absent)
    zero = similarity.new_zeros(len(similarity), 1)
    pulls = torch.logsumexp(torch.cat([zero, pull], 1), 1) / alpha
    pushes = torch.logsumexp(torch.cat([zero, push], 1), 1) / beta
    return (pulls + pushes).mean()


def neighbourhood_components(similarity: Tensor, wanted: Tensor, unwanted: Tensor, temperature: float = 0.05) -> Tensor:
    """Neighbourhood components analysis [Goldberger 2004]: recall at one, softly counted.

    Maximises the chance that a reference drawn by its similarity is a wanted one; of several
    wanted ones the most similar is enough.

    Args:
        similarity: (B, R) cosine similarities of queries and references.
        wanted: (B, R) bool.
        unwanted: (B, R) bool.
        temperature: difference of similarity that makes one reference e times as likely as another.
    """
    scores = similarity / temperature
    absent = torch.finfo(scores.dtype).min / 2
    right = torch.logsumexp(scores.masked_fill(~wanted, absent), 1)
    wrong = torch.logsumexp(scores.masked_fill(~unwanted, absent), 1)
    complete = wanted.any(1) & unwanted.any(1)
    return F.softplus((wrong - right)[complete]).sum() / complete.sum().clamp(min=1)


def batch_hard_triplet(
    similarity: Tensor, positive: Tensor, negative: Tensor, margin: float = 0.2
) -> tuple[Tensor, Tensor]:
    """Triplet loss with the hardest positive and negative per anchor [UMF 3.8, 4.5.2].

    Descriptors are unit vectors, so a distance is sqrt(2 - 2 similarity).

    Returns:
        Mean over the active triplets, and the share of triplets that are active.
    """
    distance = (2 - 2 * similarity).clamp(min=1e-6).sqrt()
    far = distance.masked_fill(~positive, -torch.inf).amax(1)
    near = distance.masked_fill(~negative, torch.inf).amin(1)
    complete = positive.any(1) & negative.any(1)
    excess = torch.where(complete, far - near + margin, torch.zeros_like(far)).clamp(min=0)
    active = (excess > 0).sum()
    return excess.sum() / active.clamp(min=1), active / complete.sum().clamp(min=1)


def graded(
    similarity: Tensor, metres: Tensor, comparable: Tensor, gap_m: float = 6.0, sharpness: float = 20.0
) -> Tensor:
    """A place nearer to the anchor must look more like it: what makes the best match also the nearest one.

    Args:
        similarity: (B, M).
        metres: (B, M) distances.
        comparable: (B, M) bool, pairs of one world with headings alike.
        gap_m: pairs whose distances differ by less are not ordered.
        sharpness: of the soft step.
    """
    order = (metres[:, :, None] + gap_m < metres[:, None, :]) & comparable[:, :, None] & comparable[:, None, :]
    wrong = similarity[:, None, :] - similarity[:, :, None]
    penalties = F.softplus(sharpness * wrong + 1.0) / sharpness
    return (penalties * order).sum() / order.sum().clamp(min=1)


def correspondence(
    local: LocalMap, first: Tensor, second: Tensor, matches: Tensor, spare: Tensor | None, temperature: float = 0.07
) -> Tensor:
    """InfoNCE between features that show the same point, in both directions, weighted by saliency.

    The weight lets the attention learn which features are worth keeping. It saturates: otherwise a few
    easy features would draw all the attention and all the training to themselves.

    Args:
        local: local features of a batch.
        first: (L,) rows of the batch that form pairs ...
        second: (L,) ... with these.
        matches: (L, K, 2) features of the first and of the second that correspond, -1 for none.
        spare: (N, N) bool, features so close in the image that confusing them is no error; None: none.
        temperature: of the softmax.
    """
    known = matches[..., 0] >= 0
    index = matches.clamp(min=0)
    one, two = local.descriptors[first], local.descriptors[second]
    there = _cross_entropy(one, two, index[..., 0], index[..., 1], local.mask[second], spare, temperature)
    back = _cross_entropy(two, one, index[..., 1], index[..., 0], local.mask[first], spare, temperature)
    worth = local.saliency / (1 + local.saliency) + 0.1
    weight = worth[first].gather(1, index[..., 0]) * worth[second].gather(1, index[..., 1]) * known
    return ((there + back) / 2 * weight).sum() / weight.sum().clamp(min=1e-3)


def _cross_entropy(
    queries: Tensor, keys: Tensor, rows: Tensor, targets: Tensor, mask: Tensor, spare: Tensor | None, temperature: float
) -> Tensor:
    """(L, K) negative log-likelihood of each target among all keys."""
    wanted = queries.gather(1, rows.unsqueeze(-1).expand(-1, -1, queries.shape[-1]))
    scores = (wanted @ keys.transpose(1, 2)).float() / temperature
    scores = scores.masked_fill(~mask[:, None], -1e4)
    right = scores.gather(2, targets.unsqueeze(-1)).squeeze(-1)
    if spare is not None:
        scores = scores.masked_fill(spare[targets], -1e4)
        return torch.logaddexp(scores.logsumexp(-1), right) - right
    return scores.logsumexp(-1) - right


def neighbours(rows: int, columns: int) -> Tensor:
    """(N, N) bool: cells of a map that touch, or are the same."""
    row, column = torch.arange(rows * columns) // columns, torch.arange(rows * columns) % columns
    return ((row[:, None] - row).abs() <= 1) & ((column[:, None] - column).abs() <= 1)


def wasted_saliency(saliency: Tensor, useful: Tensor) -> Tensor:
    """Share of the saliency (B, N) on features without a known depth, such as the sky; `useful` (B, N) bool."""
    return (saliency * ~useful).sum() / saliency.sum().clamp(min=1e-3)


def eligible(one: Tensor, two: Tensor, ratio: float = 0.9) -> Tensor:
    """(S,) bool: IDs whose super-features match [UMF 4.3, eq. 4.1], with the ratio test the right way round.

    Args:
        one: (S, D) super-features of a frame.
        two: (S, D) of another.
        ratio: largest distance to the same ID over the distance to the best other one.
    """
    distance = torch.cdist(one, two)
    ids = torch.arange(len(one), device=one.device)
    reciprocal = (distance.argmin(1) == ids) & (distance.argmin(0) == ids)
    own = distance.diagonal()
    other = distance.masked_fill(torch.eye(len(one), dtype=torch.bool, device=one.device), torch.inf).amin(0)
    return reciprocal & (own <= ratio * other)


def super_contrastive(supers: SuperMap, first: Tensor, second: Tensor, negative: Tensor, margin: float = 1.1) -> Tensor:
    """Contrastive loss on eligible pairs [UMF 4.3]; negatives have the same ID in frames of other places.

    Args:
        supers: super-features of a batch.
        first: (L,) rows that show the same places ...
        second: (L,) ... as these.
        negative: (B, B) bool, rows that show different places.
        margin: of the squared distance to negatives.
    """
    features = supers.descriptors
    loss = features.new_zeros(())
    pairs = 0
    for one, two in zip(first.tolist(), second.tolist(), strict=True):
        ids = eligible(features[one].detach(), features[two].detach())
        if not ids.any():
            ids = torch.ones_like(ids)  # at the start nothing is eligible: pull all IDs together
        pulled = (features[one, ids] - features[two, ids]).square().sum(-1)
        others = features[negative[one]][:, ids]
        pushed = (margin - (features[one, ids][None] - others).square().sum(-1)).clamp(min=0)
        loss = loss + pulled.sum() + pushed.sum() / max(len(others), 1)
        pairs += int(ids.sum())
    return loss / max(pairs, 1)


def decorrelation(supers: SuperMap) -> Tensor:
    """Mean cosine similarity between the attention maps of different super-features of a frame [UMF 4.3]."""
    maps = F.normalize(supers.attention, dim=-1)
    count = maps.shape[1]
    similarity = maps @ maps.transpose(1, 2)
    own = similarity.diagonal(dim1=1, dim2=2).sum(-1)
    return ((similarity.sum((1, 2)) - own) / (count * (count - 1))).mean()


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


def _encode_branch(network: UMF, batch: NetworkInput, branch: Branch) -> Features:
    """Run the encoder of one branch; the features of the other one are zero."""
    config, zeros = network.config, batch.image.new_zeros
    if branch == "image":
        tokens, fine = network.encode_image(batch)
        scene = None if network.scene is None else network.scene(batch.image)
        nothing = Tokens(zeros(*batch.coarse_index.shape, config.tokens), batch.coarse_mask)
        return Features(tokens, nothing, fine, zeros(*batch.fine_index.shape, config.local), scene)
    rows = len(batch.image)
    cells = zeros(rows, *network.cells.shape)
    nothing = Tokens(cells, torch.ones(cells.shape[:2], dtype=torch.bool, device=cells.device))
    fine_image = zeros(rows, config.local, *network.image_local.positions.shape[:2])
    scene = None if network.scene is None else zeros(rows, config.scene)
    tokens, fine = network.encode_cloud(batch)
    return Features(nothing, tokens, fine_image, fine, scene)


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
        features = network.encode(batch.input) if branch == "both" else _encode_branch(network, batch.input, branch)
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
        cloud = network.cloud_local(fine_cloud, network.voxels(index), mask)
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
            supers = [network.super_image(image.tokens, image.mask), network.super_cloud(cloud.tokens, cloud.mask)]
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
