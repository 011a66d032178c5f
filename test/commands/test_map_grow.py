"""`localization.update` as a user sees it: a drive that leaves the map makes it larger for the next one."""

from __future__ import annotations

import json
from pathlib import Path

from command_line import umf
from recordings import part_of

from umf_ros.maps.map_folder import MapFolder


def located(folder: Path) -> int:
    return int(json.loads((folder / "latest" / "summary.json").read_text())["localization"]["located"])


def test_a_map_that_grew_locates_the_next_drive_as_often_as_a_frozen_one_or_more(
    mini_bag: Path, mini_config: Path, tmp_path: Path
) -> None:
    first = part_of(mini_bag, tmp_path / "first.mcap", 0.0, 8.0)
    second = part_of(mini_bag, tmp_path / "second.mcap", 2.5)  # begins in the map, leaves it and comes back
    third = part_of(mini_bag, tmp_path / "third.mcap", 7.5, 12.5)  # begins where the first drive ended
    out = tmp_path / "map"
    assert umf("map", first, "--config", mini_config, "--out", out).status == 0
    frozen = umf("replay", third, "--config", mini_config, "--map", out, "--out", tmp_path / "frozen")
    assert len(MapFolder.open(out).sessions) == 1, frozen.text
    grows = tmp_path / "grows.yaml"
    inner = "loop: {min_time_gap_s: 8.0, min_travel_m: 15.0}, localization: {update: true}"
    grows.write_text(f"/**: {{ros__parameters: {{{inner}}}}}\n")
    ended = umf("replay", second, "--config", grows, "--map", out, "--out", tmp_path / "second")
    assert ended.status == 0 and "2 of 2 sessions in one frame" in ended.text, ended.text
    folder = MapFolder.open(out)
    assert [one.places for one in folder.sessions][1] > 10
    assert not list((tmp_path / "second" / "latest").glob("places.sqlite*"))
    again = umf("map", "grow", out, tmp_path / "second" / "latest")
    assert again.status == 1 and "holds no places" in again.err and len(MapFolder.open(out).sessions) == 2
    umf("replay", third, "--config", mini_config, "--map", out, "--out", tmp_path / "grown")
    assert located(tmp_path / "grown") >= located(tmp_path / "frozen")
