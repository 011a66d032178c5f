"""The page about a map: who is in it, by what, and how it looks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from umf_ros.runs.gallery import data_address
from umf_ros.runs.report import render
from umf_ros.runs.writer import write_atomically


def write_report(folder: Path, summary: dict[str, Any]) -> None:
    """Write `report.html`, that stands alone, from the summary and the pictures in the folder of a map.

    Raises:
        OutputError: the page cannot be written.
    """
    joined, count = summary["joined"], len(summary["sessions"])
    page = render(
        "map.html",
        name=folder.resolve().name,
        sentence=sentence(summary),
        mark="good" if joined == count else "warn",
        sessions=summary["sessions"],
        between=summary["closures_between"],
        within=summary["closures_within"],
        crispness=crispness(summary),
        trajectories=_picture(folder / "trajectories.png"),
        ground=_picture(folder / "map.png"),
    )
    write_atomically(folder / "report.html", page)


def sentence(summary: dict[str, Any]) -> str:
    """What came of a map, in one sentence."""
    between, joined = summary["closures_between"], summary["joined"]
    return (
        f"{joined} of {len(summary['sessions'])} sessions in one frame; closures between them: "
        f"{between['accepted']} of {between['found']} believed"
    )


def crispness(summary: dict[str, Any]) -> str:
    """How crisp the map is; empty where no two sessions meet."""
    thickness = summary["thickness_m"]
    if thickness["after"] is None:
        return ""
    before, after = (f"{100 * thickness[when]:.1f}" for when in ("before", "after"))
    return f"surfaces that several sessions saw are {after} cm thick, by odometry alone {before} cm"


def _picture(path: Path) -> str:
    return data_address("image/png", path.read_bytes()) if path.is_file() else ""
