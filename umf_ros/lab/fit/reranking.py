"""Fit the likelihood ratios of the reranking to simulated worlds and to sets of real images and scans.

python -m umf_ros.lab.fit.reranking PLACES.yaml [--kept FOLDER] [--out FILE] [--figure FILE]

Simulated worlds are of training seeds that no weights were trained on and of validation seeds; PLACES.yaml lists
development sets (docs/training.md). A query's best candidates are compared with each other: the ratios are those under
which the right ones are likeliest, of the similarity first, then of every feature type given the similarity. Pairs
that are near but not the same place are neither right nor wrong.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import matplotlib.pyplot as plt
import numpy as np
import typer
from rich.console import Console
from rich.progress import track
from scipy.optimize import minimize
from scipy.special import expit

from umf_ros.core.config import EmbeddingSettings, Verification
from umf_ros.core.frames import Frame, Keyframe
from umf_ros.core.geometry import Array
from umf_ros.core.io import write_atomically
from umf_ros.embedding import FeatureRequest
from umf_ros.embedding.local_features import WithXFeat
from umf_ros.embedding.umf import make
from umf_ros.lab.evaluation.places import PlaceSet, read_place_sets, read_set
from umf_ros.lab.evaluation.retrieval import (
    RERANKERS,
    THESIS_RULE,
    TOP_K,
    Mask,
    RetrievalTask,
    as_keyframe,
    place_recognition,
)
from umf_ros.lab.evaluation.worlds import FIRST, QUICK, REVISIT, TestWorld
from umf_ros.verification.rerank import log_ratio

SEEDS = (*range(5000, 5016), *range(10000, 10008))
SAMPLING = replace(QUICK, revisit=2)
DEFAULT_OUT = Path("config/verification/reranking.json")
METHODS = {
    "xfeat": ("ransac", "xfeat"),
    "umf": ("ransac", "xfeat"),
    "cloud": ("ransac", "cloud"),
    "super_image": ("superfeatures", "super_image"),
    "super_cloud": ("superfeatures", "super_cloud"),
}
"""How each feature type is counted: the name in `RERANKERS`, and in what that counts."""
USED = {"ransac": ("xfeat", "cloud"), "ransac, umf": ("umf", "cloud"), "superfeatures": ("super_image", "super_cloud")}
NEIGHBOURS = 5  # by hand: references of a set this near to a true one, in their order, are neither right nor wrong
# on squared slopes, per standard deviation: real sets in which the similarity leaves no doubt must not set its slope.
# Measured: the likelihood of sets that are left out is flat from 1e-3 to 1e-2; with more, recall falls
RIDGE = 1e-3
EDGES = np.array([0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99, 0.999, 1.0])
FOLDS = 3  # of simulated worlds; a real set is left out by itself
Fitted = dict[str, dict[str, float]]


@dataclass(frozen=True)
class Examples:
    """The best candidates (Q, K) of the queries of a set.

    Attributes:
        name: of the world or set.
        simulated: whether it is a world.
        similarity: (Q, K) cosine similarities.
        right: (Q, K) whether a candidate is the same place.
        wrong: (Q, K) whether it is another; False of both: neither.
        counts: (Q, K) by feature type, NaN where a side has no such features.
    """

    name: str
    simulated: bool
    similarity: Array
    right: Mask
    wrong: Mask
    counts: Mapping[str, Array]

    def score(self, fitted: Fitted, names: Sequence[str]) -> Array:
        """Log-likelihood ratios (Q, K) by the similarity and some feature types."""
        seen = (self.ratio(name, fitted[name]) for name in names)
        return fitted["similarity"]["slope"] * self.similarity + sum(seen)

    def ratio(self, name: str, numbers: dict[str, float]) -> Array:
        """Log-likelihood ratios (Q, K) by one feature type, 0 where it was not seen."""
        counts = self.counts[name]
        return np.where(np.isfinite(counts), log_ratio(np.nan_to_num(counts), **numbers), 0.0)

    @property
    def asked(self) -> Mask:
        """(Q,) whether a query has right and wrong candidates."""
        return np.asarray(self.right.any(axis=1) & self.wrong.any(axis=1))

    def save(self, path: Path) -> None:
        """Write it for `load`."""
        path.parent.mkdir(parents=True, exist_ok=True)
        parts = {"similarity": self.similarity, "right": self.right, "wrong": self.wrong}
        np.savez_compressed(path, **parts, **self.counts)  # type: ignore[arg-type]

    @classmethod
    def load(cls, path: Path, name: str, simulated: bool) -> Examples:
        """Read what `save` wrote."""
        with np.load(path) as content:
            counts = {one: content[one] for one in METHODS}
            return cls(name, simulated, content["similarity"], content["right"], content["wrong"], counts)


def read_world(seed: int) -> tuple[list[Frame], RetrievalTask, Mask]:
    """Frames of the first two passes of a world, the task, and the pairs (Q, R) that are near."""
    visits = list(TestWorld(seed, SAMPLING).driven((FIRST, REVISIT)))
    poses = np.stack([one.world_T_body for one in visits])
    task = place_recognition(poses, np.array([one.pass_index for one in visits]))
    near = (task.metres < THESIS_RULE.negative_m) & (task.turn_deg < THESIS_RULE.negative_deg)
    return [one.frame for one in visits], task, near


def near_places(task: RetrievalTask) -> Mask:
    """Pairs (Q, R) of a set that are at most `NEIGHBOURS` references from a true one."""
    near = task.positive.copy()
    for shift in range(1, NEIGHBOURS + 1):
        near[:, shift:] |= task.positive[:, :-shift]
        near[:, :-shift] |= task.positive[:, shift:]
    return near


class ExampleMaker:
    """Embeds frames with every feature type, and counts what their candidates share."""

    def __init__(self) -> None:
        settings = EmbeddingSettings()
        self._umf = make(settings, FeatureRequest(image=True, supers=True))
        self._with_xfeat = WithXFeat(self._umf, settings)

    def of_world(self, seed: int) -> Examples:
        """Examples of the second pass of a world."""
        return self._examples(f"world {seed}", True, *read_world(seed))

    def of_set(self, places: PlaceSet) -> Examples:
        """Examples of a set of images or scans."""
        frames, task = read_set(places)
        return self._examples(places.name, False, frames, task, near_places(task))

    def _examples(self, name: str, simulated: bool, frames: list[Frame], task: RetrievalTask, near: Mask) -> Examples:
        own = [as_keyframe(frame, self._umf.embed(frame)) for frame in frames]
        others = [as_keyframe(frame, self._with_xfeat.embed(frame)) for frame in frames]
        descriptors = np.stack([one.embedding.descriptor for one in own])
        similarity = descriptors[task.queries] @ descriptors[task.references].T
        best = np.argsort(-similarity, axis=1, kind="stable")[:, :TOP_K]
        counts = {one: np.full(best.shape, np.nan) for one in METHODS}
        for one, found in counts.items():
            keyframes = others if one == "xfeat" else own
            for row, head in enumerate(best):
                matches = [keyframes[task.references[index]] for index in head]
                found[row] = _counts(one, keyframes[task.queries[row]], matches)
        right, close = (np.take_along_axis(mask, best, axis=1) for mask in (task.positive, near))
        chosen = np.take_along_axis(similarity, best, axis=1)
        return Examples(name, simulated, chosen, right, ~right & ~close, counts)


def _counts(name: str, query: Keyframe, matches: list[Keyframe]) -> Array:
    """(K,) what a query shares with its candidates of one feature type, NaN where a side has none."""
    way, counted = METHODS[name]
    found = [RERANKERS[way](query, match, Verification())[counted] for match in matches]
    return np.array(found, float)  # None becomes NaN


def fit(examples: Sequence[Examples]) -> Fitted:
    """The similarity's slope, then floor, onset and slope of each feature type given it.

    Simulated worlds weigh as much as real sets, and a world or set as much as any other.
    """
    found = {"similarity": {"slope": _fit_similarity(examples)}}
    for name in METHODS:
        seen = [one for one in examples if np.isfinite(one.counts[name]).any()]
        found[name] = _fit_counts(seen, name, found)
    return found


def _fit_similarity(examples: Sequence[Examples]) -> float:
    spread = float(np.mean([one.similarity.std(axis=1).mean() for one in examples]))

    def loss(slope: Array) -> float:
        scores = [slope[0] / spread * one.similarity for one in examples]
        return surprise(examples, scores) + RIDGE * float(slope[0]) ** 2

    return float(minimize(loss, [1.0], method="Nelder-Mead").x[0]) / spread


def _fit_counts(examples: Sequence[Examples], name: str, known: Fitted) -> dict[str, float]:
    given = [one.score(known, ()) for one in examples]
    values = np.concatenate([np.log1p(one.counts[name][np.isfinite(one.counts[name])]) for one in examples])
    spread = max(float(values.std()), 1e-6)

    def numbers(at: Array, floor: float = 0.0) -> dict[str, float]:
        onset = float(np.expm1(np.clip(at[1], 0.0, values.max())))
        return {"floor": floor, "onset": onset, "slope": float(at[0] / spread)}

    def said(at: Array, floor: float = 0.0) -> list[Array]:
        return [one.ratio(name, numbers(at, floor)) for one in examples]

    def loss(at: Array) -> float:
        return surprise(examples, [a + b for a, b in zip(given, said(at), strict=True)]) + RIDGE * at[0] ** 2

    starts = [np.array([1.0, np.quantile(values, 0.2)]), np.array([3.0, np.quantile(values, 0.6)])]
    best = min((minimize(loss, start, method="Nelder-Mead") for start in starts), key=lambda one: float(one.fun)).x
    # the floor orders nothing among candidates that were all seen; it says what being seen is worth
    floor = minimize(lambda at: _imbalance(examples, name, said(best, at[0])), [0.0], method="Nelder-Mead").x[0]
    return numbers(best, float(floor))


def _shares(examples: Sequence[Examples]) -> list[float]:
    """Weight of each world or set."""
    worlds = sum(one.simulated for one in examples)
    return [0.5 / (worlds if one.simulated else len(examples) - worlds) for one in examples]


def surprise(examples: Sequence[Examples], scores: Sequence[Array]) -> float:
    """Mean negative log-likelihood that a query's right candidates are the right ones."""
    total = 0.0
    for one, odds, share in zip(examples, scores, _shares(examples), strict=True):
        if one.asked.any():
            total -= share * float(np.log(right_share(one, odds)[one.asked] + 1e-12).mean())
    return total


