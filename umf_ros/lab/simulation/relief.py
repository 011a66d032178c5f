"""The shape and the colour of the ground, and the random fields and textures that repeat without a seam under them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import scipy.fft
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from umf_ros.core.geometry import Array
from umf_ros.lab.simulation.families import Traits

Field = NDArray[Any]
"""An array of float32."""
SIZE_M = 320.0
CELL_M = 0.2
CELLS = round(SIZE_M / CELL_M)
_SHORE_M = 10.0


class LevelGround:
    """A place whose floor or road is level."""

    def height(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Height of the ground under points, m."""
        return np.zeros(np.broadcast(x, y).shape)


def spectral_noise(
    cells: int, slope: float, rng: np.random.Generator, lowest: float = 1.0, highest: float = np.inf
) -> Field:
    """Periodic Gaussian field whose power falls as frequency^-slope.

    Args:
        cells: side of the square field.
        slope: 2 is rough, 4.5 is smooth.
        rng: source of the phases.
        lowest: cycles per side below which there is nothing.
        highest: cycles per side above which there is nothing.

    Returns:
        (cells, cells) float32 of unit standard deviation.
    """
    spectrum = scipy.fft.rfft2(rng.standard_normal((cells, cells), dtype=np.float32))
    across = np.fft.rfftfreq(cells, 1 / cells).astype(np.float32)
    along = np.fft.fftfreq(cells, 1 / cells).astype(np.float32)[:, None]
    frequency = np.hypot(along, across)
    frequency[0, 0] = 1
    gain = frequency ** (-slope / 2)
    gain[(frequency < lowest) | (frequency > highest)] = 0
    gain[0, 0] = 0
    field = scipy.fft.irfft2(spectrum * gain, s=(cells, cells)).astype(np.float32)
    return field / field.std()


def smooth_step(values: NDArray[np.floating], start: float, stop: float) -> NDArray[np.floating]:
    """0 up to `start`, 1 from `stop` on, smooth between."""
    x = np.clip((values - start) / (stop - start), 0, 1)
    return x * x * (3 - 2 * x)


def detail_texture(cells: int, period_m: float, steepness: float, pebbles: float, rng: np.random.Generator) -> Field:
    """Brightness and bumps of the ground too fine for its mesh, as a tile.

    Returns:
        (cells, cells, 3) float32: brightness of about unit deviation, and the slopes of the bumps
        towards -x and -y.
    """
    grain = spectral_noise(cells, 2.5, rng, 3, cells / 3)
    if pebbles > 0:
        stones = np.clip(spectral_noise(cells, 0.3, rng, cells / 40, cells / 9) - 1.1, 0, None)
        grain = 0.8 * grain + pebbles * stones
    smooth = cv2.GaussianBlur(grain, (0, 0), 1.2, borderType=cv2.BORDER_REFLECT)
    along, across = np.gradient(smooth, period_m / cells)
    scale = steepness / np.sqrt(np.mean(along**2) + np.mean(across**2))
    return np.dstack([grain, -across * scale, -along * scale]).astype(np.float32)


@dataclass(frozen=True, slots=True)
class Pan:
    """A dry lake: ground so even that a LiDAR sees nothing on it, while a camera sees its texture.

    Attributes:
        x_m, y_m: its middle.
        radius_m: within it there is neither relief nor rock.
    """

    x_m: float
    y_m: float
    radius_m: float


