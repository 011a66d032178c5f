"""A drive as a bag on S3LI's topics."""

from __future__ import annotations

import heapq
import json
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from umf_ros.core.errors import writing
from umf_ros.core.trajectory import Trajectory, write_tum
from umf_ros.lab.simulation import motion_sensors
from umf_ros.lab.simulation.bag_writer import (
    BagWriter,
    camera_info_message,
    cloud_message,
    fix_message,
    image_message,
    imu_message,
    odometry_message,
    pose_message,
)
from umf_ros.lab.simulation.camera import Rendering
from umf_ros.lab.simulation.lidar import PERIOD_NS
from umf_ros.lab.simulation.pool import ahead
from umf_ros.lab.simulation.simulator import START_NS, Simulator, stamp_ns

Event = tuple[int, int, str, Any]
"""Time of recording in ns, rank of its stream, topic and message."""

CLOUD_TOPIC = "/bf_lidar/points_raw"
_IMAGE_DELAY_NS, _CLOUD_DELAY_NS, _ODOMETRY_DELAY_NS = 9_000_000, 4_000_000, 2_000_000


def record(
    simulator: Simulator,
    bag: BagWriter,
    workers: int = 2,
    truth: bool = False,
    progress: Callable[[int], None] = lambda done: None,
) -> None:
    """Simulate a drive into a bag; the bytes do not depend on the number of workers.

    Args:
        simulator: the drive.
        bag: what to write to.
        workers: threads that render.
        truth: add depth (32FC1, m), semantic (mono8) and instance (32SC1) maps of the left image.
        progress: called with the number of scans done.

    Raises:
        OutputError: the bag cannot be written; nothing is left of it.
    """
    bag.note("simulation", describe(simulator))
    with ThreadPoolExecutor(workers) as pool:
        done = 0
        for log_ns, _, topic, message in heapq.merge(*_streams(simulator, pool, truth), key=lambda event: event[:2]):
            bag.write(topic, message, log_ns)
            if topic == CLOUD_TOPIC:
                done += 1
                progress(done)


def write_side_files(simulator: Simulator, bag: Path) -> None:
    """Write what S3LI keeps beside its bags: the odometry as a TUM file, the positions as an RTKLIB `.pos` file.

    Raises:
        OutputError: a file cannot be written.
    """
    run = simulator.odometry
    stamps = np.array([stamp_ns(time_s) for time_s in run.times_s], np.int64)
    write_tum(bag.with_suffix(".odometry.tum"), Trajectory(stamps, run.poses))
    text = motion_sensors.rtklib_text(
        motion_sensors.measure_gnss(simulator.motion, simulator.duration_s, simulator.seed), START_NS
    )
    with writing(bag.with_suffix(".pos")):
        bag.with_suffix(".pos").write_text(text, encoding="ascii")


def describe(simulator: Simulator) -> dict[str, str]:
    """What was simulated, as text; the legs are labels with first and last metre and stamp."""
    legs = [
        {
            "label": label,
            "from_m": round(start, 1),
            "to_m": round(end, 1),
            "from_ns": stamp_ns(simulator.motion.reached(start)),
            "to_ns": stamp_ns(simulator.motion.reached(end)),
        }
        for label, start, end in simulator.route.legs()
    ]
    world = simulator.world
    return {
        "seed": str(simulator.seed),
        "family": world.family,
        "aliasing": str(world.aliasing),
        "legs": json.dumps(legs),
        "drift": json.dumps(asdict(simulator.preset.drift)),
    }


def _streams(simulator: Simulator, pool: ThreadPoolExecutor, truth: bool) -> list[Iterator[Event]]:
    return [
        _images(simulator, pool, truth),
        _clouds(simulator, pool),
        _imu(simulator),
        _odometry(simulator),
        _ground_truth(simulator),
        _fixes(simulator),
    ]


def _images(simulator: Simulator, pool: ThreadPoolExecutor, truth: bool) -> Iterator[Event]:
    layout, camera = simulator.preset.layout, simulator.calibration.camera
    pairs = ahead(pool, simulator.stereo, simulator.exposures)
    for exposure, pair in zip(simulator.exposures, pairs, strict=True):
        stamp, log_ns = exposure.stamp_ns, exposure.stamp_ns + _IMAGE_DELAY_NS
        for side, picture in enumerate(pair):
            if picture is None:
                continue
            frame = ("left_camera", "right_camera")[side]
            image = simulator.published(picture)
            yield log_ns, 0, layout.images[side], image_message(image, stamp, frame, layout.encoding)
            if layout.infos:
                yield log_ns, 0, layout.infos[side], camera_info_message(camera, stamp, frame, right=side == 1)
        if truth:
            yield from _maps(pair[0], stamp, log_ns)


def _maps(picture: Rendering, stamp: int, log_ns: int) -> Iterator[Event]:
    for name, values, encoding in (
        ("depth", picture.depth, "32FC1"),
        ("semantic", picture.semantic, "mono8"),
        ("instance", picture.instance, "32SC1"),
    ):
        yield log_ns, 0, f"/ground_truth/{name}", image_message(values, stamp, "left_camera", encoding)


def _clouds(simulator: Simulator, pool: ThreadPoolExecutor) -> Iterator[Event]:
    scans = ahead(pool, simulator.scan, range(len(simulator.scan_stamps_ns)))
    for stamp, scan in zip(simulator.scan_stamps_ns, scans, strict=True):
        arrives = int(stamp) + PERIOD_NS + _CLOUD_DELAY_NS
        yield arrives, 1, CLOUD_TOPIC, cloud_message(scan, int(stamp))


def _imu(simulator: Simulator) -> Iterator[Event]:
    data = motion_sensors.measure_imu(
        simulator.motion, simulator.calibration.body_T_imu, simulator.duration_s, simulator.seed
    )
    for time_s, rate, force in zip(data.times_s, data.rate, data.force, strict=True):
        stamp = stamp_ns(time_s)
        yield stamp, 2, "/imu/data", imu_message(rate, force, stamp)


def _odometry(simulator: Simulator) -> Iterator[Event]:
    run = simulator.odometry
    for time_s, pose, twist, deviations in zip(run.times_s, run.poses, run.twists, run.deviations, strict=True):
        stamp = stamp_ns(time_s)
        message = odometry_message(pose, twist, deviations, stamp, ("odom", "base_link"))
        yield stamp + _ODOMETRY_DELAY_NS, 3, "/odom", message


def _ground_truth(simulator: Simulator) -> Iterator[Event]:
    times = simulator.odometry.times_s
    for time_s, pose in zip(times, simulator.motion.poses(times), strict=True):
        stamp = stamp_ns(time_s)
        yield stamp, 4, "/ground_truth/pose", pose_message(pose, stamp, "world")


def _fixes(simulator: Simulator) -> Iterator[Event]:
    track = motion_sensors.measure_gnss(simulator.motion, simulator.duration_s, simulator.seed)
    for time_s, geodetic, deviation in zip(track.times_s, track.geodetic, track.deviation_m, strict=True):
        stamp = stamp_ns(time_s)
        yield stamp, 5, "/gnss/fix", fix_message(geodetic, float(deviation), stamp)
