"""Closures of a stereo camera alone whose disparities are biased, as by an imprecise rectification.

    python benchmarks/robustness/stereo_bias.py --out results/stereo_bias [--seeds 20001:20006] [--bias 0.5 1.0]

The scans of simulated drives are left out, and the right images are shifted by so many pixels, which lessens all
disparities. Prints closures, the median of their normalised squared errors (5.3 expected) and whether the report tells
the bias.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from umf_ros.bags.presets import settings_for
from umf_ros.bags.reader import open_bag
from umf_ros.core.config import topics_of

sys.path.insert(0, str(Path(__file__).parents[2] / "test"))
from support.planted_faults import Change, Planted, plant


def biased(topics: Any, pixels: float) -> Change:
    """Messages without scans, whose right images lie so many pixels further right."""
    shift = np.array([[1.0, 0.0, pixels], [0.0, 1.0, 0.0]])

    def change(topic: str, message: Any) -> Any:
        if topic == topics.cloud:
            return None
        if topic == topics.right_image:
            image = np.frombuffer(message.data, np.uint8).reshape(message.height, message.step)
            size = message.step, message.height
            moved = cv2.warpAffine(image, shift, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
            message.data = moved.ravel()
        return message

    return change


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results/stereo_bias"))
    parser.add_argument("--seeds", default="20001:20006", help="seeds of the drives, as first:last+1")
    parser.add_argument("--preset", default="demo", help="of umf simulate")
    parser.add_argument("--bias", type=float, nargs="+", default=[0.5, 1.0], help="pixels")
    given = parser.parse_args()
    print("| seed | bias, px | true | false | normalised error squared | told |\n|---|---|---|---|---|---|")
    wrong = untold = 0
    medians: list[float] = []
    for seed in range(*map(int, given.seeds.split(":"))):
        path = given.out / f"{given.preset}_{seed}.mcap"
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            _umf("simulate", str(path), "--preset", given.preset, "--seed", str(seed))
        bag = open_bag(path)
        for pixels in given.bias:
            folder = given.out / f"{seed}_{pixels:g}"
            fault = Planted(f"{pixels:g} px", (), biased(topics_of(settings_for(bag, None, "auto")), pixels))
            _umf("replay", *plant(fault, bag, {}, folder), "--out", str(folder))
            (folder / "planted.mcap").unlink()
            truth = json.loads((folder / "latest" / "summary.json").read_text(encoding="utf-8"))["ground_truth"]
            told = "disparity" in (folder / "latest" / "report.html").read_text(encoding="utf-8").split("<table")[0]
            wrong, untold = wrong + truth["closures_false"], untold + (not told)
            medians.append(truth["nees_median"])
            counts = f"{truth['closures_true']} | {truth['closures_false']}"
            print(f"| {seed} | {pixels:g} | {counts} | {medians[-1]:.1f} | {'yes' if told else 'no'} |", flush=True)
    print(f"\n{wrong} false, median of the medians {np.median(medians):.1f}, bias told in all but {untold}")


def _umf(*arguments: str) -> None:
    command = [sys.executable, "-m", "umf_ros.cli", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"umf {arguments[0]} failed: {done.stderr.strip()}")


if __name__ == "__main__":
    main()
