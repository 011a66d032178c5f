"""The live map of the ground: keyframes' scans and corrected path in, cloud and grid out, for those who listen."""

from __future__ import annotations

import time
from array import array
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import OccupancyGrid
from nav_msgs.msg import Path as PathMessage
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2

from umf_ros.core import watchdog
from umf_ros.core.config import Settings
from umf_ros.core.errors import MessageError, UmfError
from umf_ros.core.trajectory import Trajectory
from umf_ros.nodes.base_node import BaseNode
from umf_ros.nodes.conversions import LATCHED_QOS, SCAN_FIELDS, from_time, to_cloud, to_header
from umf_ros.nodes.diagnostics import OK, TOO_SLOW, WARN, status
from umf_ros.nodes.process import Worker, leave, run
from umf_ros.sensors.decode import OdometrySample, decode_pose, stamp_ns
from umf_ros.sensors.topic_finder import BACK_END
from umf_ros.terrain.grid import TerrainGrid, TerrainTiles, make_grid, write_terrain
from umf_ros.terrain.voxels import LivingMap

SCAN_DEPTH, QUEUE = 50, 10_000
MOST_ADDED = 10_000
"""Scans and odometry messages after which the map is updated also without subscribers: an update frees memory."""
RESTING = 4.0
"""Least pause between two updates, as a multiple of their duration: a large map takes one core a fifth of the time."""


