"""Fit a vocabulary of binary words."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from umf_ros.baselines.dbow2 import METHOD, Binary, Indices, OrbFeatures, Vocabulary
from umf_ros.core.config import Group, problems
from umf_ros.core.errors import ConfigError
from umf_ros.core.io import read_values, write_atomically
from umf_ros.lab.datasets.listed import open_source
from umf_ros.lab.datasets.sample import SampleSequence

Signs = NDArray[np.float32]
"""(N, 256) bits as -1 and 1: of two such rows, the product is 256 less twice the Hamming distance."""
ROUNDS = 10


class VocabularySettings(Group):
    """Size of the tree, and what it grows from."""

    train: str = Field(description="folder of simulated worlds, or YAML file that lists sequences")
    branching: int = Field(10, ge=2, le=64, description="children of a node")
    depth: int = Field(4, ge=1, le=6, description="levels; 10 to the power of 6 are a million words")
    every: int = Field(1, ge=1, description="every n-th image")
    seed: int = Field(0, ge=0, description="of the seeding")


def vocabulary_settings(path: Path | None, **overrides: object) -> VocabularySettings:
    """Settings from a YAML file and overrides; None is skipped.

    Raises:
        ConfigError: unreadable file, unknown name or wrong value.
    """
    values = read_values(path) if path else {}
    values |= {name: value for name, value in overrides.items() if value is not None}
    try:
        return VocabularySettings.model_validate(values)
    except ValidationError as error:
        raise ConfigError(problems(error)) from None


def fit_vocabulary(settings: VocabularySettings, out: Path, report: Callable[[str], None]) -> Path:
    """Grow a vocabulary and write it.

    Args:
        settings: of the tree.
        out: folder to write `dbow2.safetensors` to.
        report: called with what is worked on.

    Raises:
        ConfigError: there are no images.
        OutputError: it cannot be written.
    """
    worlds = open_source(Path(settings.train)).refresh()
    images = list(_features(worlds, settings.every, report))
    if not sum(map(len, images)):
        raise ConfigError(f"train: there are no images with features in {settings.train}")
    report("clustering")
    vocabulary = grow(images, settings.branching, settings.depth, np.random.default_rng(settings.seed))
    path = out / f"{METHOD}.safetensors"
    vocabulary.save(path)
    write_card(path, vocabulary, settings, [world.name for world in worlds], len(images))
    report(f"{vocabulary.words} words of {len(images)} images")
    return path


def write_card(
    path: Path, vocabulary: Vocabulary, settings: VocabularySettings, worlds: list[str], images: int
) -> None:
    """Say beside a vocabulary what it grew from; of folders only the name."""
    said = settings.model_dump() | {"train": Path(settings.train).name}
    facts = {"name": METHOD, "words": vocabulary.words, "images": images, "training_worlds": worlds, "settings": said}
    write_atomically(path.with_suffix(".json"), json.dumps(facts, indent=2) + "\n")


def _features(sequences: Sequence[SampleSequence], every: int, report: Callable[[str], None]) -> Iterator[Binary]:
    orb = OrbFeatures()
    for sequence in sequences:
        report(sequence.name)
        for index in range(0, len(sequence), every):
            image = sequence.sample(index).image
            if image is not None:
                yield orb.of(image)


def grow(images: Sequence[Binary], branching: int, depth: int, rng: np.random.Generator) -> Vocabulary:
    """A tree over the descriptors of some images, weighted by how few images know a word."""
    signs = _signs(np.concatenate(images))
    nodes: list[NDArray[np.bool_]] = [np.zeros(256, bool)]
    first, count = [0], [0]
    waiting = [(0, 0, np.arange(len(signs)))]
    while waiting:
        node, level, members = waiting.pop(0)
        if level == depth or len(members) < 2:
            continue
        medians, nearest = k_medians(signs[members], branching, rng)
        if len(medians) < 2:
            continue
        first[node], count[node] = len(nodes), len(medians)
        for child, median in enumerate(medians):
            waiting.append((len(nodes), level + 1, members[nearest == child]))
            nodes.append(median > 0)
            first.append(0)
            count.append(0)
    bits = np.packbits(np.stack(nodes), axis=1)
    tree = Vocabulary(bits, np.array(first), np.array(count), np.ones(len(nodes), np.float32))
    return Vocabulary(bits, tree.first_child, tree.children, _idf(tree, images))


def k_medians(signs: Signs, count: int, rng: np.random.Generator) -> tuple[Signs, Indices]:
    """Medians (K, 256) of rows (N, 256) and which of them is each row's; fewer where rows are alike.

    The first medians are rows, each drawn by its squared distance to those before it (k-means++).
    """
    chosen = [signs[rng.integers(len(signs))]]
    nearest = _distance(signs, np.stack(chosen))[:, 0]
    while len(chosen) < count and nearest.any():
        weight = nearest.astype(float) ** 2
        chosen.append(signs[rng.choice(len(signs), p=weight / weight.sum())])
        nearest = np.minimum(nearest, _distance(signs, chosen[-1][None])[:, 0])
    medians = np.stack(chosen)
    member = _distance(signs, medians).argmin(axis=1)
    for _ in range(ROUNDS):
        known = np.unique(member)
        medians = np.stack([np.where(signs[member == one].sum(axis=0) >= 0, 1, -1) for one in known])
        medians = medians.astype(np.float32)
        changed = _distance(signs, medians).argmin(axis=1)
        if np.array_equal(known[changed], member):
            break
        member = changed
    known, member = np.unique(_distance(signs, medians).argmin(axis=1), return_inverse=True)
    return medians[known], member


def _signs(descriptors: Binary) -> Signs:
    return np.unpackbits(descriptors, axis=1).astype(np.float32) * 2 - 1


def _distance(signs: Signs, medians: Signs) -> Signs:
    return (signs.shape[1] - signs @ medians.T) / 2


def _idf(tree: Vocabulary, images: Sequence[Binary]) -> NDArray[np.float32]:
    known = np.zeros(len(tree.nodes))
    for descriptors in images:
        known[np.unique(tree.descend(descriptors))] += 1
    return np.log(len(images) / np.maximum(known, 1)).astype(np.float32)