def _imbalance(examples: Sequence[Examples], name: str, ratios: Sequence[Array]) -> float:
    """Negative log-likelihood of right and wrong candidates, as many of the one as of the other."""
    total = 0.0
    for one, ratio, share in zip(examples, ratios, _shares(examples), strict=True):
        for which, sign in ((one.right, 1.0), (one.wrong, -1.0)):
            chosen = which & np.isfinite(one.counts[name])
            total += share * float(np.logaddexp(0.0, -sign * ratio[chosen]).mean()) if chosen.any() else 0.0
    return total


def right_share(one: Examples, scores: Array) -> Array:
    """(Q,) probability of the right candidates among right and wrong ones."""
    odds = np.where(one.right | one.wrong, scores, -np.inf)
    best = odds.max(axis=1, keepdims=True)
    weights = np.exp(odds - np.where(np.isfinite(best), best, 0.0))
    return np.asarray(np.where(one.right, weights, 0.0).sum(axis=1) / np.maximum(weights.sum(axis=1), 1e-300))


def left_out(examples: Sequence[Examples]) -> list[Fitted]:
    """For each world or set, what is fitted without it: without a third of the worlds, or without one set."""
    worlds = [one for one in examples if one.simulated]
    folds = [worlds[first::FOLDS] for first in range(FOLDS)] + [[one] for one in examples if not one.simulated]
    found: dict[str, Fitted] = {}
    for fold in track(folds, "fitting", transient=True):
        names = {one.name for one in fold}
        numbers = fit([one for one in examples if one.name not in names])
        found |= dict.fromkeys(names, numbers)
    return [found[one.name] for one in examples]


