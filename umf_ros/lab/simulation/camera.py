"""A pinhole camera with exposure, vignetting and noise, under the light of sun and sky."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TypeVar

import cv2
import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from umf_ros.core.frames import Image, StereoCamera
from umf_ros.core.geometry import Array
from umf_ros.lab.simulation.relief import CELL_M, SIZE_M, Field
from umf_ros.lab.simulation.world import HORIZON, ROCK, TEXTURE_PERIODS_M, World

Task = TypeVar("Task")
Result = TypeVar("Result")


def ahead(
    pool: ThreadPoolExecutor, work: Callable[[Task], Result], tasks: Iterable[Task], depth: int = 4
) -> Iterator[Result]:
    """Results in the order of the tasks, up to `depth` of them computed ahead by the pool's threads."""
    waiting: deque[Future[Result]] = deque()
    for task in tasks:
        waiting.append(pool.submit(work, task))
        if len(waiting) >= depth:
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()


MOONLIGHT = 2e-6
"""Of a full Moon, as a share of the sun's: 0.2 of 100,000 lux."""


@dataclass(frozen=True, slots=True)
class Sun:
    """Direction of the sunlight.

    Attributes:
        azimuth_deg: where the sun stands, counter-clockwise from the world's x axis.
        elevation_deg: above the horizontal plane.
        strength: of all light, the sky's too, as a share of the day's.
    """

    azimuth_deg: float
    elevation_deg: float
    strength: float = 1.0

    @classmethod
    def drawn(cls, lowest_deg: float, highest_deg: float, rng: np.random.Generator) -> Sun:
        """A sun anywhere around, within a range of elevations."""
        return cls(float(rng.uniform(0, 360)), float(rng.uniform(lowest_deg, highest_deg)))

    @property
    def direction(self) -> Array:
        """(3,) float32 unit vector towards the sun, world frame."""
        azimuth, elevation = np.radians([self.azimuth_deg, self.elevation_deg])
        flat = np.cos(elevation)
        return np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], np.float32)

    def moved(self, degrees: float) -> Sun:
        """The sun later in the day: further around, and higher or lower with it."""
        elevation = self.elevation_deg + 6 * np.sin(np.radians(1.7 * degrees))
        return replace(
            self, azimuth_deg=(self.azimuth_deg + degrees) % 360, elevation_deg=float(np.clip(elevation, 10, 60))
        )

    def set_for(self, metres: float) -> Sun:
        """The light after so many metres of driving after sunset: soon no more than the Moon's."""
        return replace(self, strength=max(MOONLIGHT, 10.0 ** -max(metres, 0.0)))


_TEXTURE_GAIN = (0.07, 0.075, 0.07)
_STRATA_PERIOD_M = 12.8
_LARGE_PX = 400


@dataclass(slots=True)
class RayHits:
    """Hits of the rays of one picture; all arrays have one entry per ray.

    Attributes:
        distance: (N,) float32 along the ray, m; infinite for sky.
        geometry: (N,) uint32 geometry id.
        primitive: (N,) uint32 triangle of that geometry.
        uv: (N, 2) float32 place in the triangle.
        normal: (N, 3) float32 of the triangle.
    """

    distance: Field
    geometry: NDArray[np.uint32]
    primitive: NDArray[np.uint32]
    uv: Field
    normal: Field

    def part(self, rays: slice) -> RayHits:
        """The hits of some of the rays."""
        return RayHits(self.distance[rays], self.geometry[rays], self.primitive[rays], self.uv[rays], self.normal[rays])


def cast(world: World, origin: Array, directions: Field) -> RayHits:
    """Send rays from one point, or one point each, along (N, 3) unit directions."""
    rays = np.empty((len(directions), 6), np.float32)
    rays[:, :3] = origin
    rays[:, 3:] = directions
    answer = world.scene.cast_rays(o3d.core.Tensor.from_numpy(rays))
    return RayHits(
        answer["t_hit"].numpy(),
        answer["geometry_ids"].numpy(),
        answer["primitive_ids"].numpy(),
        answer["primitive_uvs"].numpy(),
        answer["primitive_normals"].numpy(),
    )


