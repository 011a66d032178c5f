"""Families of worlds, what repeats in them, and the noise they are made from."""

from __future__ import annotations

from dataclasses import fields

import cv2
import numpy as np
import pytest

from umf_ros.lab.simulation.camera import Sun
from umf_ros.lab.simulation.families import FAMILIES, Traits, draw_traits
from umf_ros.lab.simulation.presets import THESIS_SAMPLES, thesis_surveys
from umf_ros.lab.simulation.relief import CELLS, detail_texture, smooth_step, spectral_noise
from umf_ros.lab.simulation.world import ground


@pytest.mark.parametrize("family", FAMILIES)
def test_traits_are_possible(family):
    for seed in range(20):
        traits = draw_traits(family, np.random.default_rng(seed))
        values = {field.name: getattr(traits, field.name) for field in fields(Traits)}
        assert all(np.isfinite(value) for value in values.values())
        assert all(value >= 0 for name, value in values.items() if name not in ("cliff", "rock_albedo"))
        assert 0 < traits.albedo < 0.5 and traits.ambient < 0.5 and 1 < traits.rock_slope < 2
        assert (traits.sky == 0) == (traits.haze_m > 1e6) == (traits.backscatter > 0.5)


def test_a_random_world_takes_from_several_families():
    drawn = [draw_traits("random", np.random.default_rng(seed)) for seed in range(60)]
    assert any(traits.sky == 0 for traits in drawn) and any(traits.sky > 0 for traits in drawn)
    assert any(traits.cliff > 4 for traits in drawn) and any(traits.cliff < -6 for traits in drawn)
    assert any(traits.mounds > 100 and traits.dune_height > 0.39 for traits in drawn)


def repetition(heights: np.ndarray) -> float:
    """How alike the unevenness of the ground is to that a quarter of the square further on."""
    fine = heights - cv2.GaussianBlur(heights, (0, 0), 4)
    fine = np.clip(fine, *np.percentile(fine, (3, 97)))
    return float(np.corrcoef(fine.ravel(), np.roll(fine, CELLS // 4, axis=1).ravel())[0, 1])


def test_aliasing_makes_the_ground_repeat_itself(night):
    plain = repetition(ground(20_031, "moon", 0.0).heights)
    assert abs(plain) < 0.1
    assert repetition(night.world.relief.heights) > plain + 0.2


@pytest.mark.parametrize("slope", [2.0, 4.0])
def test_noise_has_the_spectrum_it_is_asked_for(slope):
    field = spectral_noise(256, slope, np.random.default_rng(0), 4, 64)
    power = np.abs(np.fft.fft2(field)) ** 2
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(256, 1 / 256), np.fft.fftfreq(256, 1 / 256)))
    low, high = (power[(frequency > f) & (frequency < 1.3 * f)].mean() for f in (6, 40))
    assert np.log(low / high) / np.log(40 / 6) == pytest.approx(slope, abs=0.4)
    assert power[(frequency < 3.9) | (frequency > 64.1)].max() < 1e-6 * power.max()


def test_a_texture_has_the_steepness_it_is_asked_for():
    tile = detail_texture(256, 4.0, 0.15, 0.0, np.random.default_rng(0))
    assert np.sqrt((tile[..., 1:] ** 2).sum(axis=2).mean()) == pytest.approx(0.15, rel=1e-3)
    assert tile[..., 0].std() == pytest.approx(1, abs=0.01)


def test_a_smooth_step_is_flat_at_both_ends():
    values = smooth_step(np.array([-9.0, 2.0, 2.001, 3.0, 3.999, 4.0, 9.0]), 2, 4)
    assert values.tolist() == pytest.approx([0, 0, 0, 0.5, 1, 1, 1], abs=1e-5)


def test_the_sun_stands_where_its_angles_say():
    assert Sun(0, 0).direction == pytest.approx([1, 0, 0], abs=1e-6)
    assert Sun(180, 45).direction == pytest.approx([-np.sqrt(0.5), 0, np.sqrt(0.5)], abs=1e-6)
    assert Sun(123, 90).direction == pytest.approx([0, 0, 1], abs=1e-6)


def test_a_synthetic_sequence_has_its_500_samples():
    name, survey = next(thesis_surveys(20_040))
    assert name == "random_1" and survey.world.family == "random"
    assert len(survey) == THESIS_SAMPLES == sum(len(drive.path) for drive in survey.passes)
    assert [drive.label for drive in survey.passes] == ["first", "offset"]
    assert abs(len(survey.passes[0].path) - 250) < 30
    # the rover stands on its ground, and sees the rocks from outside
    for index, step in ((0, 10), (1, 100)):
        pose = survey.pose(index, step)
        assert pose[2, 3] == pytest.approx(float(survey.world.relief.height(*pose[:2, 3])), abs=0.3)
