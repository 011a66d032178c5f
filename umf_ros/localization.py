"""A recording against a map that stays as it is: where was the rover, and how sure is that."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from umf_ros.core.config import Settings
from umf_ros.core.frames import Frame
from umf_ros.core.geometry import to_quaternion
from umf_ros.core.trajectory import Trajectory, write_tum
from umf_ros.detector import Detection, LoopDetector
from umf_ros.localizer import Localization, Localizer, read_poses
from umf_ros.runs.tables import POSE, SIGMA, CsvTable
from umf_ros.runs.writer import RunRecorder, read_summary, write_summary
from umf_ros.sensors.decode import OdometrySample
from umf_ros.sensors.sessions import OdometrySessionSplitter

COLUMNS = ["stamp_ns", *POSE, *SIGMA, "probability"]
TABLE = "localization.csv"


@dataclass
class LocalizationCounts:
    """What a run came to, as it stands in the summary.

    Attributes:
        keyframes: of the run.
        keyframes_until_found: up to the first known pose; None while there is none.
        located: keyframes with a known pose.
        relocalised: how often a pose was found, or another than before.
        agreed, contradicted: closures that agreed with the pose, or did not.
    """

    keyframes: int = 0
    keyframes_until_found: int | None = None
    located: int = 0
    relocalised: int = 0
    agreed: int = 0
    contradicted: int = 0


class LocalizingReplay:
    """Feeds frames to a detector over the places of a map, and closures and odometry to a localizer.

    Args:
        folder: run folder.
        settings: all settings, mode localization.
        detector: made with these settings.

    Attributes:
        counts: so far.

    Raises:
        UmfError: the map has not been solved, or is damaged.
    """

    def __init__(self, folder: Path, settings: Settings, detector: LoopDetector) -> None:
        self._folder = folder
        self._detector = detector
        self._localizer = Localizer(read_poses(Path(settings.map)), settings.pose_graph)
        self._feed = OdometrySessionSplitter(self._localizer)
        self._recorder = RunRecorder(folder, settings, detector.embedder_name)
        self._table = CsvTable(folder / TABLE, COLUMNS)
        self._found: list[Localization] = []
        self.counts = LocalizationCounts()

    def run(self, stream: Iterable[Frame | OdometrySample]) -> Iterator[Detection]:
        """Process a recording's stream, yielding what became of each frame; stop iterating to stop the run.

        Raises:
            OutputError: the disk is full.
        """
        for item in self._detector.prefetch(stream):
            if isinstance(item, OdometrySample):
                self._feed.take(item.stamp_ns, item.odom_T_body)
                continue
            detection = self._detector.process(item)
            self._recorder.record(item, detection)
            for closure in detection.closures:
                self._localizer.add_closure(closure)
            if detection.keyframe is not None:
                self._note()
            yield detection

    @property
    def newest(self) -> Localization | None:
        """Where the rover is now; None while that is unknown."""
        return self._localizer.estimate()

    def graph_counts(self) -> dict[str, int]:
        """Closures that agreed with the map so far, and that did not."""
        counts = self._localizer.counts
        return {"accepted": counts["agreed"], "rejected": counts["contradicted"], "waiting": counts["searching"]}

    def finish(self, drops: Mapping[str, int]) -> bool:
        """Write the summary and the trajectory in the map; returns whether the rover was found."""
        self._recorder.write_summary(drops)
        self._recorder.close()
        self._table.close()
        self._detector.close()
        known: dict[str, Any] = {"localization": asdict(self.counts)}
        write_summary(self._folder, read_summary(self._folder) | known)
        if self._found:
            stamps = np.array([one.stamp_ns for one in self._found], np.int64)
            poses = np.stack([one.map_T_body for one in self._found])
            write_tum(self._folder / "trajectory_in_map.tum", Trajectory(stamps, poses))
        return bool(self._found)

    def _note(self) -> None:
        """Write down where the newest keyframe is."""
        counts, found = self.counts, self._localizer.estimate()
        counts.keyframes += 1
        counts.relocalised = self._localizer.relocalised
        counts.agreed, counts.contradicted = self._localizer.counts["agreed"], self._localizer.counts["contradicted"]
        if found is None:
            return
        counts.located += 1
        if counts.keyframes_until_found is None:
            counts.keyframes_until_found = counts.keyframes
        if self._found and found.stamp_ns <= self._found[-1].stamp_ns:
            return  # its clock was set back
        self._found.append(found)
        numbers = [*found.map_T_body[:3, 3], *to_quaternion(found.map_T_body), *np.sqrt(np.diag(found.covariance))]
        self._table.append([[found.stamp_ns, *(f"{number:.6g}" for number in (*numbers, found.probability))]])
