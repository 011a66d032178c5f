"""Closures whose truth is known, by the domain they are from: what the acceptance model is fitted to and judged by."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from umf_ros.verification.measurement import Measurement

NUMBERS = tuple(one.name for one in fields(Measurement) if one.name != "kind")


@dataclass(frozen=True, slots=True)
class Example:
    """One refined pose and whether it was right.

    Attributes:
        measurement: what verification measured.
        right: whether the pose was.
        domain: sensor, place and mount, or another name for what resembles each other; empty: nothing in particular.
    """

    measurement: Measurement
    right: bool
    domain: str = ""


def save_examples(examples: list[Example], path: Path) -> None:
    """Write examples for `load_examples`, some forty bytes each."""
    numbers = np.array([[getattr(one.measurement, name) for name in NUMBERS] for one in examples], np.float32)
    np.savez_compressed(
        path,
        names=np.array(NUMBERS),
        numbers=numbers,
        kinds=np.array([one.measurement.kind for one in examples]),
        right=np.array([one.right for one in examples]),
        domains=np.array([one.domain for one in examples]),
    )


def load_examples(path: Path) -> list[Example]:
    """Examples from a file; a number that is younger than the file is unknown.

    Raises:
        OSError: the file cannot be read.
    """
    with np.load(path) as content:
        names = [str(name) for name in content["names"]]
        rows, kinds = content["numbers"].astype(float), content["kinds"]
        right, domains = content["right"], content["domains"]
    kept = [(column, name) for column, name in enumerate(names) if name in NUMBERS]
    return [
        Example(Measurement(kind=str(kind), **{name: row[column] for column, name in kept}), bool(yes), str(domain))
        for row, kind, yes, domain in zip(rows, kinds, right, domains, strict=True)
    ]
