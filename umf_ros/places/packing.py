"""A keyframe as bytes and back, without loss: safetensors holds the arrays."""

from __future__ import annotations

from dataclasses import astuple, fields
from typing import Any

import numpy as np
from safetensors.numpy import load, save

from umf_ros.core.frames import Embedding, Keyframe, LocalFeatures, ScanMotion, StereoCamera, SuperFeatures

MOTION = "motion"
FEATURES: dict[str, type[LocalFeatures] | type[SuperFeatures]] = {
    "image": LocalFeatures,
    "cloud": LocalFeatures,
    "super_image": SuperFeatures,
    "super_cloud": SuperFeatures,
}


_SHAPES = {"points": (3,), "body_T_camera": (4, 4), "body_T_lidar": (4, 4), "odom_T_body": (4, 4)}
"""Ends of the shapes of what geometry is done with."""


def pack(keyframe: Keyframe) -> bytes:
    """All of a keyframe in one safetensors blob."""
    embedding = keyframe.embedding
    arrays: dict[str, Any] = {
        "stamp_session": np.array([keyframe.stamp_ns, keyframe.session], np.int64),
        "camera": np.array(astuple(keyframe.camera), np.float64),
        "body_T_camera": keyframe.body_T_camera,
        "body_T_lidar": keyframe.body_T_lidar,
        "points": keyframe.points,
        "travelled_m": np.array([keyframe.path_length_m]),
        "descriptor": embedding.descriptor,
    }
    if keyframe.odom_T_body is not None:
        arrays["odom_T_body"] = keyframe.odom_T_body
    groups = {group: getattr(embedding, group) for group in FEATURES} | {MOTION: keyframe.motion}
    for group, found in groups.items():
        if found is not None:
            arrays |= {f"{group}.{item.name}": getattr(found, item.name) for item in fields(found)}
    return save({name: np.ascontiguousarray(array) for name, array in arrays.items()})


def unpack(blob: bytes) -> Keyframe:
    """The keyframe that `pack` was given.

    Raises:
        SafetensorError, ValueError, LookupError, TypeError: they are other bytes.
    """
    arrays = load(blob)
    for name, shape in _SHAPES.items():
        found = arrays.get(name)
        if found is not None and (found.shape[-len(shape) :] != shape or not np.isfinite(found).all()):
            raise ValueError(f"{name} is not what it should be")
    stamp_ns, session = (int(number) for number in arrays["stamp_session"])
    width, height, *rest = (float(number) for number in arrays["camera"])
    features = {group: _group(arrays, group, kind) for group, kind in FEATURES.items()}
    return Keyframe(
        stamp_ns=stamp_ns,
        embedding=Embedding(arrays["descriptor"], **features),
        camera=StereoCamera(int(width), int(height), *rest),
        body_T_camera=arrays["body_T_camera"],
        body_T_lidar=arrays["body_T_lidar"],
        points=arrays["points"],
        odom_T_body=arrays.get("odom_T_body"),
        path_length_m=float(arrays["travelled_m"][0]),
        session=session,
        motion=_group(arrays, MOTION, ScanMotion),
    )


def _group(arrays: dict[str, Any], group: str, kind: Any) -> Any:
    names = [item.name for item in fields(kind)]
    if f"{group}.{names[0]}" not in arrays:
        return None
    # an older file has no fields with a default
    return kind(**{name: arrays[f"{group}.{name}"] for name in names if f"{group}.{name}" in arrays})
