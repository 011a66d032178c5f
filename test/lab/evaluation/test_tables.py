"""Lists of pairs and the rows of verdicts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from umf_ros.core.errors import ConfigError
from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import from_quaternion, make_pose
from umf_ros.lab.evaluation.comparison import POSE, RESULT_COLUMNS, SIGMA, read_pairs, result_row, view_row
from umf_ros.lab.evaluation.place_views import PlaceView


def listed(folder: Path, text: str) -> Path:
    path = folder / "pairs.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_columns_may_be_absent_empty_or_unknown_and_paths_are_relative(tmp_path: Path) -> None:
    path = listed(
        tmp_path,
        "\ufeffnote,query_scan,match_left, match_scan,query_left\n"
        "x,b.npy,a.png,sub/a.npy,\ny, /abs/b.npy ,,drive.mcap@12.5,c.png\nz,,,,\n",
    )
    pairs = read_pairs(path)
    there = str(tmp_path)
    assert pairs == [
        (PlaceView(f"{there}/sub/a.npy", f"{there}/a.png"), PlaceView(f"{there}/b.npy")),
        (PlaceView(f"{there}/drive.mcap@12.5"), PlaceView("/abs/b.npy", f"{there}/c.png")),
        (PlaceView(), PlaceView()),
    ]
    assert view_row(*pairs[1], tmp_path) == {
        "match_scan": "drive.mcap@12.5",
        "query_scan": "/abs/b.npy",
        "match_left": "",
        "match_right": "",
        "query_left": "c.png",
        "query_right": "",
    }


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "none of the columns match_scan"),
        ("a,b\n1,2\n", "none of the columns match_scan"),
        ("match_scan,query_scan\n", "holds no pair"),
    ],
)
def test_what_is_no_list_of_pairs(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        read_pairs(listed(tmp_path, text))


def test_a_list_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot read"):
        read_pairs(tmp_path / "nowhere.csv")
    (tmp_path / "pairs.csv").write_bytes(b"match_scan\n\xff\xfe\n")
    with pytest.raises(ConfigError, match="no CSV"):
        read_pairs(tmp_path / "pairs.csv")


def test_an_accepted_pair_has_its_pose_and_sigmas() -> None:
    pose = make_pose(Rotation.from_euler("z", 20, degrees=True).as_matrix(), [1.0, -2.0, 0.5])
    covariance = np.diag(np.square([0.1, 0.2, 0.3, 0.01, 0.02, 0.03]))
    closure = LoopClosure(2, 1, pose, covariance, 0.97)
    row = result_row("accepted", 0.8, 41.23, 0.97, closure)
    assert tuple(row) == RESULT_COLUMNS
    assert (row["accepted"], row["reason"], row["probability"], row["milliseconds"]) == (1, "accepted", 0.97, 41.2)
    np.testing.assert_allclose(from_quaternion([row[n] for n in POSE[:3]], [row[n] for n in POSE[3:]]), pose, atol=1e-8)
    assert [row[name] for name in SIGMA] == pytest.approx([0.1, 0.2, 0.3, 0.01, 0.02, 0.03])


def test_others_say_why_and_have_none() -> None:
    rejected = result_row("probability 0.20 is below 0.9", 0.5, 9.0, 0.2)
    failed = result_row("query: cannot read b.npy")
    for row in (rejected, failed):
        assert row["accepted"] == 0 and row["reason"] and tuple(row) == RESULT_COLUMNS
        assert all(row[name] is None for name in (*POSE, *SIGMA))
    assert rejected["probability"] == 0.2 and failed["probability"] is None
