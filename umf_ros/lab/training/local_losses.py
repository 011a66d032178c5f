"""Losses on local and super-features."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from umf_ros.networks.local_features import LocalMap
from umf_ros.networks.superfeatures import SuperMap


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
    queries: Tensor,
    keys: Tensor,
    rows: Tensor,
    targets: Tensor,
    mask: Tensor,
    spare: Tensor | None,
    temperature: float,
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
    """(S,) bool: IDs whose super-features match (thesis eq. 4.1, with the ratio test the right way round).

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
    """Contrastive loss on eligible pairs (thesis 4.3); negatives have the same ID in frames of other places.

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
    """Mean cosine similarity between the attention maps of different super-features of a frame (thesis 4.3)."""
    maps = F.normalize(supers.attention, dim=-1)
    count = maps.shape[1]
    similarity = maps @ maps.transpose(1, 2)
    own = similarity.diagonal(dim1=1, dim2=2).sum(-1)
    return ((similarity.sum((1, 2)) - own) / (count * (count - 1))).mean()
