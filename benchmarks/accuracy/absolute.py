"""Accuracy of a map with absolute measurements, right ones and wrong ones.

`python benchmarks/accuracy/absolute.py [--seed N] [--quick] [--json FILE]`

A drive of 1.5 km (0.5 km with `--quick`) with odometry that is off by 1 to 2 % at the end and one revisit there. Error
of the trajectory (ATE: root mean square of the positions, after one rigid alignment) with ever more sources: odometry,
closures, gravity, an elevation model with a start pose, GNSS with 20 % of its fixes lying; and with one source alone.
Then each source is wrong as a whole: `worse` is the error by that without it. `wrong_believed` counts measurements
that are accepted at the end and wrong by more than five of their stated sigmas.
"""

from __future__ import annotations

import tempfile
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from umf_ros.absolute.measurement import AbsoluteMeasurement, Aid
from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.frames import State
from umf_ros.core.geometry import Array, heading
from umf_ros.lab.program import parser_of, write_figures
from umf_ros.lab.simulation.pose_graphs import PERIOD_NS, AbsoluteWorld, open_ground
from umf_ros.pose_graph.backend import PoseGraph
from umf_ros.runs.truth import absolute_trajectory_error

FIRST_SEED = 20_000
# of odometry that is off by 1 to 2 % after 1.5 km, and a pose per second
ODOMETRY = {"odometry_sigma_m": 0.03, "odometry_sigma_deg": 0.1, "max_gap_s": 1.5, "keyframe_spacing_m": 0.5}
ALL = (Aid.GRAVITY, Aid.ELEVATION, Aid.GNSS)


