"""One evaluation on sets of places: its embedder, its report."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from umf_ros.config import EmbeddingSettings, Verification
from umf_ros.embedding import make_embedder
from umf_ros.lab.evaluation.markdown import Table, to_markdown
from umf_ros.lab.evaluation.places import read_place_sets, score_places, table_of
from umf_ros.runs.folder import create_run_folder, write_atomically

TITLE = "Place recognition on still images and scans"


def run_place_sets(
    listing: Path, method: str | None, weights: Path | None, out: Path, report: Callable[[str], None]
) -> tuple[dict[str, float | int | None], Table, Path]:
    """Score one method on all sets of a list, and write the report.

    Args:
        listing: YAML file of the sets.
        method: embedder by name; None: umf.
        weights: of the network; None: the default.
        out: gets a folder with `evaluation.md` and `evaluation.json`.
        report: called with what is worked on.

    Returns:
        The figures by "<set>.<figure>", the table for people, and the folder.

    Raises:
        ConfigError: no such list, or an unknown method.
        UmfError: something of a set is missing or damaged.
    """
    sets = read_place_sets(listing)
    settings = EmbeddingSettings(method=method or "umf", weights=str(weights) if weights else "")
    embedder = make_embedder(settings, super_features=True)
    results = []
    for places in sets:
        report(places.name)
        results.append(score_places(places, embedder, Verification()))
    figures = {name: value for found in results for name, value in found.flat().items()}
    shown, folder = table_of(results), create_run_folder(out)
    notes = [f"{listing}, embedded by {embedder.name}. A match is true where the set says so."]
    write_atomically(folder / "evaluation.json", json.dumps(figures, indent=2) + "\n")
    write_atomically(folder / "evaluation.md", to_markdown(TITLE, notes, {TITLE: shown}, {}))
    return figures, shown, folder
