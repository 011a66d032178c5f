from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
from measurements import BAD, BAD_VIEWS, GOOD, GOOD_VIEWS

from umf_ros.core.errors import ConfigError
from umf_ros.lab.fit.acceptance import save_acceptance
from umf_ros.verification import RejectReason
from umf_ros.verification.acceptance import (
    CRITERIA,
    WITHOUT_RIVALS,
    AcceptanceModel,
    Criterion,
    load_acceptance,
    refuted,
    scores,
)
from umf_ros.verification.constants import MIN_REPETITION, SUBMAP_UNEXPLAINED
from umf_ros.verification.hypothesis import IMAGE, SCAN, SUBMAP, kind_of
from umf_ros.verification.measurement import MEASUREMENTS

MERGED = {"merged": 9.0}
RIVALS, STANDING = ("rival_near", "rival_far"), ("upright_counterparts", "unexplained")
PAIRS = {SCAN: (GOOD, BAD), SUBMAP: (GOOD | MERGED | {"repetition": 1.0}, BAD | MERGED), IMAGE: (GOOD_VIEWS, BAD_VIEWS)}
NAN = math.nan


@pytest.fixture(scope="module")
def shipped() -> AcceptanceModel:
    return load_acceptance()


def saved(model: AcceptanceModel, folder: Path) -> Path:
    save_acceptance(model, folder / "model.json", {SCAN: "a command"}, {"recall": 0.9})
    return folder / "model.json"


def without(measurements: dict[str, float], *names: str) -> dict[str, float]:
    return {name: value for name, value in measurements.items() if name not in names}


@pytest.mark.parametrize("kind", CRITERIA)
def test_shipped_model_accepts_a_good_fit_and_rejects_a_bad_one(shipped: AcceptanceModel, kind: str) -> None:
    good, bad = PAIRS[kind]
    assert kind_of(good) == kind_of(bad) == kind
    assert shipped.probability(good) > 0.95
    assert shipped.probability(bad) < 0.05


def test_good_features_on_bad_geometry_are_not_enough(shipped: AcceptanceModel) -> None:
    features = {name: GOOD[name] for name in ("similarity", "inliers_image", "inliers_cloud")}
    assert shipped.probability(BAD | features) < 0.5
    assert shipped.probability(BAD_VIEWS | features) < 0.5


@pytest.mark.parametrize("kind", CRITERIA)
def test_no_criterion_argues_against_itself(shipped: AcceptanceModel, kind: str) -> None:
    assert all(weight >= 0 for weight in shipped.models[kind].weights.values())


@pytest.mark.parametrize("kind", CRITERIA)
def test_scores_stay_between_nothing_and_all(kind: str) -> None:
    good, bad = PAIRS[kind]
    for values in ((1e9, 1e-9), (1e-9, 1e9)):
        wild = {name: values[number % 2] for number, name in enumerate(good)}
        assert all(0 <= score <= 1 for score in scores(wild).values())
    best, worst = scores(good), scores(bad)
    assert all(best[name] >= worst[name] for name in CRITERIA[kind])


@pytest.mark.parametrize("kind", CRITERIA)
def test_every_criterion_reads_what_is_measured_and_no_more(kind: str) -> None:
    """A good fit has all that the criteria need, and no other measurement changes a score."""
    good, _ = PAIRS[kind]
    others = {name: 0.123 for name in MEASUREMENTS if name not in good}
    others.pop("noise_m", None)  # it would make another kind of it
    assert scores(good | others) == scores(good)
    assert set(scores(good)) == set(CRITERIA[kind])


def test_criterion_goes_from_its_worst_to_its_best_whichever_is_larger() -> None:
    rising = Criterion(lambda known: known["overlap"], worst=0.2, best=0.6)
    falling = Criterion(lambda known: known["overlap"], worst=0.6, best=0.2)
    for overlap, score in ((0.0, 0.0), (0.2, 0.0), (0.3, 0.25), (0.6, 1.0), (0.9, 1.0)):
        assert rising({"overlap": overlap}) == pytest.approx(score)
        assert falling({"overlap": overlap}) == pytest.approx(1 - score)


