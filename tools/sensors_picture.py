#!/usr/bin/env python3
"""Draws what camera and LiDAR see on each stretch of a simulated drive: tools/sensors_picture.py BAG OUT.png."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.presets import settings_for
from umf_ros.bags.reader import open_bag
from umf_ros.lab.evaluation.sensors_run import stretches_of

HEIGHT_M = 0.5
"""The colours end so far above and below the mean height."""


def main() -> None:
    """Entry point."""
    bag, out = Path(sys.argv[1]), Path(sys.argv[2])
    stretches = stretches_of(bag)[:-1]
    wanted = [(one.from_ns + one.to_ns) // 2 for one in stretches]
    recording = open_bag(bag)
    frames: list = [None] * len(wanted)
    for frame in FrameReader(recording, settings_for(recording, None, "auto"), warn=lambda text: None):
        for number, moment in enumerate(wanted):
            if frames[number] is None and frame.stamp_ns >= moment:
                frames[number] = frame
        if frames[-1] is not None:
            break
    figure = Figure(figsize=(9.6, 5.4), layout="constrained")
    axes = figure.subplots(2, len(stretches))
    for column, (stretch, frame) in enumerate(zip(stretches, frames, strict=True)):
        axes[0, column].imshow(frame.left[::2, ::2], cmap="gray", vmin=0, vmax=255)
        axes[0, column].set_title(stretch.name, fontsize=11)
        axes[0, column].set_axis_off()
        points = frame.points[np.hypot(frame.points[:, 0], frame.points[:, 1]) < 25][::2]
        height = np.clip(points[:, 2] - np.median(points[:, 2]), -HEIGHT_M, HEIGHT_M)
        axes[1, column].scatter(-points[:, 1], points[:, 0], c=height, s=1, cmap="viridis", vmin=-0.3, vmax=0.3)
        axes[1, column].set_aspect("equal")
        axes[1, column].set_xlim(-14, 14)
        axes[1, column].set_ylim(0, 25)
        axes[1, column].set_xlabel("m")
    axes[1, 0].set_ylabel("scan from above, ahead [m]")
    figure.savefig(out, dpi=90)


if __name__ == "__main__":
    main()
