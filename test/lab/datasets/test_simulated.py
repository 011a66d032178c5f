"""Shards as samples; and what is no shard."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tiny_worlds import BODY_T_CAMERA, CAMERA, world_arrays

from umf_ros.core.errors import UmfError
from umf_ros.lab.datasets.simulated import SimulatedWorld, WorldFolder


def write(path: Path, **changes: object) -> Path:
    content = world_arrays(6, 5) | changes
    np.savez(path, **{name: value for name, value in content.items() if value is not None})
    return path


def test_a_sample_is_what_the_shard_holds(tmp_path: Path) -> None:
    world, content = SimulatedWorld(write(tmp_path / "world_00005.npz")), world_arrays(6, 5)
    assert (len(world), world.name, world.place) == (6, "world_00005", "world_00005")
    assert (world.setting, world.family, world.seed) == ("hard", "etna", 5)
    sample = world.sample(4)
    assert np.array_equal(sample.image, content["images"][4])
    assert sample.points is not None and sample.points.shape == (2000, 3)  # the padding is gone
    assert sample.points.dtype == sample.intensity.dtype == np.float32
    assert np.array_equal(sample.points, content["points"][4, :2000, :3].astype(np.float32))
    assert np.array_equal(sample.intensity, content["points"][4, :2000, 3].astype(np.float32))
    assert np.array_equal(sample.world_T_body, content["world_T_body"][4])
    assert np.array_equal(sample.body_T_camera, BODY_T_CAMERA)
    assert sample.camera == CAMERA
    assert sample.depth is not None and sample.depth.dtype == np.float32 and (sample.depth == 10).all()


def test_older_shards_lack_some_facts(tmp_path: Path) -> None:
    world = SimulatedWorld(write(tmp_path / "a.npz", depth=None, setting=None, family=None, seed=None))
    assert world.sample(0).depth is None
    assert (world.setting, world.family, world.seed) == ("hard", "", -1)


def test_a_scan_without_a_return_is_empty(tmp_path: Path) -> None:
    points = world_arrays(6, 5)["points"].copy()
    points[2] = np.nan
    sample = SimulatedWorld(write(tmp_path / "a.npz", points=points)).sample(2)
    assert sample.points is not None and sample.points.shape == (0, 3) and len(sample.intensity) == 0


@pytest.mark.parametrize("name", ["images", "points", "pass_index", "body_T_camera", "fx", "width"])
def test_what_is_missing_is_named(tmp_path: Path, name: str) -> None:
    with pytest.raises(UmfError, match=f"not a shard of a simulated world: {name} missing"):
        SimulatedWorld(write(tmp_path / "a.npz", **{name: None}))


def test_samples_that_do_not_add_up_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UmfError, match=r"holds 5 images, 6 points, 6 depth, 6 world_T_body, 6 pass_index"):
        SimulatedWorld(write(tmp_path / "a.npz", images=world_arrays(6, 5)["images"][:5]))


def test_files_that_only_look_like_shards(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    whole = write(tmp_path / "whole.npz").read_bytes()
    with path.open("wb") as stream:
        np.save(stream, np.zeros(3))
    with pytest.raises(UmfError, match="a single array"):
        SimulatedWorld(path)
    for content in (whole[: len(whole) // 2], whole[:-30], b"x" * 500, whole[:1000] + b"\0" * 2000 + whole[3000:], b""):
        path.write_bytes(content)
        with pytest.raises(UmfError, match="cannot read") as raised:
            SimulatedWorld(path)
        assert "\n" not in str(raised.value)
    with pytest.raises(UmfError, match="does not exist"):
        SimulatedWorld(tmp_path / "none.npz")


def test_objects_in_a_shard_are_not_unpickled(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", images=np.array([{"a": 1}], object))
    with pytest.raises(UmfError, match=r"cannot read .*Object arrays"):
        SimulatedWorld(tmp_path / "a.npz")


def test_a_folder_takes_in_what_is_complete_and_new(tmp_path: Path) -> None:
    write(tmp_path / "b.npz")
    write(tmp_path / ".c.npz.77.npz")  # still being written
    (tmp_path / "notes.txt").write_text("")
    folder = WorldFolder(tmp_path)
    assert [world.name for world in folder.refresh()] == ["b"]
    first = folder.worlds[0]
    write(tmp_path / "a.npz")
    assert [world.name for world in folder.refresh()] == ["b", "a"]
    assert folder.worlds[0] is first  # and not read again


def test_a_folder_that_is_none(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "none", tmp_path / "file"):
        with pytest.raises(UmfError, match="is not a folder of simulated worlds"):
            WorldFolder(path)
    assert WorldFolder(tmp_path).refresh() == []
