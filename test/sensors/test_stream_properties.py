"""Properties of sessions and frames that hold for every order of arrival."""

from __future__ import annotations

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from streams import MS, T0, Measurement, S, check_accounts, feed, in_order, rover, same

from umf_ros.core.config import Sync
from umf_ros.sensors.calibration import Calibration
from umf_ros.sensors.sessions import Input, SessionClock, StampedInput
from umf_ros.sensors.synchronizer import Synchronizer

INPUTS: tuple[Input, ...] = ("left", "right", "cloud", "odometry")

delays = st.fixed_dictionaries({name: st.integers(0, 90) for name in INPUTS})
seeds = st.integers(0, 2**32 - 1)
checks = settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])


def arrivals(delays_ms: dict[str, int], seed: int) -> list[Measurement]:
    """Measurements of two seconds; each input in its order, late by its delay and by up to 60 ms of jitter."""
    rng = np.random.default_rng(seed)
    timed = []
    for name, stream in rover(2.0).items():
        late = [stamp + (delays_ms[name] + int(rng.integers(60))) * MS for _, stamp, _ in stream]
        timed += list(zip(np.maximum.accumulate(late), stream, strict=True))
    return [measurement for _, measurement in sorted(timed, key=lambda item: item[0])]


@checks
@given(delays, seeds)
def test_frames_do_not_depend_on_the_order_of_arrival(
    calibration: Calibration, delays: dict[str, int], seed: int
) -> None:
    expected = Synchronizer(Sync(), calibration)
    frames = feed(expected, in_order(rover(2.0))) + expected.flush()
    synchronizer = Synchronizer(Sync(), calibration)
    found = feed(synchronizer, arrivals(delays, seed)) + synchronizer.flush()
    assert len(found) == len(frames) > 0 and all(map(same, found, frames))
    check_accounts(synchronizer)


@checks
@given(seeds, st.integers(1, 40))
def test_every_message_is_counted_when_some_are_twice_or_late(calibration: Calibration, seed: int, wrong: int) -> None:
    rng = np.random.default_rng(seed)
    measurements = in_order(rover(2.0))
    for index in rng.integers(len(measurements), size=wrong):
        measurements.insert(int(rng.integers(len(measurements))), measurements[index])
    synchronizer = Synchronizer(Sync(), calibration)
    frames = feed(synchronizer, measurements) + synchronizer.flush()
    check_accounts(synchronizer)
    assert sum(counter.received for counter in synchronizer.counters.values()) == len(measurements)
    key = [(frame.session, frame.stamp_ns) for frame in frames]
    assert key == sorted(set(key))


@given(st.lists(st.tuples(st.sampled_from(INPUTS), st.integers(0, 20_000)), max_size=60))
def test_usable_stamps_of_an_input_rise_within_a_session(messages: list[tuple[Input, int]]) -> None:
    clock = SessionClock()
    newest: dict[tuple[int, Input], int] = {}
    returned = 0
    for name, stamp_ms in messages:
        _, decided = clock.take(StampedInput(name, T0 + stamp_ms * MS, np.eye(4)))
        returned += len(decided)
        for one in decided:
            if not one.fault:
                key = (clock.session, one.name)
                assert one.stamp_ns > newest.get(key, -1)
                newest[key] = one.stamp_ns
    assert returned + len(clock.finish()) == len(messages)


@given(st.integers(1, 3600), st.integers(7, 3600))
def test_two_inputs_set_back_begin_one_session(back_s: int, length_s: int) -> None:
    clock = SessionClock()
    inputs: tuple[Input, ...] = ("left", "cloud")
    for second in (0, length_s):
        for name in inputs:
            clock.take(StampedInput(name, T0 + second * S))
    updates = [clock.take(StampedInput(name, T0 + (length_s - back_s) * S)) for name in inputs]
    assert [reset is not None for reset, _ in updates] == [False, True]
    assert [one.name for one in updates[1][1]] == ["left", "cloud"]
    assert clock.session == 1
