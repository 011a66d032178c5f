"""Cameras as they differ."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from tiny_worlds import TINY, world_arrays

from umf_ros.lab.datasets.simulated import SimulatedWorld
from umf_ros.lab.datasets.views import Augmentation, CameraLook, ViewMaker, draw_look

RAMP = np.tile(np.linspace(20, 200, 96).astype(np.uint8), (64, 1))


def take(look: CameraLook, seed: int = 0, image: np.ndarray = RAMP) -> np.ndarray:
    return look.take(image, np.random.default_rng(seed))


def test_a_perfect_camera_changes_nothing() -> None:
    assert np.abs(take(CameraLook()).astype(int) - RAMP).max() <= 1


def test_each_fault_does_what_it_is_called() -> None:
    flat = np.full((64, 96), 120, np.uint8)
    assert take(CameraLook(gamma=2.0)).mean() < RAMP.mean() < take(CameraLook(gamma=0.5)).mean()
    steep = take(CameraLook(toe=0.8)).astype(int)
    assert steep[0, 10] < RAMP[0, 10] and steep[0, -10] > RAMP[0, -10]
    dark = take(CameraLook(vignetting=0.5), image=flat)
    assert dark[0, 0] < 0.6 * dark[32, 48] and abs(int(dark[32, 48]) - 120) <= 1
    edge = np.where(np.arange(96) < 48, 40, 200).astype(np.uint8)[None].repeat(64, 0)
    soft = take(CameraLook(blur_px=1.5), image=edge)[32, 46:50].astype(int)
    assert 40 < soft[1] < soft[2] < 200
    assert 3 < take(CameraLook(noise=0.04), image=flat).std() < 15
    speckled = np.random.default_rng(0).integers(60, 180, (64, 96)).astype(np.uint8)
    assert 5 < np.abs(take(CameraLook(quality=20), image=speckled).astype(int) - speckled).mean() < 40
    assert np.ptp(take(CameraLook(zoom=0.6))[0].astype(int)) < 0.7 * np.ptp(RAMP[0].astype(int))


def test_pictures_of_one_camera_differ_by_exposure_and_noise_alone() -> None:
    look = CameraLook(exposure=0.3)
    first, second = take(look, 1).astype(float), take(look, 2).astype(float)
    ratio = (second / first)[:, 10:-10]
    assert abs(ratio.mean() - 1) > 0.02
    assert ratio.std() < 0.03
    np.testing.assert_array_equal(take(look, 1), take(look, 1))


def test_drawn_cameras_differ_and_keep_the_picture_recognisable() -> None:
    rng = np.random.default_rng(0)
    looks = [draw_look(rng) for _ in range(20)]
    assert len(set(looks)) == 20
    scene = np.kron(rng.integers(40, 200, (8, 12)), np.ones((8, 8))).astype(np.uint8)
    alike = [np.corrcoef(take(look, 3, scene).ravel(), scene.ravel())[0, 1] for look in looks if look.zoom == 1]
    assert min(alike) > 0.6


def test_night_sun_shadows_and_dust_change_what_they_should() -> None:
    flat = np.full((64, 96), 120, np.uint8)
    night = take(CameraLook(lamps=1.0), image=flat)
    assert night[45, 48] > 120 and night[0, 0] < 40
    shaded = take(CameraLook(shadow=1.0), image=flat)
    assert shaded.min() < 90 and shaded.max() >= 119
    against_the_sun = take(CameraLook(glare=1.0), image=flat)
    assert against_the_sun.max() > 200 and against_the_sun[:20].mean() > against_the_sun[-20:].mean()
    dusty = CameraLook(dust=6, lens=1, noise=0.01)
    specks = [take(dusty, seed, RAMP).astype(float) - RAMP for seed in (1, 2)]
    assert np.abs(specks[0]).max() > 20 and np.corrcoef(specks[0].ravel(), specks[1].ravel())[0, 1] > 0.9


def test_training_views_are_taken_by_other_cameras_on_request(tmp_path: Path) -> None:
    np.savez(tmp_path / "world_00001.npz", **world_arrays())
    sample = SimulatedWorld(tmp_path / "world_00001.npz").sample(0)
    plain, other = (
        [
            ViewMaker(TINY, Augmentation(look=look)).varied(sample, np.random.default_rng(seed)).image
            for seed in range(8)
        ]
        for look in (0.0, 1.0)
    )
    assert np.std(plain, axis=0).mean() < np.std(other, axis=0).mean()
