"""`umf compare` as a user runs it."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import only_line, umf
from recordings import CALIBRATION
from sources import ROOT, rows_of

from umf_ros.lab.evaluation.comparison import RESULT_COLUMNS, VIEW_COLUMNS, Comparer

NUMBERS = RESULT_COLUMNS[: RESULT_COLUMNS.index("reason")]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(1)
    for name in ("one", "other"):
        np.save(f"{name}.npy", rng.uniform(-20, 20, (3000, 4)).astype(np.float32))
        cv2.imwrite(f"{name}.png", rng.integers(0, 255, (48, 64), np.uint8))
    Path("calibration.yaml").write_text(CALIBRATION, encoding="utf-8")
    return tmp_path


def test_two_moments_of_a_recording_at_one_place(mini_bag: Path, tmp_path: Path) -> None:
    """The rover is at the same place of its loop a lap later: both ways of asking say the same."""
    pair = f"{mini_bag}@2.2", f"{mini_bag}@11.7"
    ended = umf("compare", *pair)
    assert ended.status == 0 and ended.out.startswith("the same place, probability 0.9"), ended.text
    found = json.loads(umf("compare", *pair, "--json").out)
    (tmp_path / "pairs.csv").write_text(f"match_scan,query_scan\n{pair[0]},{pair[1]}\n")
    assert umf("compare", "--list", tmp_path / "pairs.csv", "--out", tmp_path / "verdicts.csv").status == 0
    (row,) = rows_of(tmp_path / "verdicts.csv")
    assert found["accepted"] == 1 == int(row["accepted"])
    assert [float(row[name]) for name in NUMBERS] == [found[name] for name in NUMBERS]
    assert abs(found["x"]) < 2 and 0 < found["sigma_x"] < 1


def test_a_list_goes_on_after_what_cannot_be_read(here: Path) -> None:
    (here / "sub").mkdir()
    (here / "sub" / "pairs.csv").write_text(
        "match_scan,query_scan,query_left,extra\n../one.npy,../other.npy,,1\n../one.npy,nowhere.npy,,2\n"
        "../one.npy,,../one.png,3\n,,,4\n../one.npy,drive.mcap@1,,5\n"
    )
    ended = umf("compare", "--list", "sub/pairs.csv", "--out", "verdicts.csv")
    assert ended.status == 1
    assert [line.split(":")[0] for line in ended.err.splitlines()] == ["pair 2", "pair 4", "pair 5"]
    rows = rows_of(here / "verdicts.csv")
    assert list(rows[0]) == [*VIEW_COLUMNS, *RESULT_COLUMNS]
    assert [row["accepted"] for row in rows] == ["0"] * 5 and all(row["reason"] for row in rows)
    assert rows[0]["match_scan"] == "../one.npy" and float(rows[0]["milliseconds"]) > 0
    assert rows[1]["reason"].startswith("query: cannot read") and rows[1]["milliseconds"] == ""
    assert "5 pairs, 0 the same place, 3 could not be compared" in ended.out


def test_a_defect_costs_one_pair_only(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(self: Comparer, match: object, query: object) -> None:
        raise np.linalg.LinAlgError("singular\nmatrix")

    monkeypatch.setattr("umf_ros.lab.evaluation.comparison.Comparer.compare", fail)
    Path("pairs.csv").write_text("match_scan,query_scan\none.npy,other.npy\none.npy,one.npy\n", encoding="utf-8")
    ended = umf("compare", "--list", "pairs.csv", "--out", "verdicts.csv")
    assert ended.status == 1 and ended.err.splitlines() == [
        "pair 1: LinAlgError: singular matrix",
        "pair 2: LinAlgError: singular matrix",
    ]
    assert len(rows_of(here / "verdicts.csv")) == 2


def test_results_of_an_earlier_list_are_not_touched(here: Path) -> None:
    Path("pairs.csv").write_text("match_scan,query_scan\none.npy,other.npy\n", encoding="utf-8")
    Path("verdicts.csv").write_text("results of another list\n", encoding="utf-8")
    said = only_line(umf("compare", "--list", "pairs.csv", "--out", "verdicts.csv"))
    assert "verdicts.csv exists already" in said
    assert Path("verdicts.csv").read_text(encoding="utf-8") == "results of another list\n"


def test_images_are_named_as_views_or_beside_them(here: Path) -> None:
    alone = umf("compare", "one.png", "other.png", "--calibration", "calibration.yaml")
    named = umf("compare", "--match-left", "one.png", "--query-left", "other.png", "--calibration", "calibration.yaml")
    for ended in (alone, named):
        assert ended.status == 0 and "no depth" in ended.out, ended.text
    assert "no calibration" in umf("compare", "one.png", "other.png").out
    beside = umf("compare", "one.npy", "other.npy", "--match-left", "one.png")
    assert "images beside a scan are not used without a calibration" in beside.err and beside.status == 0


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ([], "MATCH is missing"),
        (["one.npy"], "QUERY is missing"),
        (["one.npy", "nowhere.npy"], "query: cannot read nowhere.npy"),
        (["one.npy", "calibration.yaml"], "calibration.yaml is no cloud of points: expected .pcd, .ply, .npy, .las"),
        (["one.png", "other.png", "--match-left", "one.png"], "are both the left image"),
        (["one.npy", "other.npy", "--out", "v.csv"], "--out VERDICTS.csv goes with --list"),
        (["--list", "pairs.csv"], "--list PAIRS.csv needs --out"),
        (["one.npy", "--list", "pairs.csv", "--out", "v.csv"], "--list PAIRS.csv needs --out"),
        (["--list", "nowhere.csv", "--out", "v.csv"], "cannot read nowhere.csv"),
        (["one.npy", "other.npy", "--calibration", "nowhere.yaml"], "cannot read nowhere.yaml"),
        (["one.npy", "nowhere.mcap@1"], "query: there is no recording nowhere.mcap"),
    ],
)
def test_what_is_wrong_is_one_line(here: Path, arguments: list[str], text: str) -> None:
    assert text in only_line(umf("compare", *arguments))
    assert not (here / "v.csv").exists()


def test_the_command_is_documented() -> None:
    page = (ROOT / "docs" / "compare.md").read_text(encoding="utf-8")
    assert all(f"`{name}" in page for name in ("match_T_query", "accepted", "--bin-columns", "--calibration"))
