"""A keyframe as bytes and back, whatever is missing of it."""

from __future__ import annotations

from dataclasses import astuple, fields, replace

import numpy as np
import pytest
from conftest import make_keyframe, unit
from safetensors import SafetensorError
from safetensors.numpy import load, save

from umf_ros.core.frames import Embedding, Keyframe, LocalFeatures, ScanMotion
from umf_ros.places.packing import pack, unpack

GROUPS = ("image", "cloud", "super_image", "super_cloud")


def cloud_features(count: int) -> LocalFeatures:
    rng = np.random.default_rng(4)
    positions = rng.uniform(-20, 20, (count, 3)).astype(np.float32)
    descriptors = rng.standard_normal((count, 8)).astype(np.float16)
    return LocalFeatures(positions, descriptors, rng.random(count).astype(np.float32), positions)


def with_groups(*present: str) -> Keyframe:
    whole = make_keyframe(5, 7.0)
    whole = replace(whole, embedding=replace(whole.embedding, cloud=cloud_features(6)))
    kept = {name: getattr(whole.embedding, name) for name in present}
    return replace(whole, embedding=Embedding(whole.embedding.descriptor, **kept))


@pytest.mark.parametrize("present", [(), ("image",), ("cloud",), ("image", "super_image"), ("image", "cloud")])
def test_modalities_that_are_missing_stay_missing(present: tuple[str, ...]) -> None:
    keyframe = with_groups(*present)
    found = unpack(pack(keyframe)).embedding
    for name in GROUPS:
        ours, theirs = getattr(found, name), getattr(keyframe.embedding, name)
        assert (ours is not None) == (name in present)
        for item in fields(ours) if ours is not None else ():
            np.testing.assert_array_equal(getattr(ours, item.name), getattr(theirs, item.name))
            assert getattr(ours, item.name).dtype == getattr(theirs, item.name).dtype


def test_features_of_an_empty_view_are_empty_and_not_missing() -> None:
    keyframe = with_groups("cloud")
    keyframe = replace(keyframe, embedding=replace(keyframe.embedding, cloud=cloud_features(0)))
    found = unpack(pack(keyframe)).embedding.cloud
    assert found is not None and found.positions.shape == (0, 3) and found.descriptors.dtype == np.float16


def test_stamps_and_poses_keep_every_bit() -> None:
    rng = np.random.default_rng(2)
    pose = rng.standard_normal((4, 4))
    poses = {"odom_T_body": pose, "body_T_camera": pose.T, "body_T_lidar": pose}
    keyframe = replace(make_keyframe(0), stamp_ns=2**62 + 1, session=2**40, **poses)
    found = unpack(pack(keyframe))
    assert (found.stamp_ns, found.session) == (2**62 + 1, 2**40)
    np.testing.assert_array_equal(found.odom_T_body, pose)
    np.testing.assert_array_equal(found.body_T_camera, pose.T)  # not contiguous when it was packed
    np.testing.assert_array_equal(found.body_T_lidar, pose)
    assert astuple(found.camera) == astuple(keyframe.camera) and isinstance(found.camera.width, int)


def test_the_motion_during_the_scan_is_kept() -> None:
    rng = np.random.default_rng(3)
    motion = ScanMotion(rng.random(20).astype(np.float32), rng.random(6), rng.random(6))
    found = unpack(pack(replace(make_keyframe(0), motion=motion))).motion
    assert found is not None and unpack(pack(make_keyframe(0))).motion is None
    for item in fields(ScanMotion):
        np.testing.assert_array_equal(getattr(found, item.name), getattr(motion, item.name))


def test_a_scan_without_points_is_kept() -> None:
    keyframe = replace(make_keyframe(0), points=np.empty((0, 3), np.float32))
    assert unpack(pack(keyframe)).points.shape == (0, 3)


def test_the_descriptor_is_the_one_that_was_packed() -> None:
    descriptor = unit(np.arange(1, 17))
    found = unpack(pack(make_keyframe(0, descriptor=descriptor))).embedding.descriptor
    np.testing.assert_array_equal(found, descriptor)
    assert found.dtype == np.float32


@pytest.mark.parametrize(
    "lie",
    [
        {"points": np.zeros((5, 2), np.float32)},
        {"points": np.full((5, 3), np.nan, np.float32)},
        {"points": np.float32(3)},
        {"body_T_camera": np.zeros((3, 3))},
        {"body_T_lidar": np.full((4, 4), np.inf)},
        {"odom_T_body": np.zeros(3)},
        {"camera": np.full(7, np.nan)},
    ],
    ids=lambda lie: next(iter(lie)),
)
def test_arrays_that_are_something_else_are_refused(lie: dict[str, np.ndarray]) -> None:
    blob = save(load(pack(make_keyframe(0))) | {name: np.ascontiguousarray(value) for name, value in lie.items()})
    with pytest.raises(ValueError):
        unpack(blob)


@pytest.mark.parametrize("part", [0.0, 0.3, 0.99])
def test_bytes_that_break_off_are_refused(part: float) -> None:
    blob = pack(make_keyframe(0))
    with pytest.raises(SafetensorError):
        unpack(blob[: int(part * len(blob))])