@pytest.mark.parametrize("unknown", [without(GOOD, *STANDING), GOOD | dict.fromkeys(STANDING, NAN)])
def test_missing_numbers_count_as_their_neutral_value(unknown: dict[str, float]) -> None:
    found = scores(unknown)
    assert (found["upright_counterparts"], found["explained"]) == (0.5, 0.5)
    others = [name for name in found if name not in ("upright_counterparts", "explained")]
    assert all(found[name] == scores(GOOD)[name] for name in others)


def test_submaps_that_differ_more_than_their_scans_do_are_no_closure(shipped: AcceptanceModel) -> None:
    submaps = GOOD | {"merged": 8.0, "unexplained": 0.08, "upright_counterparts": 0.7}
    usual, unusual = (shipped.probability(submaps | {"excess_differences": excess}) for excess in (1.2, 1.8))
    assert unusual < 0.9 < usual == shipped.probability(submaps)
    # those of a narrow sensor show different sides
    assert shipped.probability(submaps | {"excess_differences": 1.8, "narrow": 1.0}) == usual


def test_a_submap_that_fits_itself_elsewhere_is_less_probable_and_not_refuted(shipped: AcceptanceModel) -> None:
    submaps = GOOD | {"merged": 8.0, "unexplained": 0.08}
    repeated, single = (submaps | {"repetition": worse} for worse in (0.1, 1.0))
    assert shipped.probability(repeated) < shipped.probability(single) == shipped.probability(submaps)
    assert refuted(repeated) is None


def test_rivals_that_were_not_looked_for_speak_for_nothing_and_no_rivals_for_all() -> None:
    for found, score in ((scores(without(GOOD, *RIVALS)), 0.0), (scores(BAD | WITHOUT_RIVALS), 1.0)):
        assert (found["position_along_known"], found["no_rival"]) == (score, score)


@pytest.mark.parametrize("kind", CRITERIA)
def test_contributions_add_up_to_the_log_odds(shipped: AcceptanceModel, kind: str) -> None:
    for measurements in PAIRS[kind]:
        odds = sum(shipped.contributions(measurements).values())
        assert shipped.probability(measurements) == pytest.approx(1 / (1 + math.exp(-odds)))
        assert shipped.contributions(measurements)["bias"] == shipped.models[kind].bias


def test_saved_model_reads_back(shipped: AcceptanceModel, tmp_path: Path) -> None:
    assert load_acceptance(str(saved(shipped, tmp_path))) == shipped


@pytest.mark.parametrize("damage", ["", "{", "{}", "[]", '{"models": {}}'])
def test_damaged_model_is_one_clear_error(tmp_path: Path, damage: str) -> None:
    (tmp_path / "model.json").write_text(damage)
    with pytest.raises(ConfigError, match=r"model\.json: not an acceptance model"):
        load_acceptance(str(tmp_path / "model.json"))


@pytest.mark.parametrize("kind", CRITERIA)
def test_a_model_of_other_criteria_is_refused_and_the_criterion_named(
    shipped: AcceptanceModel, tmp_path: Path, kind: str
) -> None:
    """One of another version, with a criterion too many or too few."""
    path = saved(shipped, tmp_path)
    content = json.loads(path.read_text())
    weights, last = content["models"][kind]["weights"], list(CRITERIA[kind])[-1]
    for other in (weights | {"luck": 1.0}, without(weights, last)):
        content["models"][kind]["weights"] = other
        path.write_text(json.dumps(content))
        with pytest.raises(
            ConfigError, match=r"model\.json: not an acceptance model.*" + ("luck" if "luck" in other else last)
        ):
            load_acceptance(str(path))


@pytest.mark.parametrize(("part", "kind"), [("models", IMAGE), ("models", SCAN), ("covariance", SCAN)])
def test_a_model_that_lacks_a_kind_is_refused(shipped: AcceptanceModel, tmp_path: Path, part: str, kind: str) -> None:
    path = saved(shipped, tmp_path)
    content = json.loads(path.read_text())
    del content[part][kind]
    path.write_text(json.dumps(content))
    with pytest.raises(ConfigError, match=kind):
        load_acceptance(str(path))


