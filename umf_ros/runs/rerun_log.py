"""A run as a recording for the Rerun viewer: images, scans, poses and loop closures."""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from umf_ros.core.config import TerrainSettings
from umf_ros.core.errors import ConfigError, writing
from umf_ros.core.frames import Frame, Keyframe, State
from umf_ros.core.geometry import Array
from umf_ros.core.trajectory import Trajectory
from umf_ros.runs.reader import read_trajectory
from umf_ros.runs.run_file import read_absolute_verdicts, read_closures, read_verdicts
from umf_ros.terrain.grid import FREE, NEAR_LIMIT, OBSTACLE, make_grid
from umf_ros.terrain.voxels import VoxelMap

if TYPE_CHECKING:
    from umf_ros.detector import Detection

Item = TypeVar("Item")
GREY, BLUE, GREEN, AMBER, RED = (150, 150, 150), (60, 120, 216), (40, 160, 60), (240, 180, 30), (220, 40, 40)
STATE_COLOURS = {State.ACCEPTED: GREEN, State.PENDING: AMBER, State.REJECTED: RED}
GRID_COLOURS = {FREE: GREEN, NEAR_LIMIT: AMBER, OBSTACLE: RED}
BATCH = 200
"""Keyframes whose scans are read and added to the map of the ground together: bounds the memory."""
MOST_POINTS = 5000
"""Most points of a logged scan; a viewer shows thousands of scans together."""
PORT = 9876
"""Port of this machine at which the Rerun viewer listens."""


