"""How other methods learned: `python benchmarks/accuracy/training_curves.py runs --picture curves.png`.

Reads `log.csv` of every run below a folder, draws recall@1 on its validation worlds against steps, and prints what each
found before and after.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import typer


@dataclass(frozen=True)
class Curve:
    """Recall@1 of one run, the first before any step."""

    name: str
    steps: list[int]
    recall1: list[float]
    minutes: float

    @property
    def climbs(self) -> bool:
        """Whether the last validation was its best."""
        return self.recall1[-1] == max(self.recall1)


def read_curve(path: Path) -> Curve:
    """The curve of a `log.csv` that has recall@1, and that of the untrained self."""
    with path.open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    recalls = [float(rows[0]["recall1_untrained"]), *(float(row["recall1"]) for row in rows)]
    return Curve(path.parent.name, [0, *(int(row["step"]) for row in rows)], recalls, float(rows[-1]["seconds"]) / 60)


def draw(curves: list[Curve], picture: Path) -> None:
    figure, axes = plt.subplots(figsize=(6.4, 4.2), layout="constrained")
    for curve in curves:
        axes.plot(curve.steps, curve.recall1, marker=".", label=curve.name)
    axes.set_xlabel("steps")
    axes.set_ylabel("recall@1 on validation worlds")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    figure.savefig(picture, dpi=110)
    plt.close(figure)


def main(
    runs: Annotated[Path, typer.Argument(help="folder of run folders")],
    picture: Annotated[Path | None, typer.Option(help="PNG to write")] = None,
) -> None:
    """Print and draw."""
    curves = [read_curve(path) for path in sorted(runs.glob("*/log.csv"))]
    print("| method | steps | minutes | untrained | best | gain | last is best |\n|---|---:|---:|---:|---:|---:|---|")
    for curve in curves:
        before, best = 100 * curve.recall1[0], 100 * max(curve.recall1[1:])
        ends = f"{curve.steps[-1]} | {curve.minutes:.0f} | {before:.1f} | {best:.1f} | {best - before:+.1f}"
        print(f"| {curve.name} | {ends} | {'yes' if curve.climbs else 'no'} |")
    if picture is not None:
        draw(curves, picture)


if __name__ == "__main__":
    typer.run(main)