class Shader:
    """Light arriving at a camera in one world under one sun."""

    def __init__(self, world: World, sun: Sun) -> None:
        self.world, self.sun = world, sun.direction
        self.traits = world.traits

    def radiance(
        self, hits: RayHits, origin: Array, directions: Field, shape: tuple[int, int], pixel_rad: float
    ) -> Field:
        """Light along each ray of a picture.

        Args:
            hits: what the rays met.
            origin: (3,) centre of the camera, world frame.
            directions: (N, 3) unit directions, world frame.
            shape: rows and columns, N in all.
            pixel_rad: angle that a pixel spans.

        Returns:
            (rows, columns) float32; the sun on a white matt surface is 1.
        """
        seen = np.isfinite(hits.distance)
        if not seen.any():
            return self._sky(directions[:, 2], np.einsum("ij,j->i", directions, self.sun)).reshape(shape)
        distance = np.where(seen, hits.distance, np.float32(0))
        dx, dy, dz = (np.ascontiguousarray(directions[:, axis]) for axis in range(3))
        x, y, z = (np.float32(o) + d * distance for o, d in zip(origin, (dx, dy, dz), strict=True))
        nx, ny, nz, brightness, softness = self._surface(hits, x, y, shape)
        facing = np.abs(nx * dx + ny * dy + nz * dz)
        footprint = distance * np.float32(pixel_rad) / np.maximum(facing, np.float32(0.06))
        brightness += self._detail(x, y, z, footprint, softness, (nx, ny, nz))
        norm = 1 / np.sqrt(nx * nx + ny * ny + nz * nz)
        nx, ny, nz = nx * norm, ny * norm, nz * norm
        incidence = np.maximum(nx * self.sun[0] + ny * self.sun[1] + nz * self.sun[2], 0)
        incidence[~seen] = 0
        lit = self._sunlit(incidence, hits, distance, (x, y, z), shape)
        toward_sun = dx * self.sun[0] + dy * self.sun[1] + dz * self.sun[2]
        facing = np.maximum(-(nx * dx + ny * dy + nz * dz), np.float32(0.03))
        light = self._reflected(incidence, facing, toward_sun) * lit
        light += self.traits.ambient * (0.6 + 0.4 * nz if self.traits.sky > 0 else 1.0)
        light *= self.traits.albedo * np.exp(1.6 * np.clip(brightness, -1.5, 1.5))
        if self.traits.sky > 0:
            clear = np.exp(distance * np.float32(-1 / self.traits.haze_m))
            light = light * clear + (1 - clear) * np.float32(0.7 * self.traits.sky)
        sky = np.flatnonzero(~seen)
        light[sky] = self._sky(dz[sky], toward_sun[sky])
        return light.reshape(shape).astype(np.float32, copy=False)

    def _surface(self, hits: RayHits, x: Field, y: Field, shape: tuple[int, int]) -> tuple[Field, ...]:
        """Unit normal, log brightness and softness before the fine detail."""
        column, row = ((value + SIZE_M / 2) / np.float32(CELL_M) for value in (x, y))
        maps = cv2.remap(
            self.world.relief.maps,
            column.reshape(shape),
            row.reshape(shape),
            cv2.INTER_LINEAR,
            None,
            cv2.BORDER_REPLICATE,
        ).reshape(-1, 4)
        nx, ny, brightness, softness = (np.ascontiguousarray(maps[:, channel]) for channel in range(4))
        nz = np.ones_like(nx)
        norm = 1 / np.sqrt(nx * nx + ny * ny + 1)
        nx, ny, nz = nx * norm, ny * norm, nz * norm
        for geometry, smooth in ((HORIZON, 1.0), (ROCK, 0.45)):
            where = np.flatnonzero(hits.geometry == geometry)
            if len(where):
                normals = self._interpolated(geometry, hits, where) * np.float32(smooth)
                normals += np.float32(1 - smooth) * hits.normal[where]
                normals /= np.linalg.norm(normals, axis=1, keepdims=True)
                nx[where], ny[where], nz[where] = normals.T
                own = self.world.solids[geometry].brightness[hits.primitive[where]]
                brightness[where] = own + (brightness[where] if geometry == ROCK else 0)
                softness[where] = 0
        return nx, ny, nz, brightness, softness

    def _interpolated(self, geometry: int, hits: RayHits, where: NDArray[np.intp]) -> Field:
        mesh = self.world.solids[geometry]
        corners = mesh.normals[mesh.triangles[hits.primitive[where]]]
        u, v = hits.uv[where, :1], hits.uv[where, 1:]
        return corners[:, 0] * (1 - u - v) + corners[:, 1] * u + corners[:, 2] * v

    def _detail(
        self, x: Field, y: Field, z: Field, footprint: Field, softness: Field, normal: tuple[Field, Field, Field]
    ) -> Field:
        """Brightness of the tiles; adds their bumps to the normal. Each fades out where a pixel blurs it."""
        nx, ny, nz = normal
        upright = nz < np.float32(0.65)  # such faces are textured from the side, or the tiles would smear
        sideways = upright & (np.abs(nx) > np.abs(ny))
        across, along = np.where(sideways, y, x), np.where(upright, z, y)
        brightness, first, second = np.zeros_like(x), np.zeros_like(x), np.zeros_like(x)
        for texture, period, gain in zip(self.world.textures, TEXTURE_PERIODS_M, _TEXTURE_GAIN, strict=True):
            weight = np.float32(1.3) - footprint * np.float32(28 / period)
            near = np.flatnonzero(weight > 0)
            weight = np.minimum(weight[near], 1) * (1 - np.float32(0.55) * softness[near])
            value = _tiled(texture, across[near] / np.float32(period), along[near] / np.float32(period))
            brightness[near] += np.float32(gain * self.traits.contrast) * weight * value[:, 0]
            first[near] += weight * value[:, 1]
            second[near] += weight * value[:, 2]
        nx += np.where(sideways, 0, first)
        ny += np.where(sideways, first, np.where(upright, 0, second))
        nz += np.where(upright, second, 0)
        vast = np.float32(23 * TEXTURE_PERIODS_M[0])
        brightness += np.float32(0.05) * _tiled(self.world.textures[0], x / vast, y / vast)[:, 0]
        if self.traits.strata > 0.02:
            layer = ((z + np.float32(0.05) * x) * np.float32(256 / _STRATA_PERIOD_M)).astype(np.int32) & 255
            exposed = np.clip((np.float32(0.95) - nz) * 3, 0, 1)  # flat ground lies within one layer, under dust
            brightness += np.float32(self.traits.strata * 0.5) * self.world.strata[layer] * exposed
        return brightness

    def _sunlit(
        self, incidence: Field, hits: RayHits, distance: Field, place: tuple[Field, ...], shape: tuple[int, int]
    ) -> Field:
        """1 where the sun is seen, 0 in shadow.

        In large pictures every second pixel of every second row is tested first, and what lies between
        pixels that agree takes their answer.
        """
        facing = incidence > 0
        lit = np.zeros(len(incidence), np.float32)
        if shape[1] < _LARGE_PX or shape[0] % 2 or shape[1] % 2:
            self._test_sun(lit, np.flatnonzero(facing), hits, distance, place)
            return lit
        coarse = np.zeros(shape, bool)
        coarse[::2, ::2] = True
        self._test_sun(lit, np.flatnonzero(facing & coarse.ravel()), hits, distance, place)
        known = np.pad(lit.reshape(shape)[::2, ::2], ((0, 1), (0, 1)), mode="edge")
        total = known[:-1, :-1] + known[1:, :-1] + known[:-1, 1:] + known[1:, 1:]
        total = np.repeat(np.repeat(total, 2, axis=0), 2, axis=1)
        total[coarse] = 4 * lit.reshape(shape)[::2, ::2].ravel()
        lit = np.where(facing, total.ravel() == 4, 0).astype(np.float32)
        self._test_sun(lit, np.flatnonzero(facing & (total.ravel() % 4 > 0)), hits, distance, place)
        return lit

    def _test_sun(
        self, lit: Field, where: NDArray[np.intp], hits: RayHits, distance: Field, place: tuple[Field, ...]
    ) -> None:
        """Send rays to the sun from some of the places and note whether they arrive."""
        rays = np.empty((len(where), 6), np.float32)
        normal = hits.normal[where]
        # off the surface, or it would shade itself
        lift = (0.012 + 3e-4 * distance[where]) * np.sign(np.einsum("ij,j->i", normal, self.sun))
        for axis in range(3):
            rays[:, axis] = place[axis][where] + normal[:, axis] * lift
        rays[:, 3:] = self.sun
        lit[where] = ~self.world.scene.test_occlusions(o3d.core.Tensor.from_numpy(rays)).numpy()

    def _reflected(self, incidence: Field, facing: Field, toward_sun: Field) -> Field:
        """Share of the sunlight sent to the camera: matt, mixed with the Lommel-Seeliger law of dusty planets."""
        dusty = np.float32(0.35 * self.traits.backscatter + 0.1)
        # tan of half the phase angle between sun and camera; the surge peaks where they align
        half = np.sqrt(np.maximum(1 + toward_sun, 0) / np.maximum(1 - toward_sun, np.float32(1e-3)))
        surge = 1 + np.float32(0.6) / (1 + half / np.float32(0.12))
        return dusty * 2 * incidence / (incidence + facing) * surge + (1 - dusty) * incidence

    def _sky(self, up: Field, toward_sun: Field) -> Field:
        if self.traits.sky == 0:
            return np.full(len(up), 0.0008, np.float32)
        glow = np.exp(-2.5 * np.arccos(np.clip(toward_sun, -1, 1)))
        return self.traits.sky * (1 - 0.55 * np.sqrt(np.clip(up, 0, 1)) + 0.8 * glow)


