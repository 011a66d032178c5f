"""A keyframe as bytes and back, whatever is missing of it."""

from __future__ import annotations

from dataclasses import astuple, fields, replace

import numpy as np
import pytest
from conftest import make_keyframe
from hypothesis import given, settings
from hypothesis.extra.numpy import arrays
from hypothesis.strategies import floats, integers, just, tuples
from safetensors import SafetensorError
from safetensors.numpy import load, save

from umf_ros.core.frames import Embedding, Keyframe, LocalFeatures, ScanMotion
from umf_ros.places.store import pack, unpack

GROUPS = ("image", "cloud")


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


@pytest.mark.parametrize("present", [(), ("image",), ("cloud",), ("image", "cloud")])
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


FLOATS = floats(allow_nan=False, allow_infinity=False)


@settings(max_examples=50, deadline=None)
@given(
    stamp_ns=integers(0, 2**63 - 1),
    session=integers(0, 2**53),
    pose=arrays(np.float64, (4, 4), elements=FLOATS),
    points=arrays(np.float32, tuples(integers(0, 9), just(3)), elements=floats(-1e6, 1e6, width=32)),
    descriptor=arrays(np.float32, integers(1, 40), elements=floats(-1, 1, width=32)),
)
def test_packing_keeps_every_bit(
    stamp_ns: int, session: int, pose: np.ndarray, points: np.ndarray, descriptor: np.ndarray
) -> None:
    poses = {"odom_T_body": pose, "body_T_camera": pose.T, "body_T_lidar": pose}  # one is not contiguous
    keyframe = make_keyframe(0, descriptor=descriptor)
    keyframe = replace(keyframe, stamp_ns=stamp_ns, session=session, points=points, **poses)
    found = unpack(pack(keyframe))
    assert (found.stamp_ns, found.session) == (stamp_ns, session)
    assert astuple(found.camera) == astuple(keyframe.camera) and isinstance(found.camera.width, int)
    kept = [(found.odom_T_body, pose), (found.body_T_camera, pose.T), (found.body_T_lidar, pose)]
    for ours, true in [*kept, (found.points, points), (found.embedding.descriptor, descriptor)]:
        assert ours is not None and ours.dtype == true.dtype
        np.testing.assert_array_equal(ours, true)


def test_the_motion_during_the_scan_is_kept() -> None:
    rng = np.random.default_rng(3)
    motion = ScanMotion(rng.random(20).astype(np.float32), rng.random(6), rng.random(6))
    found = unpack(pack(replace(make_keyframe(0), motion=motion))).motion
    assert found is not None and unpack(pack(make_keyframe(0))).motion is None
    for item in fields(ScanMotion):
        np.testing.assert_array_equal(getattr(found, item.name), getattr(motion, item.name))


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
def test_arrays_of_other_shapes_or_types_are_refused(lie: dict[str, np.ndarray]) -> None:
    blob = save(load(pack(make_keyframe(0))) | {name: np.ascontiguousarray(value) for name, value in lie.items()})
    with pytest.raises(ValueError):
        unpack(blob)


@pytest.mark.parametrize("part", [0.0, 0.3, 0.99])
def test_truncated_bytes_are_refused(part: float) -> None:
    blob = pack(make_keyframe(0))
    with pytest.raises(SafetensorError):
        unpack(blob[: int(part * len(blob))])
