from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
from measurements import BAD, GOOD

from umf_ros.core.errors import ConfigError
from umf_ros.lab.fit.acceptance import save_acceptance
from umf_ros.verification import Measurement
from umf_ros.verification.acceptance import (
    KINDS,
    AcceptanceModel,
    Criterion,
    criteria_of,
    load_acceptance,
    refuted,
    scores,
)
from umf_ros.verification.hypothesis import SCAN, SUBMAP


@pytest.fixture(scope="module")
def shipped() -> AcceptanceModel:
    return load_acceptance()


def saved(model: AcceptanceModel, folder: Path) -> Path:
    save_acceptance(model, folder / "model.json", {SCAN: "a command"}, {"recall": 0.9})
    return folder / "model.json"


def test_shipped_model_accepts_a_good_fit_and_rejects_a_bad_one(shipped: AcceptanceModel) -> None:
    assert shipped.probability(GOOD) > 0.95
    assert shipped.probability(BAD) < 0.05


def test_good_features_on_bad_geometry_are_not_enough(shipped: AcceptanceModel) -> None:
    features = {name: GOOD.numbers[name] for name in ("similarity", "inliers_image", "inliers_cloud")}
    assert shipped.probability(replace(BAD, **features, agreement_cloud=6.0)) < 0.5


# two submaps of opposite headings: little of what the scans saw is common, the ground between them is
TURNED = replace(
    GOOD,
    kind=SUBMAP,
    common=0.1,
    upright_counterparts=0.3,
    unexplained=0.3,
    rival_near=0.0,
    rival_far=0.05,
    terrain_rival=0.2,
)


def test_submaps_of_narrow_sensors_are_judged_by_their_terrain_too(shipped: AcceptanceModel) -> None:
    turned = replace(TURNED, terrain_score=30.0, support=2.0, relief_m=0.1)
    assert shipped.probability(replace(turned, kind=SCAN)) < 0.6 < 0.95 < shipped.probability(turned)
    assert shipped.probability(replace(turned, terrain_score=4.0, terrain_rival=0.85, overlap=0.5)) < 0.9
    for one in (turned, replace(turned, terrain_score=4.0, overlap=0.5), replace(turned, common=0.8, rival_far=0.6)):
        probability = shipped.probability(one)
        told = sum(shipped.contributions(one).values())
        assert told == pytest.approx(math.log(probability / (1 - probability)), rel=1e-6)
    assert refuted(turned) is None and refuted(replace(turned, terrain_correlation=0.25)) is not None
    assert refuted(replace(turned, kind=SCAN, terrain_correlation=0.25)) is None


def test_a_model_without_submaps_judges_them_by_the_shipped_one(shipped: AcceptanceModel, tmp_path: Path) -> None:
    path = saved(shipped, tmp_path)
    content = json.loads(path.read_text())
    del content["models"][SUBMAP]
    path.write_text(json.dumps(content))
    assert load_acceptance(str(path)).probability(TURNED) == shipped.probability(TURNED)


@pytest.mark.parametrize("kind", KINDS)
def test_no_criterion_argues_against_itself(shipped: AcceptanceModel, kind: str) -> None:
    assert all(weight >= 0 for weight in shipped.models[kind].weights.values())


@pytest.mark.parametrize("kind", KINDS)
def test_scores_stay_between_nothing_and_all(kind: str) -> None:
    good, bad = replace(GOOD, kind=kind), replace(BAD, kind=kind)
    for values in ((1e9, 1e-9), (1e-9, 1e9)):
        wild = {name: values[number % 2] for number, name in enumerate(good.numbers)}
        assert all(0 <= score <= 1 for score in scores(replace(good, **wild)).values())
    assert all(scores(good)[name] >= scores(bad)[name] for name in criteria_of(kind))


@pytest.mark.parametrize("kind", KINDS)
def test_criteria_read_only_what_is_measured_for_their_kind(kind: str) -> None:
    good = replace(GOOD, kind=kind)
    assert scores(Measurement(kind=kind, **good.numbers)) == scores(good)


def test_criterion_goes_from_its_worst_to_its_best_whichever_is_larger() -> None:
    rising = Criterion(lambda measurement: measurement.overlap, worst=0.2, best=0.6)
    falling = Criterion(lambda measurement: measurement.overlap, worst=0.6, best=0.2)
    for overlap, score in ((0.0, 0.0), (0.2, 0.0), (0.3, 0.25), (0.6, 1.0), (0.9, 1.0)):
        assert rising(replace(GOOD, overlap=overlap)) == pytest.approx(score)
        assert falling(replace(GOOD, overlap=overlap)) == pytest.approx(1 - score)