def recall1(one: Examples, scores: Array) -> float:
    """Recall@1 of the queries that have a right candidate; near places count as wrong."""
    asked = one.right.any(axis=1)
    return float(one.right[np.arange(len(scores)), scores.argmax(axis=1)][asked].mean())


def reliability(examples: Sequence[Examples], scores: Sequence[Array], edges: Array) -> list[tuple[float, float, int]]:
    """Stated and true share of pairs of a right and a wrong candidate in which the right one scores more.

    A difference of log-likelihood ratios states the probability that the higher one is right.

    Returns:
        Mean stated probability, share that is right, and number of pairs, for each bin of the probability.
    """
    gaps = []
    for one, odds in zip(examples, scores, strict=True):
        both = one.right[:, :, None] & one.wrong[:, None]
        gaps.append((odds[:, :, None] - odds[:, None])[both])
    gap = np.concatenate(gaps)
    stated, bins = expit(np.abs(gap)), np.digitize(expit(np.abs(gap)), edges[1:-1])
    found = []
    for number in range(len(edges) - 1):
        mine = bins == number
        shares = (float(stated[mine].mean()), float((gap[mine] > 0).mean())) if mine.any() else (np.nan, np.nan)
        found.append((*shares, int(mine.sum())))
    return found


def main(
    listing: Annotated[Path, typer.Argument(help="development sets of images and scans")],
    kept: Annotated[Path, typer.Option(help="folder that keeps the examples for the next time")] = Path("runs/rerank"),
    out: Annotated[Path, typer.Option(help="where the fitted numbers go")] = DEFAULT_OUT,
    figure: Annotated[Path | None, typer.Option(help="reliability curve, PNG")] = None,
) -> None:
    """Count the features of pairs, fit the ratios, and write them with what they reach on sets left out."""
    console, sets = Console(), read_place_sets(listing)
    examples = _gather(sets, kept)
    fitted, without = fit(examples), left_out(examples)
    results = {}
    for one, numbers in zip(examples, without, strict=True):
        found = {way: recall1(one, one.score(numbers, names)) for way, names in USED.items()}
        results[one.name] = {"similarity": recall1(one, one.similarity)} | found
        console.print(one.name, {name: round(value, 3) for name, value in results[one.name].items()})
    worlds = [results[one.name] for one in examples if one.simulated]
    summary = {name: float(np.mean([each[name] for each in worlds])) for name in worlds[0]}
    told = {one.name: results[one.name] for one in examples if not one.simulated} | {"simulated worlds": summary}
    content = {"fitted_with": "python -m umf_ros.lab.fit.reranking", "likelihoods": fitted, "recall1_left_out": told}
    write_atomically(out, json.dumps(content, indent=2) + "\n")
    _show(console, examples, without, figure)
    console.print(f"wrote {out}: simulated worlds {summary}")


