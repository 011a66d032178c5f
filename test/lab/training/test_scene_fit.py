"""Adding a scene to a trained network: nothing is lost, and the fit finds what tells places apart."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_worlds import TINY, some_input, world_arrays

from umf_ros.lab.datasets.sample import Places
from umf_ros.lab.datasets.simulated import SimulatedWorld
from umf_ros.lab.fit.scene import PooledWorld, SceneFit, fit_scene, pool_world, whitened_start, with_scene
from umf_ros.networks.efficientnet import DEPTH, EfficientNetLite0
from umf_ros.networks.umf import UMF

LENGTH = 48
CELLS = 15 * 112


@pytest.fixture
def grown() -> UMF:
    torch.manual_seed(0)
    return with_scene(UMF(TINY).eval(), EfficientNetLite0(DEPTH), LENGTH)


def test_a_new_scene_changes_no_similarity(grown: UMF) -> None:
    torch.manual_seed(0)
    before, batch = UMF(TINY).eval(), some_input(count=3)
    with torch.inference_mode():
        old, new = before(batch).descriptor, grown(batch).descriptor
    torch.testing.assert_close(new @ new.T, old @ old.T)
    assert new.shape[1] == TINY.descriptor + LENGTH


def test_pooling_knows_places_passes_and_mirrors(grown: UMF, tmp_path: Path) -> None:
    np.savez(tmp_path / "world_00001.npz", **world_arrays())
    world = SimulatedWorld(tmp_path / "world_00001.npz")
    plain = pool_world(grown, world)
    again = pool_world(grown, world, batch=3)
    varied = pool_world(grown, world, np.random.default_rng(0), mirror=True)
    assert plain.cells.shape == (len(world), CELLS)
    torch.testing.assert_close(plain.cells, again.cells, rtol=1e-3, atol=1e-4)
    assert not torch.allclose(plain.cells, varied.cells, atol=1e-2)
    np.testing.assert_allclose(varied.places.heading, -plain.places.heading)
    np.testing.assert_allclose(varied.places.position[:, 1], -plain.places.position[:, 1])


def test_whitening_lets_no_channel_drown_the_others() -> None:
    rng = torch.Generator().manual_seed(0)
    scale = torch.logspace(-1, 1, 112).repeat_interleave(15)
    cells = torch.randn(3 * CELLS, CELLS, generator=rng) * scale
    before, after = cells.var(0), (cells @ whitened_start(cells, CELLS).T).var(0)
    assert float(before.max() / before.min()) > 5000
    assert float(after.max() / after.min()) < 200
    leading = (cells @ whitened_start(cells, 64).T).var(0)
    assert float(leading.max() / leading.min()) < 1.5


def some_world(seed: int, places: int = 30) -> PooledWorld:
    """Two passes whose pooled maps agree in one channel and in nothing else."""
    rng = np.random.default_rng(seed)
    told = np.tile(rng.normal(size=(places, 15)), (2, 1))
    cells = rng.normal(size=(2 * places, 112, 15)) * 0.3
    cells[:, 7] = told
    along = np.tile(40.0 * np.arange(places), 2)
    return PooledWorld(
        torch.from_numpy(cells.reshape(2 * places, -1)).float(),
        Places(
            np.zeros(2 * places, int), np.column_stack([along, 0 * along]), 0 * along, np.repeat([0.0, 1.0], places)
        ),
    )


def recall(network: UMF, world: PooledWorld) -> float:
    with torch.inference_mode():
        scene = torch.nn.functional.normalize(network.scene.project(world.cells), dim=1)
    half = len(scene) // 2
    return float(((scene[half:] @ scene[:half].T).argmax(1) == torch.arange(half)).float().mean())


def test_the_fit_finds_the_channel_that_tells_places_apart(grown: UMF) -> None:
    losses: list[float] = []
    settings = SceneFit(steps=150, learning_rate=1e-2, weight=0.7)
    worlds, unseen = [some_world(seed) for seed in range(30)], some_world(30)
    fit_scene(grown, worlds, SceneFit(steps=1, learning_rate=1e-9, weight=0.7), lambda step, loss: None)
    before = recall(grown, unseen)
    lengths = grown.scene.project(torch.cat([world.cells for world in worlds])).norm(dim=1).detach()
    assert float(lengths.median()) == pytest.approx(0.7, rel=0.01)
    fit_scene(grown, worlds, settings, lambda step, loss: losses.append(loss))
    assert recall(grown, unseen) > before + 0.2
    assert losses[-1] < losses[0]
