"""A recording without odometry, followed from one keyframe to the next by closures between neighbours."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from umf_ros.core.config import Verification
from umf_ros.core.frames import Candidate, Keyframe
from umf_ros.core.geometry import Array
from umf_ros.maps.odometry_log import OdometryLog
from umf_ros.verification import Verifier


def track(keyframes: Iterable[Keyframe], settings: Verification) -> tuple[OdometryLog, list[Keyframe]]:
    """Poses of the keyframes as far as each is found again in the one before, and the keyframes with them.

    Where one is not, its way begins anew: in a session of its own, which other closures have to tie in.

    Args:
        keyframes: of one recording, in order, none of them with odometry.
        settings: how closures are verified.

    Returns:
        The poses, and the keyframes with `odom_T_body`, `travelled_m` and `session`, that counts from 0.
    """
    log = OdometryLog()
    tracked: list[Keyframe] = []
    pose, way_m, session = np.eye(4), 0.0, 0
    for keyframe, found in _linked(keyframes, settings):
        if found is None:
            session += bool(tracked)
            pose, way_m, covariance = np.eye(4), 0.0, None
        else:
            step, covariance = found
            pose, way_m = pose @ step, way_m + float(np.linalg.norm(step[:3, 3]))
        log.append(keyframe.stamp_ns, pose, covariance)
        tracked.append(replace(keyframe, odom_T_body=pose, path_length_m=way_m, session=session))
    return log, tracked


def _linked(
    keyframes: Iterable[Keyframe], settings: Verification
) -> Iterator[tuple[Keyframe, tuple[Array, Array] | None]]:
    """Every keyframe with its pose in the one before and the covariance of that, None where it was not found."""
    before: Keyframe | None = None
    for keyframe in keyframes:
        found = None
        if before is not None:
            similarity = float(before.embedding.descriptor @ keyframe.embedding.descriptor)
            # a memory of earlier finds would need the odometry that there is none of
            verdicts = Verifier(settings).verify(keyframe, [(Candidate(0, before.stamp_ns, similarity), before)])
            closure = verdicts[0].closure
            found = None if closure is None else (closure.match_T_query, closure.covariance)
        yield keyframe, found
        before = keyframe