def _gather(sets: Sequence[PlaceSet], kept: Path) -> list[Examples]:
    maker: ExampleMaker | None = None
    found = []
    for item in track([*SEEDS, *sets], "counting", transient=True):
        simulated = isinstance(item, int)
        name = f"world {item}" if isinstance(item, int) else item.name
        path = kept / f"{name.replace(' ', '_')}.npz"
        if not path.exists():
            maker = maker or ExampleMaker()
            (maker.of_world(item) if isinstance(item, int) else maker.of_set(item)).save(path)
        found.append(Examples.load(path, name, simulated))
    return found


def _show(console: Console, examples: Sequence[Examples], without: Sequence[Fitted], figure: Path | None) -> None:
    """Print and draw how often the likelier candidate of a pair is right."""
    drawing, axes = plt.subplots(figsize=(5, 4.6), layout="constrained")
    axes.plot([0.5, 1], [0.5, 1], color="#999999", linewidth=0.8)
    for simulated, label in ((True, "simulated worlds"), (False, "real sets")):
        chosen = [(one, numbers) for one, numbers in zip(examples, without, strict=True) if one.simulated == simulated]
        scores = [one.score(numbers, USED["ransac"]) for one, numbers in chosen]
        bins = reliability([one for one, _ in chosen], scores, EDGES)
        for stated, right, number in bins:
            console.print(f"{label}: stated {stated:.3f}, right {right:.3f}, of {number} pairs")
        axes.plot([row[0] for row in bins], [row[1] for row in bins], marker="o", label=label)
    axes.set_xlabel("stated probability that the likelier of two candidates is right")
    axes.set_ylabel("share")
    axes.legend()
    if figure is not None:
        drawing.savefig(figure, dpi=110)
    plt.close(drawing)


if __name__ == "__main__":
    typer.run(main)