class Relief:
    """A square of ground around the origin; x east, y north, z up, metres.

    Attributes:
        traits: what the ground is made from.
        trail: (N, 2) closed curve on which the ground is kept drivable, a point every 0.1 m or so.
        heights: (CELLS, CELLS) float32, indexed [y, x]; cell (0, 0) lies at (-SIZE_M / 2, -SIZE_M / 2).
        maps: (CELLS, CELLS, 4) float32: slopes towards -x and -y, brightness (log), softness (0 gravel, 1 sand).
        rockiness: (CELLS, CELLS) float32, density of rocks relative to the mean.
    """

    def __init__(self, traits: Traits, rng: np.random.Generator, aliasing: float = 0.0, pan: Pan | None = None) -> None:
        """Build the ground; `aliasing` from 0 to 1 makes it repeat itself, and a pan is levelled into it."""
        self.traits = traits
        axis = (np.arange(CELLS, dtype=np.float32) * CELL_M) - SIZE_M / 2
        self._x, self._y = np.meshgrid(axis, axis)
        self.trail = _closed_curve(rng)
        distance = self._distance_to_trail()
        heights = _fractal(traits, rng, aliasing)
        rugged = spectral_noise(CELLS, 3.2, rng, 2, 40)
        heights += self._cliffs(distance, rng)
        heights += self._mounds(rng)
        rims = self._craters(heights, rng)
        sand = self._dunes(heights, rng, aliasing)
        self._raise_border(heights, rng)
        uneven = self._level(heights, pan) if pan else np.float32(1)
        self.heights = heights
        self.maps = self._maps(rims, sand * uneven, rng)
        slope = np.hypot(self.maps[..., 0], self.maps[..., 1])
        self.rockiness = np.exp(1.3 * rugged) * (1 - 0.75 * sand) + 2.5 * rims
        self.rockiness *= 1 - smooth_step(slope, 0.6, 0.9)  # on a cliff they would hang in the air
        self.rockiness *= uneven
        del self._x, self._y

    def height(self, x: ArrayLike, y: ArrayLike) -> NDArray[np.float64]:
        """Height of the ground at points, bilinear; outside the square its border's."""
        u = np.clip((np.asarray(x, float) + SIZE_M / 2) / CELL_M, 0, CELLS - 1.001)
        v = np.clip((np.asarray(y, float) + SIZE_M / 2) / CELL_M, 0, CELLS - 1.001)
        i, j = u.astype(int), v.astype(int)
        a, b, h = u - i, v - j, self.heights
        return (h[j, i] * (1 - a) + h[j, i + 1] * a) * (1 - b) + (h[j + 1, i] * (1 - a) + h[j + 1, i + 1] * a) * b

    def _distance_to_trail(self) -> Field:
        away = np.full((CELLS, CELLS), 255, np.uint8)
        pixels = np.round((self.trail + SIZE_M / 2) / CELL_M).astype(np.int32)
        cv2.polylines(away, [pixels[:, None]], True, 0)
        return cv2.distanceTransform(away, cv2.DIST_L2, 5) * np.float32(CELL_M)

    def _cliffs(self, distance: Field, rng: np.random.Generator) -> Field:
        """Canyons follow the trail and branch off; mesas stand away from it."""
        cliff = self.traits.cliff
        outline = spectral_noise(CELLS, 3.6, rng, 2, 40)
        shape = spectral_noise(CELLS, 4.2, rng, 1.5, 9)
        if abs(cliff) < 0.5:
            return np.zeros((CELLS, CELLS), np.float32)
        if cliff < 0:
            width = 9 + 3 * outline
            branches = np.abs(shape) * 30 - 2 + 1.5 * outline
            profile = 1 - smooth_step(np.minimum(distance - width, branches), 0, 7)
        else:
            away = smooth_step(distance + 2 * outline, 9, 16)
            profile = smooth_step(shape + 0.12 * outline, 0.35, 0.65) * away
        return (cliff * _terraced(profile, 3)).astype(np.float32)

    def _mounds(self, rng: np.random.Generator) -> Field:
        heights = np.zeros((CELLS, CELLS), np.float32)
        for _ in range(int(self.traits.mounds)):
            radius = rng.uniform(2, 9)
            window, x, y = self._around(rng.uniform(-0.48, 0.48, 2) * SIZE_M, 2.5 * radius)
            turn, stretch = rng.uniform(0, np.pi), rng.uniform(0.6, 1.0)
            along, across = x * np.cos(turn) + y * np.sin(turn), (y * np.cos(turn) - x * np.sin(turn)) / stretch
            height = radius * rng.uniform(0.1, 0.3)
            heights[window] += height * np.exp(-((along**2 + across**2) / (0.8 * radius**2)))
        return heights

    def _craters(self, heights: Field, rng: np.random.Generator) -> Field:
        """Dig craters of a natural size distribution; returns where their rims are."""
        rims = np.zeros_like(heights)
        if self.traits.great_crater > 1:
            place = self.trail[rng.integers(len(self.trail))] * rng.uniform(0.2, 0.55)
            self._crater(heights, rims, place, self.traits.great_crater, rng)
        for _ in range(int(self.traits.craters)):
            radius = min(1.3 * (rng.random() + 1e-3) ** (-1 / 1.7), 16.0)
            self._crater(heights, rims, rng.uniform(-0.5, 0.5, 2) * SIZE_M, radius, rng)
        return rims

    def _crater(self, heights: Field, rims: Field, place: Array, radius: float, rng: np.random.Generator) -> None:
        window, x, y = self._around(place, 2.2 * radius)
        angle = np.arctan2(y, x)
        phase = rng.uniform(0, 2 * np.pi, 3)
        ragged = 1 + 0.05 * np.sin(2 * angle + phase[0]) + 0.035 * np.sin(3 * angle + phase[1])
        r = np.hypot(x, y) / radius * (ragged + 0.02 * np.sin(5 * angle + phase[2]))
        depth = (0.22 if radius < 20 else 0.16) * radius * rng.uniform(0.5, 1.0)
        lip = 0.25 * depth
        inside = -depth * (1 - r**2) + lip * r**2
        outside = lip * np.exp(-(((r - 1) / 0.35) ** 2))
        if radius > 20:  # a large crater wipes out what was there before it
            heights[window] *= np.clip(0.35 + 0.65 * (r / 1.3) ** 2, 0, 1)
        heights[window] += np.where(r < 1, inside, outside).astype(np.float32)
        rims[window] += np.exp(-(((r - 1) / 0.3) ** 2)).astype(np.float32)

    def _dunes(self, heights: Field, rng: np.random.Generator, aliasing: float) -> Field:
        """Heap up dunes with ripples on them; returns where there is sand, 0 to 1."""
        warp = (1 - 0.7 * aliasing) * 5 * spectral_noise(CELLS, 4, rng, 1, 8)
        patches = spectral_noise(CELLS, 4, rng, 1, 6)
        wind = rng.uniform(0, 2 * np.pi)
        if self.traits.dune_height < 0.02:
            return np.zeros_like(heights)
        sand = (1 / (1 + np.exp(-4 * patches))).astype(np.float32)
        along = self._x * np.cos(wind) + self._y * np.sin(wind) + warp
        phase = 2 * np.pi * along / self.traits.dune_length
        heights += self.traits.dune_height * sand * (np.sin(phase) + 0.35 * np.sin(2 * phase + 0.9))
        ripples = self._x * np.cos(wind + 0.2) + self._y * np.sin(wind + 0.2) + 0.25 * warp
        heights += 0.022 * sand * np.sin(2 * np.pi * ripples / 1.6)
        return sand

    def _raise_border(self, heights: Field, rng: np.random.Generator) -> None:
        """A rise along the border hides where the detailed ground ends."""
        edge = (np.abs(self._x) ** 5 + np.abs(self._y) ** 5) ** 0.2 / (SIZE_M / 2)
        ragged = spectral_noise(CELLS, 3.6, rng, 3, 30)
        heights += ((6 + 1.5 * ragged) * smooth_step(edge + 0.015 * ragged, 0.78, 1.0)).astype(np.float32)

    def _level(self, heights: Field, pan: Pan) -> Field:
        """Fill a pan to the mean height of its ground; returns 0 inside and 1 outside of it."""
        away = np.hypot(self._x - np.float32(pan.x_m), self._y - np.float32(pan.y_m))
        uneven = smooth_step(away, pan.radius_m, pan.radius_m + _SHORE_M).astype(np.float32)
        level = heights[away < pan.radius_m].mean()
        heights *= uneven
        heights += (1 - uneven) * level
        return uneven

    def _maps(self, rims: Field, sand: Field, rng: np.random.Generator) -> Field:
        along, across = np.gradient(self.heights, CELL_M)
        brightness = 0.10 * spectral_noise(CELLS, 2.6, rng, 2, 200) + 0.05 * spectral_noise(CELLS, 2.0, rng, 30)
        brightness = self.traits.contrast * (brightness - 0.10 * sand + 0.12 * np.clip(rims, 0, 1))
        return np.dstack([-across, -along, brightness, sand]).astype(np.float32)

    def _around(self, place: Array, reach: float) -> tuple[tuple[slice, slice], Field, Field]:
        """The window of cells within `reach` of a place, and their coordinates relative to it."""
        low = np.clip(((place - reach + SIZE_M / 2) / CELL_M).astype(int), 0, CELLS)
        high = np.clip(((place + reach + SIZE_M / 2) / CELL_M).astype(int) + 1, 0, CELLS)
        window = (slice(low[1], high[1]), slice(low[0], high[0]))
        return window, self._x[window] - np.float32(place[0]), self._y[window] - np.float32(place[1])


