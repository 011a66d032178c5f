"""Tracking of a recording without odometry, by closures between consecutive keyframes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from umf_ros.core.config import Verification
from umf_ros.core.frames import Candidate, Keyframe, LoopClosure
from umf_ros.runs.run_file import StoredOdometry
from umf_ros.verification import Verifier

_UNKNOWN = np.diag([np.inf] * 6)


def track(keyframes: Iterable[Keyframe], settings: Verification) -> tuple[list[StoredOdometry], list[Keyframe]]:
    """Track a recording without odometry by closures between consecutive keyframes.

    Where two consecutive keyframes have no closure, a new session begins, which other closures have to connect.

    Args:
        keyframes: of one recording, in order, without odometry.
        settings: of the verification of closures.

    Returns:
        The poses, and the keyframes with `odom_T_body`, `path_length_m` and `session`, which counts from 0.
    """
    odometry: list[StoredOdometry] = []
    tracked: list[Keyframe] = []
    pose, path_m, session = np.eye(4), 0.0, 0
    before: Keyframe | None = None
    for keyframe in keyframes:
        closure = None if before is None else _closure(before, keyframe, settings)
        if closure is None:
            session += before is not None
            pose, path_m, covariance = np.eye(4), 0.0, _UNKNOWN
        else:
            step, covariance = closure.match_T_query, closure.covariance
            pose, path_m = pose @ step, path_m + float(np.linalg.norm(step[:3, 3]))
        odometry.append(StoredOdometry(keyframe.stamp_ns, pose, covariance))
        tracked.append(replace(keyframe, odom_T_body=pose, path_length_m=path_m, session=session))
        before = keyframe
    return odometry, tracked


def _closure(before: Keyframe, keyframe: Keyframe, settings: Verification) -> LoopClosure | None:
    """Verify a keyframe against the one before it, alone: earlier closures would need odometry between them."""
    similarity = float(before.embedding.descriptor @ keyframe.embedding.descriptor)
    return Verifier(settings).verify(keyframe, [(Candidate(0, before.stamp_ns, similarity), before)])[0].closure
