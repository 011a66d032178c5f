"""Losses: of metric learning on global descriptors, of correspondence on local and super-features."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from umf_ros.networks.local_features import LocalMap, SuperMap


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

    What is maximised is the chance that a reference drawn by its similarity is a wanted one; of several
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