def _fractal(traits: Traits, rng: np.random.Generator, aliasing: float) -> Field:
    """Relief of all scales; with aliasing its metre scale repeats every quarter of the square."""
    heights = traits.relief * spectral_noise(CELLS, 4.4, rng, 1.5, 60)
    rough = np.minimum(np.exp(0.6 * spectral_noise(CELLS, 3.6, rng, 2, 20)), 2.5)  # a rover has to get through
    lumps = spectral_noise(CELLS, 3.2, rng, 20)
    tile = np.tile(spectral_noise(CELLS // 4, 3.2, rng, 5), (4, 4))
    heights += traits.lumps * rough * (np.sqrt(1 - 0.8 * aliasing) * lumps + np.sqrt(0.8 * aliasing) * tile)
    knolls = spectral_noise(CELLS, 3.0, rng, 8, 45)
    heights += 0.16 * np.minimum(rough, 1.5) * knolls
    heights += 0.003 * rough * spectral_noise(CELLS, 2.0, rng, 150)
    return heights


def _terraced(profile: NDArray[np.floating], steps: int) -> NDArray[np.floating]:
    """A slope from 0 to 1 broken into cliffs and ledges."""
    scaled = profile * steps
    level = np.floor(scaled)
    return 0.75 * (level + smooth_step(scaled - level, 0.3, 0.9)) / steps + 0.25 * profile


def _closed_curve(rng: np.random.Generator) -> Array:
    """A wobbly loop around the origin, about 350 m long."""
    corners = 9
    angle = np.linspace(0, 2 * np.pi, corners + 1) + rng.uniform(0, 2 * np.pi)
    radius = 62 * rng.uniform(0.6, 1.25, corners)
    radius = np.append(radius, radius[0])
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)
    points[-1] = points[0]
    curve = CubicSpline(np.linspace(0, 1, corners + 1), points, bc_type="periodic")
    return curve(np.linspace(0, 1, 4000, endpoint=False))
