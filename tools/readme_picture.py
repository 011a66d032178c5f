"""Draw the picture of the README from a run.

python tools/readme_picture.py results/latest --out docs/images/run.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from umf_ros.bags.reader import open_bag
from umf_ros.runs.reader import FinishedRun, read_run
from umf_ros.runs.report import ODOMETRY, OPTIMISED, RIGHT, TRUTH
from umf_ros.runs.scene import error_curves
from umf_ros.runs.truth import positions_in_truth


def draw(run: FinishedRun, out: Path) -> None:
    """Trajectory with closures, one match, and the error over the way."""
    figure = Figure(figsize=(11, 5.6), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=[1, 1.35], height_ratios=[1.25, 1])
    above, match, error = (figure.add_subplot(grid[place]) for place in ((slice(None), 0), (0, 1), (1, 1)))
    if run.truth is not None:
        above.plot(*run.truth.poses[:, :2, 3].T, color=TRUTH, linewidth=1.8, label="truth")
    for name, colour, trajectory in (("odometry", ODOMETRY, run.odometry), ("optimised", OPTIMISED, run.optimized)):
        if trajectory is not None:
            way = positions_in_truth(trajectory, run.truth)
            above.plot(way[:, 0], way[:, 1], color=colour, linewidth=1.8, label=name)
    reference = run.truth or run.optimized
    if reference is not None and run.closures:
        poses, _ = reference.at(np.array([one.endpoints for one in run.closures], np.int64).ravel())
        lines = poses[:, :2, 3].reshape(-1, 2, 2)
        above.add_collection(LineCollection(lines.tolist(), colors=RIGHT, linewidths=0.8, alpha=0.7))
        above.plot([], [], color=RIGHT, label=f"{len(run.closures)} closures")
    above.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    above.legend(loc="best", fontsize=9)
    pictures = sorted((run.folder / "matches").glob("*.png"))
    if pictures:
        match.imshow(cv2.cvtColor(cv2.imread(str(pictures[len(pictures) // 2])), cv2.COLOR_BGR2RGB))
    match.set_axis_off()
    for (name, (way, off)), colour in zip(error_curves(run).items(), (ODOMETRY, OPTIMISED), strict=False):
        error.plot(way, off, color=colour, linewidth=1.8, label=name)
    error.set(xlabel="way [m]", ylabel="error [m]", ylim=(0, None))
    error.grid(alpha=0.3)
    error.legend(loc="upper left", fontsize=9)
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=100)


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path, default=Path("docs/images/run.png"))
    given = parser.parse_args()
    known = read_run(given.run).summary["recording"]["path"]
    draw(read_run(given.run, open_bag(known)), given.out)


if __name__ == "__main__":
    main()
