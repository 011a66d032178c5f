"""Odometry that drifts like a wheel or visual odometry does."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from umf_ros.core.geometry import Array, heading
from umf_ros.lab.simulation.motion import Motion


@dataclass(frozen=True, slots=True)
class Drift:
    """How odometry goes wrong; the signs of scale and turn are drawn per run.

    Attributes:
        scale: relative error of the distance driven.
        turn_deg_m: constant error of the heading per metre driven, deg/m.
        walk_deg_sqrt_m: random walk of the heading, deg per square root of a metre.
        height_sqrt_m: random walk of the height, m per square root of a metre.
        tilt_deg: noise of roll and pitch, which gravity keeps from drifting, deg.
    """

    scale: float = 0.01
    turn_deg_m: float = 0.02
    walk_deg_sqrt_m: float = 0.15
    height_sqrt_m: float = 0.005
    tilt_deg: float = 0.03


@dataclass(frozen=True, slots=True)
class Odometry:
    """A run of an odometry.

    Attributes:
        times_s: (N,) s.
        poses: (N, 4, 4) `odom_T_body`; starts at the origin with heading 0.
        twists: (N, 6) linear m/s and angular rad/s velocity, body frame.
        deviations: (N, 2) standard deviation of the position (m) and of the heading (rad).
    """

    times_s: Array
    poses: Array
    twists: Array
    deviations: Array


def drifting(motion: Motion, drift: Drift, times: Array, seed: int) -> Odometry:
    """Odometry of a motion at (N,) times, s."""
    rng = np.random.default_rng([seed, 7])
    truth = motion.poses(times)
    steps = np.diff(truth[:, :3, 3], axis=0)
    metres = np.linalg.norm(steps, axis=1)
    scale, turn = rng.choice([-1, 1], 2) * [drift.scale, np.radians(drift.turn_deg_m)]
    walk = np.radians(drift.walk_deg_sqrt_m) * np.sqrt(metres) * rng.standard_normal(len(steps))
    error = np.concatenate([[0], np.cumsum(turn * metres + walk)])
    climb = drift.height_sqrt_m * np.sqrt(metres) * rng.standard_normal(len(steps))
    turned = _about_z(error[:-1] - heading(truth[0]))
    steps = (1 + scale) * np.einsum("nij,nj->ni", turned, steps)
    steps[:, 2] += climb
    poses = truth.copy()
    tilt = np.radians(drift.tilt_deg) * rng.standard_normal((len(times), 2))
    poses[:, :3, :3] = _about_z(error - heading(truth[0])) @ truth[:, :3, :3] @ _small_tilt(tilt)
    poses[:, :3, 3] = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    linear = np.einsum("nji,nj->ni", truth[:, :3, :3], motion.velocity(times)) * (1 + scale)
    return Odometry(times, poses, np.hstack([linear, motion.angular(times)]), _deviations(drift, metres))


def _deviations(drift: Drift, metres: Array) -> Array:
    """What an honest odometry would say of its own error."""
    driven = np.concatenate([[0], np.cumsum(metres)])
    turn = np.radians(drift.turn_deg_m) * driven + np.radians(drift.walk_deg_sqrt_m) * np.sqrt(driven)
    return np.stack([0.01 + drift.scale * driven + 0.5 * turn * driven, 1e-3 + turn], 1)


def _about_z(angle: Array) -> Array:
    turns = np.tile(np.eye(3), (len(angle), 1, 1))
    turns[:, 0, 0] = turns[:, 1, 1] = np.cos(angle)
    turns[:, 1, 0] = np.sin(angle)
    turns[:, 0, 1] = -np.sin(angle)
    return turns


def _small_tilt(tilt: Array) -> Array:
    turns = np.tile(np.eye(3), (len(tilt), 1, 1))
    turns[:, 2, 1], turns[:, 1, 2] = tilt[:, 0], -tilt[:, 0]
    turns[:, 0, 2], turns[:, 2, 0] = tilt[:, 1], -tilt[:, 1]
    left, _, right = np.linalg.svd(turns)
    return left @ right
