"""Times of points in the units, types and origins of many drivers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from recordings import START_NS, cloud, scan

from umf_ros.sensors.decode import decode_cloud
from umf_ros.sensors.point_times import TIME_NAMES, PointTimes

S = 10**9
SWEEP_NS = np.linspace(0, 98_000_000, 400).astype(np.int64)
RINGS_NS = SWEEP_NS.reshape(16, 25).T.ravel()
"""Ring by ring: the times of each ring go through the whole sweep."""


def in_halves(stamp: int, records: np.ndarray, name: str) -> Any:
    """A cloud with 64-bit times, which a PointField holds as two of 32 bits."""
    message = cloud(stamp, records.astype([(one, "<f8" if one == name else "<f4") for one in records.dtype.names]))
    message.fields[-1].datatype, message.fields[-1].count = 6, 2
    message.data = np.frombuffer(records.tobytes(), np.uint8)
    return message


def told_and_found(make: Any, kind: str, offsets: np.ndarray = SWEEP_NS, name: str = "t") -> tuple[list[str], Any]:
    """Warnings, and the offsets of the last of five scans, as a topic with this field gives them."""
    told: list[str] = []
    times, found = PointTimes(told.append), None
    for number in range(5):
        stamp = START_NS + number * S // 10
        order = ">" if kind.startswith(">") else "<"
        records = np.zeros(len(offsets), [*((axis, f"{order}f4") for axis in "xyz"), (name, kind)])
        records["x"] = 5
        records[name] = make(offsets, stamp)
        message = cloud(stamp, records) if kind != "<u8" else in_halves(stamp, records, name)
        found = decode_cloud(message, times).time_offset_ns
    return told, found


@pytest.mark.parametrize(
    ("make", "kind", "slack_ns"),
    [
        (lambda o, s: o, "<u4", 0),  # Ouster, Livox
        (lambda o, s: o // 1000, "<u4", 1000),
        (lambda o, s: o // 10**6, "<u2", 10**6),
        (lambda o, s: o * 1e-9, "<f4", 10),  # Velodyne
        (lambda o, s: o * 1e-6, "<f4", 10),
        (lambda o, s: o * 1e-3, "<f4", 10),
        (lambda o, s: o * 1e-3, "<f8", 0),
        (lambda o, s: o.astype(float), "<f8", 0),
        (lambda o, s: o.astype(float), ">f4", 10),
        (lambda o, s: (s + o) * 1e-9, "<f8", 400),  # Hesai
        (lambda o, s: (s + o) * 1e-6, "<f8", 400),
        (lambda o, s: (s + o) * 1e-3, "<f8", 400),
        (lambda o, s: (s + o).astype(float), "<f8", 400),  # Livox for PCL
    ],
)
@pytest.mark.parametrize("offsets", [SWEEP_NS, RINGS_NS, SWEEP_NS - 98_000_000])
def test_the_unit_follows_from_the_span_and_the_stamp(make: Any, kind: str, slack_ns: int, offsets: np.ndarray) -> None:
    if kind.startswith("<u") and offsets.min() < 0 and kind != "<u4":
        kind = kind.replace("u", "i")  # u4 wraps, as drivers cast it
    told, found = told_and_found(make, kind, offsets)
    assert not told
    np.testing.assert_allclose(found, offsets, rtol=0, atol=slack_ns + 1)


@pytest.mark.parametrize("name", TIME_NAMES)
def test_every_usual_name_is_read(name: str) -> None:
    told, found = told_and_found(lambda o, s: o * 1e-6, "<f4", name=name)
    assert not told and np.abs(found - SWEEP_NS).max() < 10


def test_a_counter_that_overflows_within_a_scan_starts_at_the_stamp() -> None:
    told, found = told_and_found(lambda o, s: (o + s - START_NS + 2**32 - 420_000_000) % 2**32, "<u4")
    assert found.tolist() == SWEEP_NS.tolist()
    assert len(told) == 1 and "the first of a scan counts as measured at its stamp" in told[0]


def test_ptp_is_37_s_ahead() -> None:
    told, found = told_and_found(lambda o, s: s + o + 37 * S, "<u8")
    assert found.tolist() == SWEEP_NS.tolist()
    assert not told


def test_another_clock_keeps_the_shape_of_a_scan() -> None:
    told, found = told_and_found(lambda o, s: 5000 + (s - START_NS + o) * 1e-9, "<f8")
    np.testing.assert_allclose(found, SWEEP_NS, atol=2)
    assert len(told) == 1 and "s from the stamps of the scans" in told[0]


@pytest.mark.parametrize(
    ("make", "kind", "text", "known"),
    [
        (lambda o, s: 0 * o, "<f4", "times of points are all equal", True),
        (lambda o, s: 0 * o + s, "<u8", "times of points are all equal", True),
        (lambda o, s: (s + o) * 1e-9, "<f4", "too coarse in float32", False),
        (lambda o, s: o * 1e-9 * np.nan, "<f4", "times of points from nan to nan fit no unit", False),
        (lambda o, s: (s + o) * (o > 0), "<u8", "fit no unit", False),
    ],
)
def test_times_without_use_are_told_in_one_line(make: Any, kind: str, text: str, known: bool) -> None:
    told, found = told_and_found(make, kind)
    assert len(told) == 1 and text in told[0] and told[0].endswith("motion during a scan is not removed")
    assert not found.any() if known else found is None


def test_one_damaged_scan_does_not_change_the_unit() -> None:
    times = PointTimes()
    for number in range(20):
        ticks = (SWEEP_NS // 1000 * (1000 if number == 10 else 1)).astype(np.uint32)
        found = times.offsets_ns(ticks, START_NS + number * S // 10)
        assert found is None if number == 10 else np.abs(found - SWEEP_NS).max() < 1000


def test_a_scan_of_few_returns_does_not_choose_the_unit() -> None:
    times = PointTimes()
    few = times.offsets_ns(np.arange(700_000, 700_020, dtype=np.uint32), START_NS)
    assert few is not None and few.tolist() == list(range(700_000, 700_020))
    decoded = decode_cloud(cloud(START_NS + S, scan(np.full((400, 3), 4.0), duration_ns=S // 10)), times)
    assert decoded.time_offset_ns is not None and decoded.time_offset_ns.max() == S // 10
