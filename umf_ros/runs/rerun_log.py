"""A run as a recording for the Rerun viewer: images, scans, poses and loop closures."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from umf_ros.bags.trajectories import read_tum
from umf_ros.core.errors import ConfigError, writing
from umf_ros.core.frames import Frame, Keyframe
from umf_ros.core.geometry import Array

if TYPE_CHECKING:
    from umf_ros.detector import Detection

Item = TypeVar("Item")
GREY, BLUE, GREEN = (150, 150, 150), (60, 120, 216), (40, 160, 60)
MOST_POINTS = 5000
"""Most points of a logged scan; a viewer shows thousands of scans together."""


class RerunLog:
    """Writer of an .rrd file during a run.

    Images and scans are those of the keyframes, in the odometry's frame; without odometry there are no poses,
    and only images and numbers are logged.

    Args:
        path: the file to write.

    Raises:
        ConfigError: rerun-sdk is not installed.
        OutputError: the file cannot be written.
    """

    def __init__(self, path: Path) -> None:
        try:
            import rerun
        except ImportError:
            raise ConfigError("--rerun needs another package: pip install 'umf_ros[rerun]'") from None
        with writing(path):
            path.open("wb").close()
        self._rerun = rerun
        self._log = rerun.RecordingStream("umf_ros")
        self._log.save(path)
        self._frame: Frame | None = None
        self._places: dict[int, Array] = {}

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
        """Log both trajectories of a run folder, if there are any, and finish the file."""
        paths = (("odometry", GREY), ("optimized", BLUE))
        for name, colour in paths:
            path = folder / f"trajectory_{name}.tum"
            if path.is_file() and path.stat().st_size:
                line = self._rerun.LineStrips3D([read_tum(path).poses[:, :3, 3]], colors=[colour])
                self._log.log(f"trajectory/{name}", line, static=True)
        self._log.flush()
        self._log.disconnect()

    def _show_in_space(self, keyframe: Keyframe, detection: Detection) -> None:
        pose = keyframe.odom_T_body
        if pose is None:
            return
        self._places[keyframe.stamp_ns] = pose[:3, 3]
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
