"""One evaluation on sets of places: its embedder, its report."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from umf_ros.core.config import EmbeddingSettings, Verification
from umf_ros.embedding import make_embedder
from umf_ros.lab.evaluation.places import read_place_sets, score_places, table_of
from umf_ros.lab.evaluation.results import EvaluationReport

TITLE = "Place recognition on still images and scans"


def evaluate_place_sets(
    listing: Path, method: str, weights: Path | None, report: Callable[[str], None]
) -> EvaluationReport:
    """Score one method on all sets of a list.

    Args:
        listing: YAML file of the sets.
        method: embedder by name.
        weights: of the network; None: the default.
        report: called with what is worked on.

    Raises:
        ConfigError: no such list, or an unknown method.
        UmfError: something of a set is missing or damaged.
    """
    sets = read_place_sets(listing)
    settings = Verification()
    wanted = EmbeddingSettings(method=method, weights=str(weights or ""))
    embedder = make_embedder(wanted, super_features=True, features=settings.features)
    results = []
    for places in sets:
        report(places.name)
        results.append(score_places(places, embedder, settings))
    figures = {name: value for found in results for name, value in found.flat.items()}
    notes = [f"{listing}, embedded by {embedder.name}. A match is true where the set says so."]
    return EvaluationReport(TITLE, notes, figures, {TITLE: table_of(results)})
