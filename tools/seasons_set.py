"""Write two sets of places over seasons from images of CMU Seasons: a park road in April and in October.

git clone https://github.com/SailorBrandon/Reproduction-Robust-Visual-SLAM-Across-Seasons seasons
python tools/seasons_set.py seasons/.git OUT

OUT/left and OUT/right, one for each camera, hold queries, references and truth.csv; `umf evaluate` reads
OUT/places.yaml. Choices are made on the left one; the right one is asked once. The images are for non-commercial use
(for research, under the terms of their authors): they belong in no commit, and nothing is trained on them.

The truth comes from the time of the drive: of 25 pairs of the left camera with 16 or more epipolar inliers (SIFT), 23
lie on one line of times within .13 s, .05 s in the mean, and both cameras share it. Later queries have no such pairs
and are left out.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

COMMIT = "a1935b78f0a16abc8a4e6a91dfe0eea43782173b"
FOLDERS = {"references": "image_matching/images/1024data", "queries": "image_matching/images/1024query"}
CAMERAS = {"left": "_c0_", "right": "_c1_"}
APRIL_S, OCTOBER_S, LAST_S = 1_303_399_012.0, 1_287_504_239.0, 5.0
SCALE, OFFSET_S = 1.0785, 0.4427
SAME_S = 0.25
"""Largest difference of time at the same place; the next image is 0.1 s away."""
ENTRY = "- {{name: seasons_{0}, queries: {0}/queries, references: {0}/references, truth: {0}/truth.csv, kind: image}}\n"


def main(git_dir: str, out: Path) -> None:
    """Write both sets."""

    def git(*arguments: str) -> bytes:
        return subprocess.run(["git", f"--git-dir={git_dir}", *arguments], check=True, stdout=subprocess.PIPE).stdout

    for name, camera in CAMERAS.items():
        chosen = {}
        for part, folder in FOLDERS.items():
            listed = git("ls-tree", "-r", "--name-only", COMMIT, folder).decode().split()
            chosen[part] = [path for path in sorted(listed) if camera in path]
        chosen["queries"] = [path for path in chosen["queries"] if 0 <= _seconds(path) - OCTOBER_S < LAST_S]
        for part, paths in chosen.items():
            (out / name / part).mkdir(parents=True, exist_ok=True)
            for path in paths:
                (out / name / part / Path(path).name).write_bytes(git("show", f"{COMMIT}:{path}"))
        lines = []
        for row, path in enumerate(chosen["queries"]):
            time_s = SCALE * (_seconds(path) - OCTOBER_S) + OFFSET_S + APRIL_S
            same = [number for number, one in enumerate(chosen["references"]) if abs(_seconds(one) - time_s) < SAME_S]
            lines.append(",".join(map(str, [row, *same])) + "\n")
        (out / name / "truth.csv").write_text("".join(lines))
    (out / "places.yaml").write_text("".join(map(ENTRY.format, CAMERAS)))


def _seconds(path: str) -> float:
    """Time of an image by its name, s."""
    return int(path.split("_")[-2].removesuffix("us")) / 1e6


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
