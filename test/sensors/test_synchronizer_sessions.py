"""Recordings that start again, odometry that is reset, clocks that jump."""

from __future__ import annotations

import numpy as np
import pytest
from streams import T0, S, check_accounts, feed, in_order, rover, same

from umf_ros.core.config import Sync
from umf_ros.sensors.calibration import Calibration
from umf_ros.sensors.sessions import CONFIRMING
from umf_ros.sensors.synchronizer import Synchronizer


def test_a_recording_that_starts_again_is_a_new_session(calibration: Calibration) -> None:
    once = in_order(rover(4.0))
    synchronizer = Synchronizer(Sync(), calibration)
    first = feed(synchronizer, once)
    second = feed(synchronizer, once)
    # the jump completed what was waiting; it comes out first
    ending = [frame for frame in second if frame.session == 0]
    second = [frame for frame in second if frame.session == 1] + synchronizer.flush()
    whole = first + ending
    assert len(whole) == len(second) == int(4.0 * 4.7)
    assert synchronizer.session == 1
    fields = [(frame.stamp_ns, frame.image_stamp_ns) for frame in whole]
    assert fields == [(frame.stamp_ns, frame.image_stamp_ns) for frame in second]
    assert all(frame.odom_T_body is not None for frame in second[:-1])
    check_accounts(synchronizer)


@pytest.mark.parametrize("name", ["left", "odometry", "cloud"])
def test_one_stamp_that_jumps_back_is_no_restart(calibration: Calibration, name: str) -> None:
    """A sensor that loses its clock for one message, and says the time since it was switched on."""
    streams = rover(6.0)
    plain = feed(Synchronizer(Sync(), calibration), in_order(streams))
    synchronizer = Synchronizer(Sync(), calibration)
    arrivals = in_order(streams)
    for row, stamp in ((150, 12 * S), (300, 15 * S)):
        arrivals.insert(row, (name, stamp, streams[name][0][2]))
    frames = feed(synchronizer, arrivals)
    assert synchronizer.session == 0 and synchronizer.counters[name].dropped["clock jump"] == 2
    assert len(frames) == len(plain) and all(same(a, b) for a, b in zip(frames, plain, strict=True))


def test_odometry_that_is_reset_is_a_new_session_and_costs_nothing_else(calibration: Calibration) -> None:
    streams = rover(6.0)
    away = np.array([[0, -1, 0, 80], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    plain = feed(Synchronizer(Sync(), calibration), in_order(streams))
    streams["odometry"] = [
        (n, stamp, away @ pose if stamp > T0 + 3 * S else pose) for n, stamp, pose in rover(6.0)["odometry"]
    ]
    synchronizer = Synchronizer(Sync(), calibration)
    frames = feed(synchronizer, in_order(streams))
    assert [frame.stamp_ns for frame in frames] == [frame.stamp_ns for frame in plain]
    assert synchronizer.session == 1 and synchronizer.counters["odometry"].dropped.total() == 0
    around = [f for f in frames if f.odom_T_body is None]
    assert len(around) <= 2 and all(abs(frame.stamp_ns - T0 - 3 * S) < 0.5 * S for frame in around)
    for frame, before in zip(frames, plain, strict=True):
        if frame.odom_T_body is not None:
            expected = before.odom_T_body if frame.session == 0 else away @ before.odom_T_body
            assert np.allclose(frame.odom_T_body, expected) and frame.left is before.left


def test_odometry_of_a_computer_whose_clock_runs_ahead_costs_no_image(calibration: Calibration) -> None:
    streams = rover(6.0)
    streams["odometry"] = [(name, stamp + 3 * S, pose) for name, stamp, pose in streams["odometry"]]
    arrivals = sorted(
        (item for stream in streams.values() for item in stream),
        key=lambda item: item[1] - 3 * S * (item[0] == "odometry"),
    )
    synchronizer = Synchronizer(Sync(), calibration)
    frames = feed(synchronizer, arrivals) + synchronizer.flush()
    assert len(frames) == len(streams["cloud"]) and all(frame.left is not None for frame in frames)
    assert synchronizer.counters["left"].lost == 0


def test_stragglers_of_the_session_before_do_not_start_another_one(calibration: Calibration) -> None:
    streams = rover(4.0)
    synchronizer = Synchronizer(Sync(), calibration)
    late_clouds = streams["cloud"][-2:]
    feed(synchronizer, [item for item in in_order(streams) if item not in late_clouds and item[1] < T0 + 3.8 * S])
    feed(synchronizer, streams["left"][:CONFIRMING] + late_clouds)
    frames = feed(synchronizer, in_order({**streams, "left": streams["left"][CONFIRMING:]})) + synchronizer.flush()
    assert synchronizer.session == 1
    assert synchronizer.counters["cloud"].dropped == {"stale": 2}
    assert sum(frame.session == 1 for frame in frames) == len(streams["cloud"])
    check_accounts(synchronizer)