class RerunLog:
    """Writer of an .rrd file, or sender to the Rerun viewer, during a run.

    Images and scans are those of the keyframes, in the odometry's frame; without odometry there are no poses,
    and only images and numbers are logged. Whole scans wait in a temporary file for their poses in the map.

    Args:
        path: the file to write; None: a viewer that listens at `PORT`, else a new one, shows the run.
        terrain: limits of the rover, for the map of the ground.

    Raises:
        ConfigError: rerun-sdk is not installed, or there is no display for a viewer.
        OutputError: the file cannot be written.
    """

    def __init__(self, path: Path | None, terrain: TerrainSettings) -> None:
        try:
            import rerun
        except ImportError:
            option = "--rerun" if path else "--viewer"
            raise ConfigError(f"{option} needs another package: pip install 'umf_ros[rerun]'") from None
        self._rerun, self._path, self._terrain = rerun, path, terrain
        self._log = rerun.RecordingStream("umf_ros")
        if path is None:
            self._open_viewer()
        else:
            with writing(path):
                path.open("wb").close()
            self._log.save(path)
        self._frame: Frame | None = None
        self._places: dict[int, Array] = {}
        self._scans = TemporaryFile()  # noqa: SIM115 (deleted with the log)

    def _open_viewer(self) -> None:
        with socket.socket() as probe:
            is_open = not probe.connect_ex(("127.0.0.1", PORT))
        if not is_open and not any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY"))):
            raise ConfigError(f"--viewer: no display, and no viewer at port {PORT}; --rerun FILE writes a file for it")
        program = str(Path(sys.executable).with_name("rerun"))
        self._rerun.spawn(port=PORT, recording=self._log, executable_path=program)  # or the one that listens

    def watch(self, stream: Iterable[Item]) -> Iterator[Item]:
        """Yield the same stream; its latest frame is kept until its detection is logged."""
        for item in stream:
            if isinstance(item, Frame):
                self._frame = item
            yield item

    def show(self, detection: Detection) -> None:
        """Log the detection of the latest frame, if it became a keyframe."""
        keyframe, rerun = detection.keyframe, self._rerun
        if keyframe is None:
            return
        self._log.set_time("sensor_time", timestamp=keyframe.stamp_ns * 1e-9)
        if self._frame is not None and self._frame.left is not None:
            self._log.log("camera/left", rerun.Image(self._frame.left).compress(80))
        tested = [verdict.probability for verdict in detection.verdicts if verdict.probability is not None]
        self._log.log("best_probability", rerun.Scalars(max(tested, default=0.0)))
        self._log.log("milliseconds", rerun.Scalars(detection.latency_ms.get("total", 0.0)))
        self._show_in_space(keyframe, detection)

    def finish(self, folder: Path) -> None:
        """Log trajectories, map and verdicts of a run folder, if there are any, and finish the file."""
        for name, colour in (("odometry", GREY), ("optimized", BLUE)):
            if (driven := read_trajectory(folder / f"trajectory_{name}.tum")) is not None:
                line = self._rerun.LineStrips3D([driven.poses[:, :3, 3]], colors=[colour])
                self._log.log(f"trajectory/{name}", line, static=True)
                if name == "optimized":
                    self._show_map(folder, driven)
        self._scans.close()
        with writing(self._path, RuntimeError) if self._path else suppress(RuntimeError):  # the viewer was closed
            self._log.flush()
        self._log.disconnect()

    def _show_map(self, folder: Path, driven: Trajectory) -> None:
        """Log the ground, and closures and absolute measurements by state, at the poses of the trajectory."""
        settings, rerun = self._terrain, self._rerun
        voxels = VoxelMap(settings.cell_m)
        poses, known = driven.at(np.array(list(self._places), np.int64))
        self._scans.seek(0)
        for first in range(0, len(poses), BATCH):
            scans = [(np.load(self._scans), np.load(self._scans), pose) for pose in poses[first : first + BATCH]]
            voxels.add([scan for scan, is_known in zip(scans, known[first : first + BATCH], strict=True) if is_known])
        points = voxels.points()
        if len(points):
            cells, values = make_grid(points, settings).known()
            colours = [GRID_COLOURS[value] for value in values.tolist()]
            self._log.log("map/cloud", rerun.Points3D(points, radii=0.05, colors=[GREY]), static=True)
            self._log.log("map/grid", rerun.Points3D(cells, radii=settings.cell_m / 2, colors=colours), static=True)
        verdicts = read_verdicts(folder / "graph_verdicts.csv", read_closures(folder / "closures.csv"))
        measured = read_absolute_verdicts(folder / "absolute_verdicts.csv")
        for state, colour in STATE_COLOURS.items():
            stamps = np.array([key for key, one in verdicts.items() if one.state is state], np.int64).reshape(-1, 2)
            places, known = driven.at(stamps.ravel())
            lines = places[:, :3, 3].reshape(-1, 2, 3)[known.reshape(-1, 2).all(axis=1)]
            self._log.log(f"map/closures/{state.value}", rerun.LineStrips3D(lines, colors=[colour]), static=True)
            places, known = driven.at(np.array([one.stamp_ns for one in measured if one.state is state], np.int64))
            shown = rerun.Points3D(places[known, :3, 3], radii=0.1, colors=[colour])
            self._log.log(f"map/absolute/{state.value}", shown, static=True)

    def _show_in_space(self, keyframe: Keyframe, detection: Detection) -> None:
        pose = keyframe.odom_T_body
        if pose is None:
            return
        self._places[keyframe.stamp_ns] = pose[:3, 3]
        np.save(self._scans, keyframe.points)
        np.save(self._scans, keyframe.body_T_lidar)
        rerun = self._rerun
        self._log.log("rover", rerun.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
        step = max(len(keyframe.points) // MOST_POINTS, 1)
        self._log.log("rover/scan", rerun.Points3D(keyframe.points[::step], radii=0.03))
        ends = [
            [self._places[one.match_stamp_ns], pose[:3, 3]]
            for one in detection.closures
            if one.match_stamp_ns in self._places
        ]
        if ends:
            self._log.log(f"closures/{keyframe.stamp_ns}", rerun.LineStrips3D(ends, colors=[GREEN]))
