"""A simulated world with its rocks, and the split of seeds by purpose."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import open3d as o3d
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from umf_ros.core.errors import ConfigError
from umf_ros.core.geometry import Array
from umf_ros.lab.simulation.families import FAMILIES, Traits, draw_traits
from umf_ros.lab.simulation.relief import (
    CELL_M,
    CELLS,
    SIZE_M,
    Field,
    Pan,
    Relief,
    detail_texture,
    smooth_step,
    spectral_noise,
)

SMALLEST_M = 0.12
_SHAPES = 10
_DETAIL_FROM_M = (0.0, 0.35, 1.2)


@dataclass(frozen=True, slots=True)
class Mesh:
    """Triangles with what shading needs.

    Attributes:
        vertices: (V, 3) float32, m, world frame.
        triangles: (T, 3) uint32.
        normals: (V, 3) float32, smooth.
        brightness: (T,) float32, log reflectance relative to the ground's.
        instance: (T,) int32, which rock a triangle belongs to.
    """

    vertices: Field
    triangles: NDArray[np.uint32]
    normals: Field
    brightness: Field
    instance: NDArray[np.int32]


def vertex_normals(vertices: Field, triangles: NDArray[np.uint32]) -> Field:
    """(V, 3) float32 area-weighted normals."""
    corners = vertices[triangles]
    faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.stack(
        [np.bincount(triangles.ravel(), np.repeat(faces[:, axis], 3), len(vertices)) for axis in range(3)], 1
    )
    return (normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)).astype(np.float32)


def scatter_rocks(relief: Relief, rng: np.random.Generator, aliasing: float, keep_clear: Array) -> Mesh:
    """Rocks on a relief, none of them where the rover drives.

    Args:
        relief: the ground.
        rng: source of all randomness.
        aliasing: 0 to 1, how many of the rocks belong to clusters that repeat.
        keep_clear: (N, 2) points of the routes, m; may be empty.
    """
    shapes = [[_rock_shape(rng, detail) for _ in range(_SHAPES)] for detail in (1, 2, 3)]
    placed = _place(relief, rng, aliasing)
    placed = placed[_off_the_route(placed, keep_clear)]
    turns = Rotation.from_quat(placed[:, 4:8]).as_matrix()
    sizes = placed[:, 2]
    ground = relief.height(placed[:, 0], placed[:, 1])
    centres = np.column_stack([placed[:, :2], ground + sizes * placed[:, 8]])
    detail = np.searchsorted(_DETAIL_FROM_M, sizes, side="right") - 1
    parts = []
    for level, of_level in enumerate(shapes):
        for kind, (points, triangles) in enumerate(of_level):
            chosen = np.flatnonzero((detail == level) & (placed[:, 3].astype(int) == kind))
            scaled = points[None] * (sizes[chosen, None] / 2 * placed[chosen, 9:12])[:, None]
            vertices = np.einsum("nij,nvj->nvi", turns[chosen], scaled) + centres[chosen, None]
            parts.append((vertices.reshape(-1, 3), triangles, len(points), chosen))
    return _joined(parts, placed[:, 12])


def _joined(parts: list[tuple[Array, Array, int, NDArray[np.intp]]], brightness: Array) -> Mesh:
    vertices, triangles, instances, first = [], [], [], 0
    for points, pattern, stride, chosen in parts:
        starts = first + stride * np.arange(len(chosen))
        triangles.append((pattern[None] + starts[:, None, None]).reshape(-1, 3))
        instances.append(np.repeat(chosen, len(pattern)))
        vertices.append(points)
        first += len(points)
    mesh_vertices = np.concatenate(vertices).astype(np.float32)
    mesh_triangles = np.concatenate(triangles).astype(np.uint32)
    instance = np.concatenate(instances).astype(np.int32)
    normals = vertex_normals(mesh_vertices, mesh_triangles)
    return Mesh(mesh_vertices, mesh_triangles, normals, brightness[instance].astype(np.float32), instance)


def _rock_shape(rng: np.random.Generator, detail: int) -> tuple[Array, Array]:
    """An angular boulder of about unit radius: a bumpy sphere cut by planes."""
    mesh = o3d.geometry.TriangleMesh.create_icosahedron(1.0)
    mesh = mesh.subdivide_midpoint(detail)
    points, triangles = np.asarray(mesh.vertices).copy(), np.asarray(mesh.triangles)
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    radius = np.ones(len(points))
    for frequency, amplitude in ((1.3, 0.35), (2.7, 0.19), (5.5, 0.08)):
        waves = np.sin(frequency * rng.standard_normal((4, 3)) @ points.T + rng.uniform(0, 2 * np.pi, (4, 1)))
        radius += amplitude * waves.mean(0)
    points *= radius[:, None]
    for _ in range(9):
        normal = rng.standard_normal(3)
        normal /= np.linalg.norm(normal)
        beyond = np.clip(points @ normal - rng.uniform(0.6, 0.95), 0, None)
        points -= 0.92 * beyond[:, None] * normal
    return points, triangles


def _place(relief: Relief, rng: np.random.Generator, aliasing: float) -> Array:
    """(N, 13) rocks: x, y, size, shape, quaternion, how high it sits, three stretches, brightness."""
    count = int(relief.traits.rocks)
    repeated = int(0.5 * aliasing * count)
    single = _properties(relief, rng, count - repeated)
    single[:, :2] = _by_density(relief, rng, count - repeated)
    if repeated == 0:
        return single
    members, kinds = 14, 5
    clusters = _properties(relief, rng, members * kinds).reshape(kinds, members, -1)
    clusters[..., :2] = rng.normal(0, 2.2, (kinds, members, 2))
    clusters[:, :2, 2] = rng.uniform(0.6, 1.6, (kinds, 2))
    sites = _by_density(relief, rng, max(repeated // members, 1))
    copies = clusters[rng.integers(kinds, size=len(sites))].copy()
    copies[..., :2] += sites[:, None]
    return np.concatenate([single, copies.reshape(-1, copies.shape[-1])])


def _properties(relief: Relief, rng: np.random.Generator, count: int) -> Array:
    slope, largest = relief.traits.rock_slope, relief.traits.largest_rock
    smallest = SMALLEST_M**-slope
    sizes = (smallest + rng.random(count) * (largest**-slope - smallest)) ** (-1 / slope)
    turns = rng.standard_normal((count, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    brightness = rng.uniform(-0.27, 0.33, count) + relief.traits.rock_albedo
    return np.column_stack(
        [
            np.zeros((count, 2)),
            sizes,
            rng.integers(_SHAPES, size=count),
            turns,
            rng.uniform(-0.12, 0.16, count),
            rng.uniform([0.8, 0.8, 0.55], [1.25, 1.1, 0.95], (count, 3)),
            brightness,
        ]
    )


def _by_density(relief: Relief, rng: np.random.Generator, count: int) -> Array:
    """(count, 2) places drawn where the relief says that rocks gather."""
    coarse = 5
    density = relief.rockiness[::coarse, ::coarse]
    chance = density.ravel().astype(float)
    cell = rng.choice(len(chance), count, p=chance / chance.sum())
    column, row = cell % density.shape[1], cell // density.shape[1]
    inside = rng.uniform(-0.5, 0.5, (count, 2)) * coarse
    places = (np.column_stack([column, row]) * coarse + inside) * CELL_M - SIZE_M / 2
    return np.clip(places, -SIZE_M / 2 + 1, SIZE_M / 2 - 1)


def _off_the_route(placed: Array, keep_clear: Array) -> NDArray[np.bool_]:
    sizes = placed[:, 2]
    if len(keep_clear) == 0:
        return np.ones(len(placed), bool)
    distance = cKDTree(keep_clear).query(placed[:, :2])[0]
    return (distance > 0.6 + 0.75 * sizes) | (sizes < 0.18)


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
        """Build the world but its scene; takes some seconds.

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

    @cached_property
    def scene(self) -> o3d.t.geometry.RaycastingScene:
        """Ground, horizon and rocks for rays; building it takes most of the time that a world takes."""
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
    normals = vertex_normals(vertices, triangles)
    return Mesh(vertices, triangles, normals, zeros.astype(np.float32), zeros.astype(np.int32))
