"""Samples of simulated drives and of recordings."""

from __future__ import annotations

import os
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from umf_ros.core.errors import UmfError
from umf_ros.core.frames import StereoCamera
from umf_ros.core.geometry import Array
from umf_ros.lab.datasets.sample import Sample

NUMBERS = ("fx", "fy", "cx", "cy")
REQUIRED = ("images", "points", "world_T_body", "pass_index", "body_T_camera", *NUMBERS, "width", "height")
LARGE = ("images", "points")
LOCAL_HEADER = 30
"""Bytes before the name of a member of a zip archive; the last four are the lengths of what follows."""

PER_SAMPLE = ("images", "points", "depth", "world_T_body", "pass_index")


class SimulatedWorld:
    """All samples of one world; a `SampleSequence`.

    Raises:
        UmfError: the file is missing, damaged or not a shard.
    """

    def __init__(self, path: Path) -> None:
        content = _read(path)
        missing = [name for name in REQUIRED if name not in content]
        if missing:
            raise UmfError(f"{path} is not a shard of a simulated world: {', '.join(missing)} missing")
        counts = {name: len(content[name]) for name in PER_SAMPLE if name in content}
        if len(set(counts.values())) > 1:
            raise UmfError(f"{path} holds {', '.join(f'{count} {name}' for name, count in counts.items())}")
        self.name = path.stem
        self.place = path.stem
        self.setting = str(content.get("setting", "hard"))
        self.family = str(content.get("family", ""))
        self.seed = int(content.get("seed", -1))
        self.world_T_body = np.asarray(content["world_T_body"], float)
        self.pass_index = np.asarray(content["pass_index"], int)
        self._images, self._points = content["images"], content["points"]
        self._depth = content.get("depth")
        self._body_T_camera = np.asarray(content["body_T_camera"], float)
        numbers = {name: float(content[name]) for name in NUMBERS}
        self._camera = StereoCamera(int(content["width"]), int(content["height"]), **numbers, baseline=0.0)

    def __len__(self) -> int:
        return len(self.world_T_body)

    def sample(self, index: int) -> Sample:
        """The sample at `index`."""
        points = self._points[index]
        points = points[np.isfinite(points[:, 0])].astype(np.float32)
        return Sample(
            image=self._images[index],
            points=points[:, :3],
            intensity=points[:, 3],
            world_T_body=self.world_T_body[index],
            camera=self._camera,
            body_T_camera=self._body_T_camera,
            depth=None if self._depth is None else self._depth[index].astype(np.float32),
        )


def _read(path: Path) -> dict[str, np.ndarray]:
    try:
        archive = np.load(path)
        if isinstance(archive, np.ndarray):
            raise UmfError(f"{path} is not a shard of a simulated world, but a single array")
        with archive:
            content = {name: archive[name] for name in archive.files if name not in LARGE}
        return content | _mapped(path)
    except FileNotFoundError:
        raise UmfError(f"{path} does not exist") from None
    except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
        raise UmfError(f"cannot read {path}: {' '.join(str(error).split())}") from None


def _mapped(path: Path) -> dict[str, np.ndarray]:
    """The large arrays of an archive without compression, read only when they are used.

    A training set is larger than memory, and every process that reads it shares what is in the page cache.
    """
    found: dict[str, np.ndarray] = {}
    with zipfile.ZipFile(path) as archive, path.open("rb") as stream:
        damaged = archive.testzip()
        if damaged:
            raise ValueError(f"{damaged} is damaged")
        for name in LARGE:
            entry = archive.NameToInfo.get(f"{name}.npy")
            if entry is None:
                continue
            if entry.compress_type != zipfile.ZIP_STORED:
                raise ValueError("it is compressed; shards are not")
            stream.seek(entry.header_offset)
            header = stream.read(LOCAL_HEADER)
            stream.seek(sum(struct.unpack("<HH", header[-4:])), os.SEEK_CUR)  # its name and extra field
            np.lib.format.read_magic(stream)
            shape, fortran, kind = np.lib.format.read_array_header_1_0(stream)
            if kind.hasobject:
                raise ValueError("Object arrays are not read")
            found[name] = np.memmap(path, kind, "r", stream.tell(), shape, "F" if fortran else "C")
    return found


class WorldFolder:
    """The worlds in a folder; new ones may appear while it is in use.

    Raises:
        UmfError: the folder does not exist.
    """

    def __init__(self, folder: Path) -> None:
        if not folder.is_dir():
            raise UmfError(f"{folder} is not a folder of simulated worlds")
        self._folder = folder
        self.worlds: list[SimulatedWorld] = []

    def refresh(self) -> list[SimulatedWorld]:
        """Read what is new, by name, and return all worlds."""
        known = {world.name for world in self.worlds}
        for path in sorted(self._folder.glob("*.npz")):
            if path.stem not in known and not path.name.startswith("."):
                self.worlds.append(SimulatedWorld(path))
        return self.worlds


DETOUR_M = 60.0
"""A place less than this path length back is no revisit."""
BASELINE_M = 1.0
"""Way before and after a place that says where the rover was heading."""


class RecordedSequence:
    """Samples of a recording; a `SampleSequence`.

    Args:
        name: unique.
        place: sequences of one place share its coordinates.
        world_T_body: (N, 4, 4).
        pass_index: (N,), of one drive: `detours`.
        load: makes the sample at an index.
    """

    setting = "real"

    def __init__(
        self, name: str, place: str, world_T_body: Array, pass_index: NDArray, load: Callable[[int], Sample]
    ) -> None:
        self.name, self.place = name, place
        self.world_T_body, self.pass_index = world_T_body, pass_index
        self._load = load

    def __len__(self) -> int:
        return len(self.world_T_body)

    def sample(self, index: int) -> Sample:
        """The sample at `index`."""
        return self._load(index)


def path_length(positions: Array) -> Array:
    """(N,) metres along the path of (N, 3) positions."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])


def detours(positions: Array) -> Array:
    """(N,) passes of one drive through (N, 3) positions: a detour later it is the next one."""
    return path_length(positions) / DETOUR_M


def course(positions: Array) -> Array:
    """(N, 3, 3) level rotations of a rover that drives forward through (N, 3) positions.

    The heading is that of the chord from a metre before to a metre after; a rover that stands keeps
    its last one.
    """
    way = path_length(positions)
    reach = [
        np.stack([np.interp(way + side, way, positions[:, axis]) for axis in (0, 1)], 1)
        for side in (-BASELINE_M, BASELINE_M)
    ]
    chord = reach[1] - reach[0]
    heading = np.arctan2(chord[:, 1], chord[:, 0])
    moving = np.linalg.norm(chord, axis=1) > 1e-3
    last = np.maximum.accumulate(np.where(moving, np.arange(len(way)), 0))
    return Rotation.from_euler("z", heading[last][:, None]).as_matrix()


def poses_of(rotations: Array, positions: Array) -> Array:
    """(N, 4, 4) poses."""
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotations, positions
    return poses