class MapNode(BaseNode):
    """Map node: static points and the grid of where the rover can drive, in a thread and a process of its own."""

    def __init__(self) -> None:
        super().__init__("map_node", "folder for map.yaml, map.pgm and elevation.tif; empty: none", BACK_END)

    def _open(self) -> None:
        self._map = LivingMap(self._settings.terrain)
        self._path: PathMessage | None = None
        self._version, self._sent = 0, {"cloud": 0, "grid": 0}
        self._due_s, self._bytes, self._cropped = 0.0, 0, ""
        self._publishers_of: dict[str, Any] = {
            "cloud": self.create_publisher(PointCloud2, "~/map_cloud", LATCHED_QOS),
            "grid": self.create_publisher(OccupancyGrid, "~/map_grid", LATCHED_QOS),
        }
        self._worker: Worker[Callable[[], None]] = Worker(lambda step: step(), self._report_fault, QUEUE)
        self._subscribe_odometry(self._on_odometry)
        scans = "loop_closure_node/keyframe_scans"
        self._subscribe("scans", PointCloud2, scans, self._on_scan, QoSProfile(depth=SCAN_DEPTH), rare=True)
        self._subscribe("path", PathMessage, "pose_graph_node/path", self._on_path, LATCHED_QOS, rare=True)
        self._offer(self._worker, "~/save", lambda _: self._save())

    def _finish(self) -> None:
        self._worker.close(timeout_s=watchdog.PATIENT_S)
        if self._results:
            self._update()  # without subscribers there was none
            if len(self._map.voxels):
                self._save()

    def _retune(self, settings: Settings) -> None:
        """Nothing of the map changes while the node runs."""

    def _on_odometry(self, sample: OdometrySample) -> None:
        self._worker.submit(lambda: self._map.add_odometry(sample.stamp_ns, sample.odom_T_body))

    def _on_scan(self, message: PointCloud2) -> None:
        self._worker.submit(lambda: self._take_scan(message))

    def _take_scan(self, message: PointCloud2) -> None:
        if [one.name for one in message.fields] != SCAN_FIELDS or len(message.data) % (4 * len(SCAN_FIELDS)):
            raise MessageError("scan", f"keyframe scan without the fields {' '.join(SCAN_FIELDS)}")
        values = np.frombuffer(message.data, np.float32).reshape(-1, len(SCAN_FIELDS))
        values = values[np.isfinite(values).all(axis=1)]
        if len(values):
            self._map.add_scan(stamp_ns(message), values[:, :3], values[0, 3:].astype(float))

    def _on_path(self, message: PathMessage) -> None:
        self._path = message  # the newest one is decoded when there is an update

    def _tick(self) -> None:
        wanted = self._map.added > MOST_ADDED
        wanted = wanted or any(publisher.get_subscription_count() for publisher in self._publishers_of.values())
        if wanted and time.monotonic() >= self._due_s:
            self._worker.submit(self._show, needed=True, once=True)
        self._diagnose(self._own_status())

    def _update(self) -> None:
        path, self._path = self._path, None
        if path is not None:
            poses = {from_time(one.header.stamp): decode_pose(one.pose) for one in path.poses}
            self._map.correct(Trajectory.rising(sorted(poses.items())))
        self._version += self._map.update()

    def _show(self) -> None:
        """Publish what has changed and has subscribers, then pause as the limits of rate and bytes say."""
        began_s, sent = time.thread_time(), 0
        self._update()
        readers = {name: one.get_subscription_count() for name, one in self._publishers_of.items()}
        wanted = [name for name, count in readers.items() if count and self._sent[name] != self._version]
        points = self._map.voxels.points() if wanted else np.empty((0, 3), np.float32)
        header = to_header(self._map.newest_ns, self._settings.frames.map)
        for name in wanted:
            if name == "cloud":
                message: Any = to_cloud(points, ["x", "y", "z"], header)
            else:
                message = to_grid(self._limited(make_grid(points, self._settings.terrain)), header)
            self._publishers_of[name].publish(message)
            self._sent[name] = self._version
            sent += len(message.data) * readers[name]
        terrain = self._settings.terrain
        pause_s = max(terrain.period_s, sent / terrain.max_bytes_per_s, RESTING * (time.thread_time() - began_s))
        self._due_s, self._bytes = time.monotonic() + pause_s, self._bytes + sent

    def _limited(self, tiles: TerrainTiles) -> TerrainGrid:
        """Return the ground in `terrain.max_cells` around the rover; say so where that is not all of it."""
        grid = tiles.around(self._map.position[:2], self._settings.terrain.max_cells)
        self._cropped = grid.describe(tiles) if grid.cells.size < tiles.shape.prod() else ""
        if self._cropped and self._is_due("cropped", 300.0):
            self.get_logger().warning(f"map_grid shows only the surroundings of the rover: {self._cropped}")
        return grid

    def _save(self) -> str:
        self._update()
        folder = Path(self._results or "map_results")
        folder.mkdir(parents=True, exist_ok=True)
        points = self._map.voxels.points()
        if not len(points):
            raise UmfError("nothing to write: no scan has a place in the map yet")
        return f"written to {folder}: {write_terrain(folder, points, self._settings.terrain)}"

    def _failures(self) -> dict[str, str]:
        return super()._failures() | {"overload": TOO_SLOW if self._worker.dropped else ""}

    def _own_status(self) -> DiagnosticStatus:
        scans, odometry = self._map.kept
        values = {
            **self._faults,
            "keyframes": self._map.voxels.scans,
            "keyframes_waiting": self._map.waiting,
            "scans_in_memory": scans,
            "odometry_in_memory": odometry,
            "voxels": len(self._map.voxels),
            "rebuilt": self._map.rebuilt,
            "grid_cropped_to": self._cropped,
            "bytes_published": self._bytes,
            "queue_dropped": self._worker.dropped,
        }
        return status(WARN if self._faults else OK, "map", f"{self._map.voxels.scans} keyframes in the map", values)


def to_grid(grid: TerrainGrid, header: Any) -> OccupancyGrid:
    """Return the grid as a message."""
    message = OccupancyGrid(header=header)
    message.info.map_load_time, message.info.resolution = header.stamp, grid.cell_m
    message.info.height, message.info.width = grid.cells.shape
    message.info.origin.position.x, message.info.origin.position.y = grid.lower.tolist()
    message.info.origin.orientation.w = 1.0
    message.data = array("b", grid.cells.tobytes())
    return message


def main() -> None:
    """Run `ros2 run umf_ros map_node`."""
    leave(run(MapNode))


if __name__ == "__main__":
    main()