def test_what_no_right_pose_ever_measured_is_named(shipped: AcceptanceModel, tmp_path: Path) -> None:
    bounded = replace(shipped, bounds={SCAN: {"noise_m": (0.001, 0.1), "common": (0.2, 1.0)}})
    assert bounded.out_of_range(GOOD) == ""
    assert bounded.out_of_range(GOOD | {"noise_m": 0.3}) == "noise_m 0.3"
    assert bounded.out_of_range(GOOD | {"common": 0.05}) == "common 0.05"
    assert bounded.out_of_range(without(GOOD, "common")) == ""
    assert bounded.out_of_range(GOOD_VIEWS | {"common": 0.05}) == ""
    assert load_acceptance(str(saved(bounded, tmp_path))) == bounded


@pytest.mark.parametrize(("name", "value"), [("unexplained", 0.9), ("contradiction", 0.4), ("noise_m", 1.0)])
def test_one_strong_contradiction_sinks_a_closure_however_well_the_rest_fits(
    shipped: AcceptanceModel, name: str, value: float
) -> None:
    assert shipped.out_of_range(GOOD) == ""
    assert shipped.out_of_range(GOOD | {name: value}).startswith(name)


@pytest.mark.parametrize(
    "name", ["residual_p90_m", "position_std_m", "heading_std_deg", "unexplained", "contradiction"]
)
def test_larger_errors_never_make_a_closure_more_probable(shipped: AcceptanceModel, name: str) -> None:
    odds = [shipped.probability(GOOD | {name: GOOD[name] * factor}) for factor in (0.5, 1, 2, 5, 20)]
    assert odds == sorted(odds, reverse=True) and odds[0] > odds[-1]


@pytest.mark.parametrize("measurements", [GOOD, BAD], ids=["good", "bad"])
@pytest.mark.parametrize("rival", [-1.0, 0.0, 0.2, 3.0])
def test_no_rival_makes_a_closure_more_probable_than_none(
    shipped: AcceptanceModel, measurements: dict[str, float], rival: float
) -> None:
    alone = without(measurements, *RIVALS)
    beside = measurements | dict.fromkeys(RIVALS, rival)
    assert shipped.probability(alone | WITHOUT_RIVALS) >= shipped.probability(beside) >= shipped.probability(alone)


def test_what_was_never_measured_is_not_what_a_closure_was_lost_by(shipped: AcceptanceModel) -> None:
    assert shipped.lost(BAD)["no_rival"] == pytest.approx(shipped.models[SCAN].weights["no_rival"])
    lost = shipped.lost(without(BAD, *RIVALS))
    assert "no_rival" not in lost and "heading_known" in lost
    assert all(odds > 0 for odds in lost.values())


@pytest.mark.parametrize(
    ("measurements", "reason"),
    [
        (GOOD, None),
        (GOOD | {"lead": 1.01}, None),
        (GOOD | {"lead": 0.99}, RejectReason.AMBIGUOUS),
        (without(GOOD, *RIVALS) | {"lead": 0.99}, RejectReason.PASSAGE),
        (GOOD | {"repetition": 1.01 * MIN_REPETITION}, None),
        (GOOD | {"repetition": 0.99 * MIN_REPETITION}, RejectReason.AMBIGUOUS),
        (GOOD | {"merged": 12.0, "unexplained": 0.99 * SUBMAP_UNEXPLAINED}, None),
        (GOOD | {"merged": 12.0, "unexplained": 1.01 * SUBMAP_UNEXPLAINED}, RejectReason.UNEXPLAINED),
        (GOOD | {"merged": 1.0, "unexplained": 1.01 * SUBMAP_UNEXPLAINED}, None),
        (GOOD | {"merged": 12.0, "narrow": 1.0, "unexplained": 1.01 * SUBMAP_UNEXPLAINED}, None),
        (without(GOOD, *RIVALS), None),
        (GOOD_VIEWS, None),
        (BAD_VIEWS, None),
    ],
)
def test_a_rival_and_surfaces_apart_refute_scans_however_probable(
    measurements: dict[str, float], reason: RejectReason | None
) -> None:
    objection = refuted(measurements)
    assert (objection and objection[0]) == reason


def test_two_views_without_any_noise_are_one_image_twice() -> None:
    """A driver that repeats its last image: the views agree although the rover has moved."""
    refutation = refuted(GOOD_VIEWS | {"residual_sigmas": 1e-5})
    assert refutation is not None and refutation[0] is RejectReason.REPEATED_IMAGE
    assert refuted(GOOD_VIEWS | {"residual_sigmas": 0.3}) is None
