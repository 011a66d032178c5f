"""Metric-learning losses on global descriptors."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def multi_similarity(
    similarity: Tensor, positive: Tensor, negative: Tensor, alpha: float = 2.0, beta: float = 30.0, base: float = 0.5
) -> Tensor:
    """Multi-similarity loss (Wang et al. 2019): every pair pulls as hard as it is wrong among its rivals.

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
    """Neighbourhood components analysis (Goldberger et al. 2004): recall at one, softly counted.

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
    """Triplet loss with the hardest positive and negative per anchor (thesis 3.8 and 4.5.2).

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
