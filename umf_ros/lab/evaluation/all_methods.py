"""`umf evaluate --methods all`: which sets, which methods, one report."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from umf_ros.core.errors import UmfError
from umf_ros.lab.evaluation.methods_run import FrameSet, MethodsRun, make_others
from umf_ros.lab.evaluation.results import EvaluationReport

TITLE = "All methods"


def compare_methods(
    sets: Iterable[FrameSet],
    notes: list[str],
    weights: Path | None,
    trained: Path | None,
    make_folder: Callable[[], Path],
    repeats: int,
    report: Callable[[str, int], None],
) -> tuple[EvaluationReport, Path]:
    """Ask all sets by all methods.

    Args:
        sets: what is asked.
        notes: of the sets, for the report.
        weights: of UMF; None: the default.
        trained: folder with the weights of other methods; None: the shipped ones.
        make_folder: makes the folder to write to, once everything else has worked.
        repeats: how often each frame is embedded when time is taken.
        report: called with the name of what is worked on, and 1 for every frame done.

    Raises:
        UmfError: a set or the weights cannot be read, or no place is seen twice.
    """
    others, missing = make_others(trained)
    run = MethodsRun(weights, others, report)
    asked = {places.name: run.add(places) for places in sets}
    if not any(asked.values()):
        raise UmfError(f"no place is seen twice in {', '.join(asked)}, so that nothing can be asked")
    folder = make_folder()
    said = [
        "Intervals: queries drawn anew within each set, 1000 times. Matching: the best of 858 places, then 20 of them "
        "again by local features where a reranker is named. R@1 + XFeat: UMF's default features of images rerank the "
        "method's own 20 best. Times are medians on this machine, as busy as it was."
    ]
    said += [f"Not asked: {name}, where no place is seen twice in one direction." for name in asked if not asked[name]]
    said += [f"Not compared: {line}." for line in missing]
    return run.write(TITLE, [*notes, *said], folder, repeats), folder
