"""`umf simulate` refuses wrong arguments with one clear line and leaves no file."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from typing import get_type_hints

import pytest
from processes import wait_until

from umf_ros.core.errors import OutputError, UmfError
from umf_ros.lab.commands.simulate import command
from umf_ros.lab.simulation.families import FAMILIES
from umf_ros.lab.simulation.presets import PRESETS


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"seed": -1}, "seed -1 is not between"),
        ({"preset": "olympus"}, "unknown preset 'olympus'"),
        ({"family": "venus"}, "unknown family 'venus'"),
        ({"aliasing": 2.0}, "aliasing 2.0 is not between"),
        ({"image_rate": 0.0}, "image rate 0 Hz is not between"),
        ({"duration": 1e9}, "duration 1e\\+09 s is not between"),
    ],
)
def test_impossible_drives(tmp_path, options, line):
    with pytest.raises(UmfError, match=line) as raised:
        command(tmp_path / "drive.mcap", **options)
    assert "\n" not in str(raised.value)
    assert list(tmp_path.iterdir()) == []


def test_the_help_names_every_preset_and_family():
    """They are written out there: what knows them is too heavy for `umf --help`."""
    hints = get_type_hints(command, include_extras=True)
    names = {key: re.findall(r"\w+", hints[key].__metadata__[0].help.split(";")[0]) for key in ("preset", "family")}
    assert set(names["preset"]) - {"or"} == set(PRESETS)
    assert set(names["family"]) - {"or", "random"} == set(FAMILIES) - {"random"}


def test_places_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file" / "drive.mcap", tmp_path / "drive.bag"):
        with pytest.raises(UmfError, match="cannot write"):
            command(out)


@pytest.mark.parametrize("name", ["drive.mcap", "drive.pos"])
def test_nothing_is_overwritten(tmp_path, name):
    (tmp_path / name).write_text("mine")
    with pytest.raises(OutputError, match=f"{name} is there already"):
        command(tmp_path / "drive.mcap", duration=2.0)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]


def test_without_a_place_to_write_it_says_what_is_missing():
    with pytest.raises(UmfError, match=r"OUT\.mcap"):
        command(None)


@pytest.mark.parametrize("worlds", ["5:2", "abc", "-3:2"])
def test_seeds_that_hold_no_world(tmp_path, worlds):
    with pytest.raises(UmfError, match="seeds"):
        command(shards=tmp_path, worlds=worlds)


def test_unknown_sequences(tmp_path):
    with pytest.raises(UmfError, match="etna, thesis"):
        command(shards=tmp_path, sequences="luna")


def test_a_terminated_simulation_leaves_nothing(tmp_path):
    command = [sys.executable, "-m", "umf_ros.cli", "simulate", str(tmp_path / "a.mcap"), "--duration", "60"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        assert wait_until(lambda: any(file.stat().st_size for file in tmp_path.glob(".a.mcap.*")), 120)
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 143
    assert list(tmp_path.iterdir()) == []