class Drive:
    """One world, driven with some of its sources; figures by the name of the run."""

    def __init__(self, world: AbsoluteWorld, folder: Path) -> None:
        self._world, self._folder = world, folder
        self.model = self._write("right", world.heights)

    def _write(self, name: str, heights: Array) -> str:
        path = self._folder / f"{name}.asc"
        replace(self._world, heights=heights).write_heights(path)
        return str(path)

    def wrong_model(self, seed: int) -> str:
        """The model of another place."""
        other = open_ground(seed + 500, 500.0, 0.0, self._world.cell_m).heights
        shape = self._world.heights.shape
        repeats = [-(-size // part) for size, part in zip(shape, other.shape, strict=True)]
        tiled = np.tile(np.block([[other, other[:, ::-1]], [other[::-1], other[::-1, ::-1]]]), repeats)
        return self._write("wrong", tiled[: shape[0], : shape[1]])

    def start(self) -> str:
        """Start pose as a person would state it, a little wrong."""
        first = self._world.graph.truth[0]
        return f"{first[0, 3] + 1.5:.2f} {first[1, 3] - 1.5:.2f} {np.degrees(heading(first)) + 1.5:.2f}"

    def run(
        self,
        sources: tuple[Aid, ...],
        closures: bool = True,
        measurements: list[AbsoluteMeasurement] | None = None,
        **settings: Any,
    ) -> tuple[float, int, dict[str, object], Counter[str]]:
        """Error in metres, wrong measurements believed, counts, and reasons of what was not accepted."""
        if Aid.ELEVATION in sources:
            settings = {
                "elevation_model": self.model,
                "elevation_start": self.start(),
                "elevation_sigma_m": 0.3,
                **settings,
            }
        if Aid.GNSS in sources:
            settings = {"origin": " ".join(map(str, self._world.origin)), **settings}
        world, graph = self._world.graph, PoseGraph(PoseGraphSettings(**ODOMETRY | settings))
        waiting = [world.message(row) for row in range(len(world.closures))] if closures else []
        given = [one for one in measurements or self._world.measurements if one.source in sources]
        for k in range(len(world.truth)):
            graph.add_odometry(k * PERIOD_NS, world.odometry[k])
            while given and given[0].stamp_ns <= k * PERIOD_NS:
                graph.add_absolute(given.pop(0))
            while waiting and waiting[0].query_stamp_ns <= k * PERIOD_NS:
                graph.add_closure(waiting.pop(0))
            graph.update()
        graph.settle()
        stamps, poses = graph.trajectory()
        truth = world.truth[stamps // PERIOD_NS][:, :3, 3]
        believed = {(one.source, one.stamp_ns) for one in graph.reference.verdicts() if one.state is State.ACCEPTED}
        lies = [
            (one.source, one.stamp_ns)
            for one, lie in zip(self._world.measurements, self._world.lies, strict=True)
            if lie and one.source in sources
        ]
        reasons = Counter(
            f"{v.source.value}: {v.reason}" for v in graph.reference.verdicts() if v.state is not State.ACCEPTED
        )
        error = absolute_trajectory_error(poses[:, :3, 3], truth)
        return error, sum(lie in believed for lie in lies), graph.reference.report(), reasons


def altered(world: AbsoluteWorld, source: Aid, **change: Any) -> list[AbsoluteMeasurement]:
    return [replace(one, **change) if one.source is source else one for one in world.measurements]


def tilted(world: AbsoluteWorld, degrees: float) -> list[AbsoluteMeasurement]:
    """The world's measurements by an IMU that is turned on the body."""
    turn = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    return [replace(one, value=turn @ one.value) if one.source is Aid.GRAVITY else one for one in world.measurements]


def measure(seed: int, quick: bool) -> dict[str, Any]:
    world = open_ground(seed, 500.0 if quick else 1500.0)
    figures: dict[str, Any] = {"seed": seed, "wrong_believed": 0}
    with tempfile.TemporaryDirectory() as folder:
        drive = Drive(world, Path(folder))

        def row(name: str, *arguments: Any, **options: Any) -> float:
            began = time.process_time()
            error, wrong, counts, reasons = drive.run(*arguments, **options)
            figures[f"ate_{name}_m"] = round(error, 3)
            figures["wrong_believed"] += wrong
            told = "; ".join(f"{key} {value}" for key, value in counts.items())
            print(
                f"{name:28s} {error:8.3f} m  {time.process_time() - began:5.1f} s  {wrong} wrong believed  {told}",
                flush=True,
            )
            if reasons:
                print(
                    " " * 30 + "; ".join(f"{reason} {number}" for reason, number in reasons.most_common(4)), flush=True
                )
            return error

        def pair(name: str, without: float, *arguments: Any, **options: Any) -> None:
            figures[f"worse_{name}"] = round(row(f"wrong_{name}", *arguments, **options) / without, 3)

        row("odometry", (), closures=False)
        row("closures", ())
        gravity = row("gravity", (Aid.GRAVITY,))
        elevation = row("elevation", (Aid.GRAVITY, Aid.ELEVATION))
        row("gnss", ALL)
        row("elevation_alone", (Aid.ELEVATION,), closures=False)
        gnss_alone = row("gnss_alone", (Aid.GNSS,), closures=False)
        first = world.graph.truth[0]
        far = f"{first[0, 3] + 60:.2f} {first[1, 3] + 40:.2f} {np.degrees(heading(first)) + 40:.2f}"
        pair("model", gravity, (Aid.GRAVITY, Aid.ELEVATION), elevation_model=drive.wrong_model(seed))
        pair("start", gravity, (Aid.GRAVITY, Aid.ELEVATION), elevation_start=far)
        off = world.origin + np.array([0.002, 0.002, 0.0])
        gravity_gnss = row("gravity_gnss", (Aid.GRAVITY, Aid.GNSS))
        pair("origin", gravity_gnss, ALL, origin=" ".join(map(str, off)), elevation_start="")
        lever = altered(world, Aid.GNSS, lever=np.array([1.7, -1.75, 1.1]))
        pair("lever_arm", elevation, ALL, measurements=lever)
        pair("lever_arm_alone", figures["ate_closures_m"], (Aid.GNSS,), measurements=lever)
        pair("gravity", figures["ate_closures_m"], (Aid.GRAVITY,), measurements=tilted(world, 5.0))
        pair("gravity_gnss", gnss_alone, (Aid.GRAVITY, Aid.GNSS), measurements=tilted(world, 5.0))
    return figures


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--seed", type=int, default=FIRST_SEED)
    parser.add_argument("--quick", action="store_true", help="0.5 km instead of 1.5 km")
    arguments = parser.parse_args()
    figures = measure(arguments.seed, arguments.quick)
    write_figures(arguments.json, figures)


if __name__ == "__main__":
    main()
