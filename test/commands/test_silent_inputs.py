"""An input of which nothing arrives: one line that names it, in the command and in the report."""

from __future__ import annotations

from pathlib import Path

import pytest
from command_line import umf
from recordings import CLOUD, LEFT, ODOMETRY, RIGHT, traverse, write_mcap

SAID = {
    LEFT: "no images on /stereo/left/image_rect: running LiDAR-only",
    CLOUD: "no scans on /bf_lidar/points_raw: running camera-only",
    ODOMETRY: "no odometry on /odom: closures only, the pose graph is skipped",
}


@pytest.mark.parametrize("absent", [(LEFT, RIGHT), (CLOUD, ODOMETRY)], ids=str)
def test_every_silent_input_is_one_line(absent: tuple[str, ...], tmp_path: Path) -> None:
    bag = write_mcap(tmp_path / "bag.mcap", [entry for entry in traverse(1.0) if entry[0] not in absent])
    method = "scan_context" if LEFT in absent else "thumbnail"
    ended = umf("replay", bag, "--embedder", method, "--out", tmp_path / "out")
    page = (tmp_path / "out" / "latest" / "report.html").read_text("utf-8")
    for topic, line in SAID.items():
        assert ended.text.count(line) == (1 if topic in absent else 0), ended.text
        assert (line[1:] in page) == (topic in absent)
        if topic in absent:  # before the run, not after hours of it
            assert ended.text.index(line) < ended.text.index("keyframes ")
