"""Why a keyframe closed no loop: the gate, by how much, the parameter, and what that costs."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
from finished_runs import BELOW, candidate, closure, examined, stamp, trajectory

from umf_ros.core.config import load_settings
from umf_ros.runs.diagnosis import ClosureDiagnosis, explain, missing
from umf_ros.runs.run_file import RunFile
from umf_ros.runs.truth import JudgedRun
from umf_ros.verification import RejectReason


def write_descriptors(folder: Path, descriptors: np.ndarray) -> None:
    with closing(RunFile(folder)) as file, file.writing():
        for number, descriptor in enumerate(descriptors):
            file.append_descriptor(stamp(2 * number), descriptor)


def why(about: JudgedRun, second: float) -> ClosureDiagnosis:
    row = about.row(stamp(second))
    assert row is not None
    return explain(about, row)


def test_a_keyframe_with_nothing_old_enough_is_stopped_by_the_gap_rules(tmp_path: Path) -> None:
    found = why(examined(tmp_path, truth=trajectory()), 12)
    assert (found.gate, found.match_stamp_ns) == ("gap rules", None)
    assert "none of 6 earlier keyframes is 20 s older and 15 m back; the first is 12.0 s older" in found.what


def test_a_place_that_was_not_returned_comes_with_its_rank(tmp_path: Path) -> None:
    descriptors = np.zeros((40, 4), "<f2")
    descriptors[:, 0] = 1
    descriptors[:20, 0], descriptors[:20, 1] = np.linspace(0.9, 0.5, 20), 0.3
    descriptors[5, 0] = 0.7  # the place of 50 s, seen at 10 s
    descriptors[[4, 6, 3, 7, 2, 8, 1, 9, 0, 10], 0] = 0.2  # what else is within 12 m
    write_descriptors(tmp_path, descriptors)
    about = examined(tmp_path, candidates=[candidate(50, 30, RejectReason.IMPROBABLE)], truth=trajectory())
    found = why(about, 50)
    assert found.gate == "retrieval" and found.match_stamp_ns == stamp(10) and found.distance_m == 0
    assert found.what.startswith("the database returned 1 candidates, none of them the place 0.0 m away, which has ra")
    assert found.parameter.startswith("loop.top_k: ")


def test_a_probability_that_is_too_low_says_by_how_much_and_what_the_parameter_costs(tmp_path: Path) -> None:
    tested = [
        candidate(50, 10, RejectReason.IMPROBABLE, **BELOW),
        candidate(52, 30, RejectReason.IMPROBABLE, **(BELOW | {"probability": 0.7})),  # another place
        candidate(54, 14, None, probability=0.95),
    ]
    about = examined(tmp_path, [closure(54, 14)], tested, truth=trajectory())
    found = why(about, 50)
    assert found.gate == "probability"
    assert found.what.startswith(f"{RejectReason.IMPROBABLE.value}: 0.60 < 0.9, 1.8 short in log-odds; lost by ")
    assert found.parameter == "verification.min_probability: 0.600 adds 2 closures, 1 of all 3 between different places"
    assert found.contributions["bias"] < 0
    lost = list(missing(about, tested[0]).values())
    assert lost == sorted(lost, reverse=True) and min(lost) > 0


def test_the_right_place_is_explained_not_the_most_probable_wrong_one(tmp_path: Path) -> None:
    tested = [candidate(50, 30, RejectReason.IMPROBABLE, probability=0.8), candidate(50, 10, RejectReason.NOT_SELECTED)]
    found = why(examined(tmp_path, candidates=tested, truth=trajectory()), 50)
    assert (found.gate, found.match_stamp_ns) == ("selection", stamp(10))
    assert "1 others were more promising" in found.what and found.parameter.startswith("verification.refine_best")


def test_without_a_truth_the_most_promising_candidate_is_explained(tmp_path: Path) -> None:
    turned = candidate(50, 10, RejectReason.TURNED, 0.3, probability=0.95)
    tested = [candidate(50, 30, RejectReason.NO_POSE, 0.9), turned]
    found = why(examined(tmp_path, candidates=tested), 50)
    assert (found.gate, found.parameter) == ("objection", "verification.max_turn_deg: a wider limit")
    assert why(examined(tmp_path, candidates=tested[:1]), 50).gate == "pose"


def test_what_was_found_is_said_to_be_found(tmp_path: Path) -> None:
    about = examined(tmp_path, [closure(50, 10)], [candidate(50, 10, None, probability=0.97)], truth=trajectory())
    assert why(about, 50).gate == "found"


def test_candidates_below_the_least_similarity_name_that_parameter(tmp_path: Path) -> None:
    settings = load_settings(None, loop__min_similarity=0.9)
    descriptors = np.zeros((40, 4), "<f2")
    descriptors[:, 0] = 0.5
    write_descriptors(tmp_path, descriptors)
    found = why(examined(tmp_path, truth=trajectory(), settings=settings), 50)
    assert found.parameter == "loop.min_similarity: 0.25 (now 0.9)"