def test_missing_numbers_count_as_their_neutral_value() -> None:
    found = scores(replace(GOOD, agreement_cloud=math.nan, prior_sigmas=math.nan))
    assert found["cloud_agreement"] == 0.5
    assert 0 < found["odometry_prior"] < 1


def test_contributions_add_up_to_the_log_odds(shipped: AcceptanceModel) -> None:
    odds = sum(shipped.contributions(GOOD).values())
    assert shipped.probability(GOOD) == pytest.approx(1 / (1 + math.exp(-odds)))
    assert shipped.contributions(GOOD)["bias"] == shipped.models["scan"].bias


def test_saved_model_reads_back(shipped: AcceptanceModel, tmp_path: Path) -> None:
    assert load_acceptance(str(saved(shipped, tmp_path))) == shipped


@pytest.mark.parametrize("damage", ["", "{", "{}", '{"models": {}}'])
def test_damaged_model_is_one_clear_error(tmp_path: Path, damage: str) -> None:
    (tmp_path / "model.json").write_text(damage)
    with pytest.raises(ConfigError, match=r"model\.json: not an acceptance model"):
        load_acceptance(str(tmp_path / "model.json"))


def test_model_of_other_criteria_is_refused(shipped: AcceptanceModel, tmp_path: Path) -> None:
    path = saved(shipped, tmp_path)
    content = json.loads(path.read_text())
    content["models"]["scan"]["weights"]["luck"] = 1.0
    path.write_text(json.dumps(content))
    with pytest.raises(ConfigError, match="luck"):
        load_acceptance(str(path))


def test_a_criterion_younger_than_the_model_has_no_weight(shipped: AcceptanceModel, tmp_path: Path) -> None:
    path = saved(shipped, tmp_path)
    content = json.loads(path.read_text())
    del content["models"]["scan"]["weights"]["heading_known"]
    path.write_text(json.dumps(content))
    old = load_acceptance(str(path))
    assert old.models["scan"].weights["heading_known"] == 0.0
    assert old.probability(GOOD) < shipped.probability(GOOD)


def test_what_no_right_pose_ever_measured_is_named(shipped: AcceptanceModel, tmp_path: Path) -> None:
    bounded = replace(shipped, bounds={"scan": {"noise_m": (0.001, 0.1), "common": (0.2, 1.0)}})
    assert bounded.out_of_range(GOOD) == ""
    assert bounded.out_of_range(replace(GOOD, noise_m=0.3)) == "noise_m 0.3"
    assert bounded.out_of_range(replace(GOOD, common=0.05)) == "common 0.05"
    assert bounded.out_of_range(replace(GOOD, kind="image", noise_m=0.3)) == ""
    assert load_acceptance(str(saved(bounded, tmp_path))) == bounded


@pytest.mark.parametrize(("name", "value"), [("unexplained", 0.9), ("contradiction", 0.4), ("noise_m", 1.0)])
def test_one_strong_contradiction_sinks_a_closure_however_well_the_rest_fits(
    shipped: AcceptanceModel, name: str, value: float
) -> None:
    assert shipped.out_of_range(GOOD) == ""
    assert shipped.out_of_range(replace(GOOD, **{name: value})).startswith(name)


@pytest.mark.parametrize("name", ["residual_m", "position_std_m", "prior_sigmas", "unexplained", "contradiction"])
def test_larger_errors_never_make_a_closure_more_probable(shipped: AcceptanceModel, name: str) -> None:
    value = GOOD.numbers[name]
    odds = [shipped.probability(replace(GOOD, **{name: value * factor})) for factor in (0.5, 1, 2, 5, 20)]
    assert odds == sorted(odds, reverse=True)


@pytest.mark.parametrize("measurement", [GOOD, BAD], ids=["good", "bad"])
@pytest.mark.parametrize("rival", [-1.0, 0.0, 0.2, 3.0])
def test_no_rival_makes_a_closure_more_probable_than_none(
    shipped: AcceptanceModel, measurement: Measurement, rival: float
) -> None:
    alone = replace(measurement, rival_near=float("nan"), rival_far=float("nan"))
    beside = replace(measurement, rival_near=rival, rival_far=rival)
    assert shipped.at_best(alone) >= shipped.probability(beside) >= shipped.probability(alone)


def test_what_was_never_measured_is_not_what_a_closure_was_lost_by(shipped: AcceptanceModel) -> None:
    assert shipped.lost(BAD)["no_rival"] == pytest.approx(shipped.models["scan"].weights["no_rival"])
    hopeless = replace(BAD, rival_near=float("nan"), rival_far=float("nan"))
    lost = shipped.lost(hopeless)
    assert "no_rival" not in lost and "heading_known" in lost
    assert all(odds > 0 for odds in lost.values())