def _tiled(texture: Field, u: Field, v: Field) -> Field:
    """(N, 3) values of a repeating tile at places measured in periods."""
    cells = len(texture)
    width = 256
    rows = -(-len(u) // width)
    columns = np.zeros((rows, width), np.float32)
    lines = np.zeros((rows, width), np.float32)
    columns.ravel()[: len(u)] = (u - np.floor(u)) * np.float32(cells)
    lines.ravel()[: len(v)] = (v - np.floor(v)) * np.float32(cells)
    if rows == 0:
        return np.zeros((0, 3), np.float32)
    return cv2.remap(texture, columns, lines, cv2.INTER_LINEAR, None, cv2.BORDER_WRAP).reshape(-1, 3)[: len(u)]


SKY = 255
TRAINING_SIZE = (224, 224)
"""Width and height of the images a network is trained on."""
BAND_ROWS = 128


def resized(camera: StereoCamera, width: int, height: int) -> StereoCamera:
    """The intrinsics after the whole picture is scaled to another size."""
    across, along = width / camera.width, height / camera.height
    return StereoCamera(
        width,
        height,
        camera.fx * across,
        camera.fy * along,
        (camera.cx + 0.5) * across - 0.5,
        (camera.cy + 0.5) * along - 0.5,
        camera.baseline,
    )


@dataclass(frozen=True, slots=True)
class Rendering:
    """One exposure and the truth behind it.

    Attributes:
        image: (H, W) uint8.
        depth: (H, W) float32 along the optical axis, m; 0 for sky.
        semantic: (H, W) uint8: 0 ground, 1 horizon, 2 rock, 255 sky.
        instance: (H, W) int32: number of the rock from 1 on, 0 for everything else.
    """

    image: Image
    depth: Field
    semantic: NDArray[np.uint8]
    instance: NDArray[np.int32]


class Camera:
    """Takes pictures of a world."""

    def __init__(self, world: World, intrinsics: StereoCamera, distortion: Sequence[float] = ()) -> None:
        """Place a camera in a world; `distortion` is k1 k2 p1 p2 ... as OpenCV has them."""
        self.world, self.intrinsics = world, intrinsics
        self._shape = (intrinsics.height, intrinsics.width)
        rays = _rays(intrinsics, distortion)
        length = np.linalg.norm(rays, axis=-1, keepdims=True)
        self._directions = (rays / length).reshape(-1, 3).astype(np.float32)
        self._axial = (1 / length).reshape(self._shape).astype(np.float32)

    def take(
        self,
        world_T_camera: Array,
        sun: Sun,
        rng: np.random.Generator,
        exposure: float = 1.0,
        smear_px: Array | None = None,
    ) -> Rendering:
        """Expose once.

        Args:
            world_T_camera: pose of the optical frame.
            sun: the light.
            rng: source of the sensor's noise.
            exposure: brightness relative to what the automatic exposure would choose.
            smear_px: (2,) how far the picture moves across columns and rows while the shutter is open.
        """
        rotation, origin = world_T_camera[:3, :3].astype(np.float32), world_T_camera[:3, 3]
        # not a matrix product: its library would wake threads that then spin beside the other renderers
        directions = cv2.transform(self._directions[None], rotation)[0]
        hits = cast(self.world, origin, directions)
        pixel_rad = 2 / (self.intrinsics.fx + self.intrinsics.fy)
        shader, (rows, columns) = Shader(self.world, sun), self._shape
        light = np.empty(self._shape, np.float32)
        for top in range(0, rows, BAND_ROWS):
            band = slice(top * columns, (top + BAND_ROWS) * columns)
            shape = (min(BAND_ROWS, rows - top), columns)
            light[top : top + BAND_ROWS] = shader.radiance(hits.part(band), origin, directions[band], shape, pixel_rad)
        light *= np.float32(sun.strength)
        if smear_px is not None:
            light = _smeared(light, smear_px)
        image = self._develop(light, rng, exposure)
        depth = np.where(np.isfinite(hits.distance), hits.distance, 0).reshape(self._shape) * self._axial
        return Rendering(image, depth, *self._labels(hits))

    def _develop(self, light: Field, rng: np.random.Generator, exposure: float) -> Image:
        if self.intrinsics.width > 400:
            light = cv2.GaussianBlur(light, (5, 5), 0.6)  # the lens
        light = light * self._axial**3
        middle, bright = np.percentile(light[int(0.35 * len(light)) :: 3, ::3], (70, 98))
        gain = exposure / max(float(middle) / 0.40, float(bright) / 1.1, 1e-3)
        value = np.sqrt(np.clip(light * np.float32(gain), 0, 1.05))
        value *= np.sqrt(value)
        noise = rng.standard_normal(self._shape, dtype=np.float32)
        value += noise * np.sqrt(np.float32(0.008**2) + value * np.float32(0.010**2))
        return np.clip(value * 255, 0, 255).astype(np.uint8)

    def _labels(self, hits: RayHits) -> tuple[NDArray[np.uint8], NDArray[np.int32]]:
        semantic = np.minimum(hits.geometry, SKY).astype(np.uint8)
        instance = np.zeros(len(semantic), np.int32)
        rocks = np.flatnonzero(hits.geometry == ROCK)
        instance[rocks] = self.world.solids[ROCK].instance[hits.primitive[rocks]] + 1
        return semantic.reshape(self._shape), instance.reshape(self._shape)


def _rays(camera: StereoCamera, distortion: Sequence[float]) -> Field:
    """(H, W, 3) float32 directions of the pixels, 1 along the optical axis."""
    column, row = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    if distortion:
        matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        pixels = np.stack([column, row], -1).reshape(-1, 1, 2)
        ideal = cv2.undistortPoints(pixels, matrix, np.array(distortion, float)).reshape(*column.shape, 2)
        column, row = ideal[..., 0], ideal[..., 1]
    else:
        column, row = (column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy
    return np.stack([column, row, np.ones_like(row)], -1)


def _smeared(light: Field, shift_px: Array) -> Field:
    """The picture drawn out along a straight line, as far as it is longer than half a pixel."""
    length = float(np.hypot(*shift_px))
    if length < 0.5:
        return light
    reach = int(np.ceil(length / 2))
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1), np.float32)
    for part in np.linspace(-0.5, 0.5, 8 * reach + 1):
        column, row = reach + part * shift_px[0], reach + part * shift_px[1]
        left, top = int(np.floor(column)), int(np.floor(row))
        across, along = column - left, row - top
        kernel[top : top + 2, left : left + 2] += np.outer([1 - along, along], [1 - across, across])[
            : 2 * reach + 1 - top, : 2 * reach + 1 - left
        ]
    return cv2.filter2D(light, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)
