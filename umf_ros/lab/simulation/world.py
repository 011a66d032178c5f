"""A simulated world, and the split of seeds by purpose."""

from __future__ import annotations

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from umf_ros.core.errors import ConfigError
from umf_ros.core.geometry import Array
from umf_ros.lab.simulation.families import FAMILIES, Traits, draw_traits
from umf_ros.lab.simulation.noise import Field, detail_texture, smooth_step, spectral_noise
from umf_ros.lab.simulation.relief import CELL_M, CELLS, SIZE_M, Pan, Relief
from umf_ros.lab.simulation.rocks import Mesh, scatter_rocks, vertex_normals

TRAINING = range(0, 10_000)
VALIDATION = range(10_000, 20_000)
TEST = range(20_000, 30_000)
"""Seeds from 30,000 on are free for a user's own worlds and are never drawn by this package."""


def check_seed(seed: int) -> int:
    """The seed itself.

    Raises:
        ConfigError: the seed is negative or does not fit 32 bits.
    """
    if not 0 <= seed < 2**32:
        raise ConfigError(f"seed {seed} is not between 0 and 4294967295")
    return seed


GROUND, HORIZON, ROCK = 0, 1, 2
"""Geometry ids in the scene, and the values of semantic maps (sky is 255)."""

TEXTURE_PERIODS_M = (31.0, 6.7, 1.7)
_TEXTURE_CELLS = 512
_HORIZON_M = 2400.0


class World:
    """A planetary landscape, the same for the same arguments.

    Attributes:
        seed: the world's number.
        family: one of `families.FAMILIES`.
        aliasing: 0 (every place is its own) to 1 (clusters, dunes and lumps repeat).
        traits: the numbers drawn for this world.
        relief: the ground.
        scene: Open3D scene of ground, horizon and rocks.
        solids: normals and brightness of what is not ground, by geometry id.
        textures: tiles for `TEXTURE_PERIODS_M`.
        strata: (256,) float32 brightness of layers by height, repeating every 12.8 m.
    """

    def __init__(
        self,
        seed: int,
        family: str = "etna",
        aliasing: float = 0.0,
        keep_clear: Array | None = None,
        relief: Relief | None = None,
    ) -> None:
        """Build the world; takes some seconds.

        Args:
            seed: the world's number.
            family: one of `families.FAMILIES`.
            aliasing: 0 to 1.
            keep_clear: (N, 2) points that no rock may block, m; None keeps only the trail clear.
            relief: `ground(seed, family, aliasing)` where it is at hand already.

        Raises:
            ConfigError: negative seed, unknown family or aliasing out of range.
        """
        self.relief = relief or ground(seed, family, aliasing)
        self.seed, self.family, self.aliasing = seed, family, aliasing
        self.traits: Traits = self.relief.traits
        rng = np.random.default_rng([seed, 2, FAMILIES.index(family)])
        self.textures = [
            detail_texture(_TEXTURE_CELLS, period, steepness, 0.0 if period > 10 else 1.4, rng)
            for period, steepness in zip(TEXTURE_PERIODS_M, (0.07, 0.10, 0.12), strict=True)
        ]
        self.strata = _layers(rng)
        clear = self.relief.trail if keep_clear is None else np.asarray(keep_clear, float)[:, :2]
        self.solids: dict[int, Mesh] = {
            HORIZON: _horizon(self.relief, rng),
            ROCK: scatter_rocks(self.relief, rng, aliasing, clear),
        }
        self.scene = self._build_scene()

    def _build_scene(self) -> o3d.t.geometry.RaycastingScene:
        scene = o3d.t.geometry.RaycastingScene()
        axis = (np.arange(CELLS, dtype=np.float32) * CELL_M) - SIZE_M / 2
        x, y = np.meshgrid(axis, axis)
        vertices = np.stack([x, y, self.relief.heights], -1).reshape(-1, 3)
        for mesh_vertices, triangles in (
            (vertices, grid_triangles(CELLS)),
            *((mesh.vertices, mesh.triangles) for mesh in self.solids.values()),
        ):
            scene.add_triangles(o3d.core.Tensor.from_numpy(mesh_vertices), o3d.core.Tensor.from_numpy(triangles))
        scene.cast_rays(o3d.core.Tensor.from_numpy(np.array([[0, 0, 99, 0, 0, -1]], np.float32)))  # builds the tree now
        return scene


def ground(seed: int, family: str, aliasing: float = 0.0, pan: Pan | None = None) -> Relief:
    """The ground of a world without the rest: enough to plan routes on.

    Raises:
        ConfigError: negative seed, unknown family or aliasing out of range.
    """
    if not 0 <= aliasing <= 1:
        raise ConfigError(f"aliasing {aliasing} is not between 0 and 1")
    traits = draw_traits(family, np.random.default_rng([check_seed(seed), 0]))
    return Relief(traits, np.random.default_rng([seed, 1, FAMILIES.index(family)]), aliasing, pan)


def grid_triangles(cells: int) -> NDArray[np.uint32]:
    """(2 (cells - 1)^2, 3) triangles of a square grid of vertices stored row by row."""
    index = np.arange(cells * cells, dtype=np.uint32).reshape(cells, cells)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    return np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], 2).reshape(-1, 3)


def _layers(rng: np.random.Generator) -> Field:
    layers = spectral_noise(256, 1.6, rng, 4, 60)[0]
    return layers / layers.std()


def _horizon(relief: Relief, rng: np.random.Generator) -> Mesh:
    """Mountains around the square, coarser with distance."""
    cells = 161
    grid = np.linspace(-1, 1, cells)
    axis = np.sign(grid) * np.abs(grid) ** 1.6 * _HORIZON_M / 2
    x, y = np.meshgrid(axis, axis)
    away = np.maximum(np.abs(x), np.abs(y))
    peaks = spectral_noise(cells, 4.2, rng, 1.5, 30)
    peaks = (peaks - peaks.min()) * 0.6 * relief.traits.hills * np.clip((away - 0.55 * SIZE_M) / 700, 0, 1)
    skirt = relief.height(x, y) - 1 - 3 * smooth_step(away, SIZE_M / 2, SIZE_M / 2 + 40)
    z = np.where(away < 0.49 * SIZE_M, -60, skirt + peaks)
    vertices = np.stack([x, y, z], -1).reshape(-1, 3).astype(np.float32)
    triangles = grid_triangles(cells)
    zeros = np.zeros(len(triangles))
    return Mesh(
        vertices, triangles, vertex_normals(vertices, triangles), zeros.astype(np.float32), zeros.astype(np.int32)
    )
