"""Data sets as YAML files."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from etna import entries, write_pos
from recordings import START_NS, drive, small_settings, traverse, write_mcap, write_ros1
from rosbags.typesys import Stores, get_typestore
from tiny_worlds import world_arrays

from umf_ros.core.config import Settings
from umf_ros.core.errors import ConfigError, UmfError
from umf_ros.core.geometry import heading
from umf_ros.core.trajectory import Trajectory, write_tum
from umf_ros.lab.datasets import listed
from umf_ros.lab.datasets.listed import SequenceList, open_source
from umf_ros.lab.datasets.s3li import read_bag
from umf_ros.sensors.calibration import load_calibration

DOCS = Path(__file__).parents[3] / "docs" / "training.md"


@pytest.fixture(autouse=True)
def settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Settings:
    """The test's recordings have smaller images than their data set."""
    small = small_settings(tmp_path, dataset="s3li-etna")
    monkeypatch.setattr("umf_ros.lab.datasets.s3li.settings_for", lambda *_: small)
    return small


def write_list(path: Path, *sequences: dict[str, object]) -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_text(yaml.safe_dump(list(sequences)), encoding="utf-8")
    return path


def test_a_list_of_worlds_and_a_recording(tmp_path: Path) -> None:
    (tmp_path / "data" / "worlds").mkdir(parents=True)
    np.savez(tmp_path / "data" / "worlds" / "world_00003.npz", **world_arrays())
    bag = write_mcap(tmp_path / "data" / "a.mcap", traverse(4))
    listing = write_list(tmp_path / "data" / "all.yaml", {"worlds": "worlds"}, {"bag": "a.mcap", "spacing_m": 0.5})
    source = open_source(listing)
    assert [sequence.name for sequence in source.refresh()] == ["world_00003", "a"]
    wanted = read_bag(bag, spacing_m=0.5)
    np.testing.assert_array_equal(source.worlds[1].world_T_body, wanted.world_T_body)
    assert len(wanted) > len(read_bag(bag))


def test_a_split_of_etna_as_it_is_published(tmp_path: Path, settings: Settings) -> None:
    """Bags, the satellites' positions in GT, and BASALT's poses of the IMU in Eval."""
    body_T_imu = load_calibration(settings.calibration).body_T_imu
    stamps = START_NS + np.arange(140, dtype=np.int64) * 50_000_000
    poses = np.stack([drive(i * 0.05) for i in range(140)])
    store = get_typestore(Stores.ROS1_NOETIC)
    for name in ("s3li_loops", "s3li_traverse_1"):
        truth, basalt = tmp_path / "s3li" / "GT" / name, tmp_path / "s3li" / "Eval" / "BASALT" / name
        truth.mkdir(parents=True)
        basalt.mkdir(parents=True)
        write_ros1(tmp_path / "s3li" / f"{name}.bag", entries(5, store=store))
        write_pos(truth / "global_lle.pos", 6)
        write_tum(basalt / "trajectory.txt", Trajectory(stamps, poses @ body_T_imu))
    found = SequenceList(write_list(tmp_path / "test.yaml", {"s3li": "s3li", "split": "test"})).worlds
    assert [sequence.name for sequence in found] == ["s3li_loops", "s3li_traverse_1"]
    assert np.degrees(heading(found[0].world_T_body[0])) == pytest.approx(30, abs=5)  # as written, from the odometry
    with pytest.raises(UmfError, match="s3li_traverse_2"):
        SequenceList(write_list(tmp_path / "train.yaml", {"s3li": "s3li", "split": "training"}))


def test_pickles_are_found_beside_the_list(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    shutil.copy(Path(__file__).parent / "data" / "toolkit_pandas2.pkl", tmp_path / "data" / "loops.pkl")
    listing = write_list(tmp_path / "data" / "a.yml", {"toolkit": ["loops.pkl"], "images": "elsewhere"})
    (sequence,) = SequenceList(listing).worlds
    assert len(sequence) == 5
    with pytest.raises(UmfError, match=re.escape(f"nor in {tmp_path / 'data' / 'elsewhere'}")):
        sequence.sample(0)


@pytest.mark.parametrize(
    ("sequences", "word"),
    [
        ({"bag": "a.mcap"}, "expected a list"),
        ([], "expected a list"),
        ([{"folder": "x"}], "entry 1 must name one of worlds, bag, s3li, toolkit, robotcar"),
        ([{"bag": "a.mcap", "worlds": "b"}], "entry 1 must name one of"),
        ([{"worlds": "."}, "a.mcap"], "entry 2 must name one of"),
        ([{"s3li": "x", "split": "validation"}], "entry 1: split: "),
        ([{"bag": "a.mcap", "truth": "b.pos"}], "entry 1: unknown parameter truth"),
        ([{"toolkit": []}], "entry 1: toolkit: "),
        ([{"robotcar": "x", "part": "training"}], "training_queries_baseline.pickle"),
        ([{"worlds": "nowhere"}], "nowhere is not a folder"),
    ],
)
def test_what_is_no_data_set_is_said_in_one_line(tmp_path: Path, sequences: object, word: str) -> None:
    path = tmp_path / "data.yaml"
    path.write_text(yaml.safe_dump(sequences))
    with pytest.raises(UmfError, match=word) as raised:
        open_source(path)
    assert "\n" not in str(raised.value)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot read"):
        open_source(tmp_path / "data.yaml")


def test_the_example_of_the_documentation_is_a_list_of_every_kind(tmp_path: Path) -> None:
    example = re.search(r"```yaml\n(.*?)```", DOCS.read_text(), re.DOTALL)
    assert example
    (tmp_path / "example.yaml").write_text(example.group(1))
    kinds = {type(entry) for entry in listed.entries_of(tmp_path / "example.yaml")}
    assert kinds == set(listed.KINDS.values())
