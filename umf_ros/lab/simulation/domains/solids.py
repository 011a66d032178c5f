"""Triangle meshes put together from simple bodies, the scene that rays are cast into, and curves to drive along."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import open3d as o3d
from numpy.typing import ArrayLike, NDArray

from umf_ros.core.geometry import Array
from umf_ros.lab.simulation.noise import Field
from umf_ros.lab.simulation.world import grid_triangles

_BOX = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0, 1)], float)
_BOX_QUADS = np.array([[0, 1, 2, 3], [4, 6, 5, 7], [0, 4, 1, 5], [2, 3, 6, 7], [1, 5, 3, 7], [0, 2, 4, 6]])


@dataclass(frozen=True)
class Scene:
    """Bodies that rays can meet.

    Attributes:
        rays: Open3D's scene.
        reflectance: by geometry id, one value for each triangle.
    """

    rays: o3d.t.geometry.RaycastingScene
    reflectance: dict[int, Field]


@dataclass(frozen=True, slots=True)
class Hits:
    """Where rays end.

    Attributes:
        distance: (N,) m, infinite where nothing is met.
        facing: (N,) cosine of the angle of incidence.
        reflectance: (N,) of what is met, 0 for nothing.
    """

    distance: Field
    facing: Field
    reflectance: Field


def cast_into(scene: Scene, origins: Array, directions: Field) -> Hits:
    """Send rays from points (N, 3) along unit directions (N, 3)."""
    answer = scene.rays.cast_rays(o3d.core.Tensor.from_numpy(np.hstack([origins, directions]).astype(np.float32)))
    geometry, primitive = answer["geometry_ids"].numpy(), answer["primitive_ids"].numpy()
    reflectance = np.zeros(len(directions), np.float32)
    for number, values in scene.reflectance.items():
        here = geometry == number
        reflectance[here] = values[primitive[here]]
    facing = np.abs(np.einsum("ij,ij->i", answer["primitive_normals"].numpy(), directions))
    return Hits(answer["t_hit"].numpy(), facing, reflectance)


class Solids:
    """A growing triangle mesh; x east, y north, z up, m."""

    def __init__(self) -> None:
        self._vertices: list[Array] = []
        self._triangles: list[NDArray[np.int64]] = []
        self._reflectance: list[Array] = []
        self._count = 0

    def add(self, vertices: ArrayLike, triangles: ArrayLike, reflectance: float) -> None:
        """Any mesh: vertices (V, 3), triangles (T, 3)."""
        points, faces = np.asarray(vertices, float), np.asarray(triangles, np.int64)
        self._vertices.append(points)
        self._triangles.append(faces + self._count)
        self._reflectance.append(np.full(len(faces), reflectance))
        self._count += len(points)

    def box(self, foot: ArrayLike, size: ArrayLike, yaw: float = 0.0, reflectance: float = 0.4) -> None:
        """A box standing on `foot` (3,), `size` (3,) long, wide and high, turned by `yaw`, rad."""
        turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        self.add((_BOX * np.asarray(size, float)) @ turn.T + np.asarray(foot, float), _halves(_BOX_QUADS), reflectance)

    def post(self, foot: ArrayLike, radius: float, height: float, reflectance: float = 0.3) -> None:
        """An eight-sided column standing on `foot` (3,)."""
        angle = np.linspace(0, 2 * np.pi, 9)
        ring = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)]) + np.asarray(foot, float)[:2]
        self.ribbon(ring, float(np.asarray(foot)[2]), height, reflectance)

    def ribbon(self, outline: Array, bottom: float, height: float, reflectance: float = 0.5) -> None:
        """An upright wall without thickness along an outline (N, 2)."""
        low = np.column_stack([outline, np.full(len(outline), bottom)])
        start = np.arange(len(outline) - 1)
        quads = np.stack([start, start + 1, start + len(outline), start + 1 + len(outline)], 1)
        self.add(np.vstack([low, low + np.array([0, 0, height])]), _halves(quads), reflectance)

    def slab(self, low: ArrayLike, high: ArrayLike, z: float, reflectance: float = 0.3) -> None:
        """A level rectangle between corners `low` (2,) and `high` (2,)."""
        (x0, y0), (x1, y1) = np.asarray(low, float), np.asarray(high, float)
        self.add([[x0, y0, z], [x1, y0, z], [x0, y1, z], [x1, y1, z]], _halves(np.array([[0, 1, 2, 3]])), reflectance)

    def sheet(self, vertices: Array, reflectance: float = 0.4) -> None:
        """A surface through a grid (A, B, 3) of points."""
        rows, columns = vertices.shape[:2]
        index = np.arange(rows * columns).reshape(rows, columns)
        a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
        triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])
        self.add(vertices.reshape(-1, 3), triangles, reflectance)

    def bar(self, path: Array, radius: float, reflectance: float = 0.4) -> None:
        """A four-sided tube along a path (N, 3), such as a strut or a cable."""
        along = np.gradient(path, axis=0)
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        aside = np.cross(along, np.where(np.abs(along[:, 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]))
        aside /= np.linalg.norm(aside, axis=1, keepdims=True)
        above = np.cross(aside, along)
        ring = np.stack([aside, above, -aside, -above, aside], 1)
        self.sheet(path[:, None] + radius * ring, reflectance)

    def bend(self, radius: float) -> None:
        """Bend all bodies so far to a ring around the origin: x becomes the arc along it, y points to the centre."""
        for number, points in enumerate(self._vertices):
            angle, away = points[:, 0] / radius, radius - points[:, 1]
            self._vertices[number] = np.column_stack([away * np.cos(angle), away * np.sin(angle), points[:, 2]])

    def ground(self, heights: Field, cell_m: float, reflectance: float = 0.25) -> None:
        """A square of heights (C, C), indexed [y, x], around the origin."""
        axis = (np.arange(len(heights)) - (len(heights) - 1) / 2) * cell_m
        x, y = np.meshgrid(axis, axis)
        triangles = grid_triangles(len(heights)).astype(np.int64)
        self.add(np.stack([x, y, heights], -1).reshape(-1, 3), triangles, reflectance)

    def blob(self, centre: ArrayLike, radii: ArrayLike, rng: np.random.Generator, reflectance: float = 0.3) -> None:
        """A lumpy ball, as a boulder or a bush."""
        mesh = o3d.geometry.TriangleMesh.create_icosahedron(1.0).subdivide_midpoint(2)
        points = np.asarray(mesh.vertices)
        points = points / np.linalg.norm(points, axis=1, keepdims=True)
        waves = np.sin(2.2 * points @ rng.standard_normal((3, 4)) + rng.uniform(0, 2 * np.pi, 4)).mean(1)
        shape = points * (1 + 0.35 * waves[:, None]) * np.asarray(radii, float)
        self.add(shape + np.asarray(centre, float), np.asarray(mesh.triangles), reflectance)

    def leaves(self, places: Array, size_m: float, rng: np.random.Generator, reflectance: float = 0.45) -> None:
        """Loose triangles of `size_m` around places (N, 3), which let part of the light through."""
        corners = places[:, None] + size_m * rng.normal(0, 0.6, (len(places), 3, 3))
        self.add(corners.reshape(-1, 3), np.arange(3 * len(places)).reshape(-1, 3), reflectance)

    def scene(self) -> Scene:
        """The scene of all bodies so far."""
        rays = o3d.t.geometry.RaycastingScene()
        vertices = np.concatenate(self._vertices).astype(np.float32)
        triangles = np.concatenate(self._triangles).astype(np.uint32)
        number = rays.add_triangles(o3d.core.Tensor.from_numpy(vertices), o3d.core.Tensor.from_numpy(triangles))
        return Scene(rays, {int(number): np.concatenate(self._reflectance).astype(np.float32)})


def _halves(quads: NDArray[np.int64]) -> NDArray[np.int64]:
    """Two triangles for each quad of corners a b (below) c d (above)."""
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [1, 3, 2]]])


STEP_M = 0.1


def rounded_rectangle(length: float, width: float, radius: float) -> Array:
    """(N, 2) points every 0.1 m along a rectangle around the origin with rounded corners, m."""
    corner_x, corner_y = length / 2 - radius, width / 2 - radius
    parts = []
    for quarter, (x, y) in enumerate(((1, 1), (-1, 1), (-1, -1), (1, -1))):
        angle = np.linspace(0, np.pi / 2, 30) + quarter * np.pi / 2
        centre = np.array([x * corner_x, y * corner_y])
        parts.append(centre + radius * np.column_stack([np.cos(angle), np.sin(angle)]))
    return closed(np.concatenate(parts))


def wobbly_ring(radius: float, wobble: float, rng: np.random.Generator) -> Array:
    """(N, 2) points every 0.1 m along a ring whose radius varies by the share `wobble`, m."""
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    waves = sum(np.sin(k * angle + rng.uniform(0, 2 * np.pi)) / k for k in (2, 3, 4))
    reach = radius * (1 + wobble * waves)
    return closed(np.column_stack([reach * np.cos(angle), reach * np.sin(angle)]))


def closed(corners: Array) -> Array:
    """(N, 2) points every 0.1 m along straight lines through corners (C, 2) and back to the first."""
    ring = np.vstack([corners, corners[:1]])
    path_length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(ring, axis=0), axis=1))])
    wanted = np.arange(0, path_length[-1], STEP_M)
    return np.stack([np.interp(wanted, path_length, ring[:, axis]) for axis in range(2)], 1)


def distance_to(trail: Array, place: Array) -> float:
    """Metres from a place (2,) to the nearest point of a trail."""
    return float(np.min(np.linalg.norm(trail - place, axis=1)))
