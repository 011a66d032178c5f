"""When a frame becomes a keyframe, and from when on a keyframe is the past."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.config import KeyframePolicy, Loop, Settings
from umf_ros.core.frames import Frame
from umf_ros.core.geometry import Array, relative, rotation_angle

Mask = NDArray[np.bool_]

# Odometry noise of a parked rover must not add up to metres: motion counts from this distance on.
COUNTED_STEP_M = 0.05
SHARES = 4
"""A match may be a quarter of the run back, and without odometry a quarter has as many keyframes: by hand."""


def is_past(age_ns: NDArray[np.int64], way_m: Array, rules: Loop, same_session: Mask | bool = True) -> Mask:
    """Whether earlier keyframes are old enough and far enough back to be a place seen again.

    Args:
        age_ns: (...) by how much they are older, ns.
        way_m: (...) metres driven since; where it is unknown (NaN), age alone decides.
        rules: how old and how far back.
        same_session: (...) the way is compared within a session only.
    """
    old = age_ns >= round(rules.min_time_gap_s * 1e9)
    near = way_m < rules.min_travel_m  # False for NaN
    return np.asarray(old & ~(near & same_session), bool)


def gap_remedy(seconds: float, metres: float | None, settings: Settings) -> str:
    """Settings with which a run of this duration has matches that the gap rules allow.

    Args:
        seconds: duration.
        metres: path length, 0 without odometry, None where it is unknown.
        settings: of the run.
    """
    changes = {"loop.min_time_gap_s": (settings.loop.min_time_gap_s, seconds / SHARES)}
    if metres == 0:
        # time alone selects keyframes, too
        for name in ("untracked_period_s", "min_period_s"):
            changes[f"keyframe.{name}"] = getattr(settings.keyframe, name), seconds / (SHARES * SHARES)
    else:
        changes["loop.min_travel_m"] = settings.loop.min_travel_m, metres / SHARES if metres else math.inf
    text = ", ".join(f"{name}: {new:.2g}" for name, (old, new) in changes.items() if new < old)
    if metres is None:
        text += ", loop.min_travel_m: a quarter of the path length"
    return text + (" (or give odometry: --odometry FILE.tum)" if metres == 0 else "")


class KeyframeSelector:
    """Chooses frames by distance, angle and time, and counts the metres driven, of each session by itself.

    With odometry a frame is kept after enough motion; one that is merely late (`max_period_s`) is
    kept only if the rover moved at all, so that a parked rover does not fill the database. Without
    odometry frames are kept every `untracked_period_s`.
    """

    def __init__(self, policy: KeyframePolicy) -> None:
        self._policy = policy
        self.reset()

    def reset(self) -> None:
        """Forget the past, as at the start of a session."""
        self._last: Frame | None = None
        self._counted: Array | None = None
        self._path_length_m = 0.0

    def path_length_m(self, frame: Frame) -> float:
        """Metres driven from the start of the session to `frame`; NaN without odometry."""
        return self._path_length_m if frame.odom_T_body is not None else math.nan

    def select(self, frame: Frame) -> bool:
        """Whether `frame` becomes a keyframe; call once per frame, in order of stamps within a session."""
        if self._last is not None and frame.session != self._last.session:
            self.reset()
        self._count_metres(frame)
        if self._last is not None and not self._is_due(self._last, frame):
            return False
        self._last = frame
        return True

    def _count_metres(self, frame: Frame) -> None:
        if frame.odom_T_body is None:
            return
        if self._counted is None:
            self._counted = frame.odom_T_body
        step = float(np.linalg.norm(frame.odom_T_body[:3, 3] - self._counted[:3, 3]))
        if step >= COUNTED_STEP_M:
            self._path_length_m += step
            self._counted = frame.odom_T_body

    def _is_due(self, last: Frame, frame: Frame) -> bool:
        policy = self._policy
        waited_s = (frame.stamp_ns - last.stamp_ns) * 1e-9
        if waited_s < policy.min_period_s:
            return False
        if frame.odom_T_body is None or last.odom_T_body is None:
            return waited_s >= policy.untracked_period_s
        moved = relative(last.odom_T_body, frame.odom_T_body)
        distance_m = float(np.linalg.norm(moved[:3, 3]))
        angle_deg = math.degrees(rotation_angle(moved))
        if distance_m >= policy.min_translation_m or angle_deg >= policy.min_rotation_deg:
            return True
        return waited_s >= policy.max_period_s and distance_m >= COUNTED_STEP_M
