"""Draw the picture of the README from a run.

python tools/readme_picture.py results/latest --out docs/images/run.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import hsv
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from umf_ros.bags.reader import open_bag
from umf_ros.bags.trajectories import read_ground_truth
from umf_ros.core.geometry import evenly
from umf_ros.runs.reader import FinishedRun, read_run
from umf_ros.runs.run_file import read_inliers
from umf_ros.runs.scene import error_curves, read_pictures, size_of
from umf_ros.runs.truth import positions_in_truth
from umf_ros.sensors.decode import decode_picture

TRUTH, ODOMETRY, OPTIMISED, RIGHT = "#222222", "#e07b00", "#1f6fb4", "#2ca02c"
LINES = 60


def draw(run: FinishedRun, out: Path) -> None:
    """Draw the trajectory with closures, one match, and the error along the path."""
    figure = Figure(figsize=(11, 5.6), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=[1, 1.35], height_ratios=[1.25, 1])
    above, match, error = (figure.add_subplot(grid[place]) for place in ((slice(None), 0), (0, 1), (1, 1)))
    if run.truth is not None:
        above.plot(*run.truth.poses[:, :2, 3].T, color=TRUTH, linewidth=1.8, label="ground truth")
    for name, colour, trajectory in (("odometry", ODOMETRY, run.odometry), ("optimised", OPTIMISED, run.optimized)):
        if trajectory is not None:
            path = positions_in_truth(trajectory, run.truth)
            above.plot(path[:, 0], path[:, 1], color=colour, linewidth=1.8, label=name)
    reference = run.truth or run.optimized
    if reference is not None and run.closures:
        poses, _ = reference.at(np.array([one.endpoints for one in run.closures], np.int64).ravel())
        lines = poses[:, :2, 3].reshape(-1, 2, 2)
        above.add_collection(LineCollection(lines.tolist(), colors=RIGHT, linewidths=0.8, alpha=0.7))
        above.plot([], [], color=RIGHT, label=f"{len(run.closures)} closures")
    above.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title="Trajectory and closures")
    above.legend(loc="best", fontsize=9)
    draw_match(match, run)
    for (name, (path_m, off_m)), colour in zip(error_curves(run).items(), (ODOMETRY, OPTIMISED), strict=False):
        error.plot(path_m, off_m, color=colour, linewidth=1.8, label=name)
    error.set(xlabel="path length [m]", ylabel="error [m]", ylim=(0, None), title="Error, aligned at the first pose")
    error.grid(alpha=0.3)
    error.legend(loc="upper left", fontsize=9)
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=100)


def draw_match(axes: Axes, run: FinishedRun) -> None:
    """Both images of a closure in the middle of the run, side by side and joined at the inliers."""
    axes.set_axis_off()
    inliers = read_inliers(run.folder / "inliers.csv")
    keys = [one.endpoints for one in run.closures if one.endpoints in inliers]
    if not keys:
        return
    key = keys[len(keys) // 2]
    pictures, _ = read_pictures(run.folder, key, None)
    images = [decode_picture(pictures[stamp].jpeg) for stamp in key]
    if any(image is None for image in images):
        return
    axes.imshow(np.hstack(images), cmap="gray")
    closure = next(one for one in run.closures if one.endpoints == key)
    shift_m, turn_deg = size_of(closure.match_T_query)
    axes.set_title(f"A closure over {shift_m:.2f} m and {turn_deg:.1f} deg, probability {closure.probability:.3f}")
    scale, lines = images[0].shape[1] / pictures[key[0]].width, inliers[key]
    ends = scale * lines[evenly(len(lines), LINES)].reshape(-1, 2, 2) + [[0, 0], [images[0].shape[1], 0]]
    axes.add_collection(
        LineCollection(ends.tolist(), colors=[hsv(i / LINES) for i in range(len(ends))], linewidths=0.7)
    )


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path, default=Path("docs/images/run.png"))
    given = parser.parse_args()
    bag = open_bag(read_run(given.run).summary["recording"]["path"])
    draw(read_run(given.run, bag, read_ground_truth(bag)), given.out)


if __name__ == "__main__":
    main()
