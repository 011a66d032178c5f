from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from recordings import drive
from scipy.spatial.transform import Rotation
from streams import MS, OFFSET, T0, Measurement, S, check_accounts, feed, in_order, picture, points, rover, same

from umf_ros.core.config import Sync
from umf_ros.core.errors import MessageError
from umf_ros.core.frames import Frame, StereoCamera
from umf_ros.core.geometry import invert, make_pose, transform
from umf_ros.sensors.calibration import Calibration
from umf_ros.sensors.decode import Cloud
from umf_ros.sensors.synchronizer import INPUTS, Synchronizer


def test_one_frame_per_scan_with_the_nearest_image_and_its_own_right_one(calibration: Calibration) -> None:
    streams = rover()
    synchronizer = Synchronizer(Sync(), calibration)
    frames = feed(synchronizer, in_order(streams)) + synchronizer.flush()
    assert [frame.stamp_ns for frame in frames] == [stamp + OFFSET for _, stamp, _ in streams["cloud"]]
    lefts = {stamp: value for _, stamp, value in streams["left"]}
    rights = {stamp: value for _, stamp, value in streams["right"]}
    for frame in frames:
        assert frame.image_stamp_ns == min(lefts, key=lambda stamp: abs(stamp - frame.stamp_ns))
        assert frame.left is lefts[frame.image_stamp_ns]
        assert frame.right is rights.get(frame.image_stamp_ns)
    assert sum(frame.right is None for frame in frames) > 0
    assert synchronizer.counters["cloud"].used == len(frames)
    assert synchronizer.counters["left"].lost == 0
    check_accounts(synchronizer)


def test_right_image_within_half_a_period_is_taken_when_stamps_differ(calibration: Calibration) -> None:
    def right_of(shift_ms: int) -> np.ndarray | None:
        synchronizer = Synchronizer(Sync(), calibration, {"left", "right", "cloud"})
        right = ("right", T0 + shift_ms * MS, picture(2))
        arrivals = [("left", T0, picture(1)), ("cloud", T0 - OFFSET, points()), right]
        return (feed(synchronizer, arrivals) + synchronizer.flush())[0].right

    assert right_of(16) is not None and right_of(-16) is not None
    assert right_of(18) is None and right_of(-18) is None


def test_odometry_is_interpolated_at_the_key(calibration: Calibration) -> None:
    synchronizer = Synchronizer(Sync(), calibration)
    frames = feed(synchronizer, in_order(rover()))
    for frame in frames:
        assert frame.odom_T_body is not None
        assert np.allclose(frame.odom_T_body, drive((frame.stamp_ns - T0) / S), atol=1e-3)


def test_a_wall_scanned_on_the_drive_is_where_it_is(calibration: Calibration, rng: np.random.Generator) -> None:
    world = rng.uniform((2, -5, 0), (12, 5, 3), (500, 3))
    scan_start = 3 * S
    offsets = np.sort(rng.integers(0, 200 * MS, 500))
    seen = [
        transform(invert(drive((scan_start + offset) / S) @ calibration.body_T_lidar), point[None])[0]
        for point, offset in zip(world, offsets, strict=True)
    ]
    cloud = Cloud(np.array(seen, np.float32), np.full(500, 50, np.float32), offsets)
    streams = rover(6.0)
    streams["cloud"] = [("cloud", T0 + scan_start, cloud)]
    synchronizer = Synchronizer(Sync(), calibration)
    frame = (feed(synchronizer, in_order(streams)) + synchronizer.flush())[0]
    truth = transform(invert(drive((scan_start + OFFSET) / S)), world)
    assert frame.points is not None
    assert np.abs(frame.points - truth).max() < 0.005
    skewed = transform(calibration.body_T_lidar, cloud.points)
    assert np.abs(skewed - truth).max() > 0.1


def test_without_odometry_the_scan_stays_as_it_is(calibration: Calibration) -> None:
    streams = rover(2.0)
    del streams["odometry"]
    frames = feed(Synchronizer(Sync(), calibration, {"left", "right", "cloud"}), in_order(streams))
    for frame, (_, _, cloud) in zip(frames, streams["cloud"], strict=False):
        assert frame.odom_T_body is None
        assert np.array_equal(frame.points, transform(calibration.body_T_lidar, cloud.points))
        assert np.array_equal(frame.body_T_camera, calibration.body_T_camera)


def test_camera_pose_makes_up_for_the_time_since_the_exposure(calibration: Calibration) -> None:
    frames = feed(Synchronizer(Sync(), calibration), in_order(rover()))
    for frame in frames:
        assert frame.image_stamp_ns is not None
        exposed, key = ((stamp - T0) / S for stamp in (frame.image_stamp_ns, frame.stamp_ns))
        truth = invert(drive(key)) @ drive(exposed) @ calibration.body_T_camera
        assert np.allclose(frame.body_T_camera, truth, atol=2e-3)
    assert any(not np.allclose(frame.body_T_camera, calibration.body_T_camera, atol=5e-3) for frame in frames)


def test_weak_and_high_returns_are_dropped(calibration: Calibration) -> None:
    xyz = np.array([[0, 5, 0], [0, 5, 21], [0, 5, -21], [0, 6, 0]], np.float32)
    cloud = Cloud(xyz, np.array([16, 90, 90, 15], np.float32))
    synchronizer = Synchronizer(Sync(), calibration, {"cloud"})
    frame = feed(synchronizer, [("cloud", T0, cloud)])[0]
    assert frame.intensity is not None and frame.intensity.tolist() == [16]
    assert np.array_equal(frame.points, transform(calibration.body_T_lidar, xyz[:1]))


@pytest.mark.parametrize("seed", range(5))
def test_interleaving_of_arrivals_changes_nothing(seed: int, calibration: Calibration) -> None:
    streams = rover()
    reference = Synchronizer(Sync(), calibration)
    expected = feed(reference, in_order(streams)) + reference.flush()
    rng = np.random.default_rng(seed)
    arrivals: list[tuple[float, Measurement]] = []
    for stream in streams.values():
        delays = np.maximum.accumulate(np.array([one[1] - T0 for one in stream]) + rng.uniform(0, 0.4 * S, len(stream)))
        lag = rng.uniform(0, 0.5 * S)
        arrivals += [(delay + lag, item) for delay, item in zip(delays, stream, strict=True)]
    shuffled = [item for _, item in sorted(arrivals, key=lambda arrival: arrival[0])]
    assert shuffled != in_order(streams)
    synchronizer = Synchronizer(Sync(), calibration)
    frames = feed(synchronizer, shuffled) + synchronizer.flush()
    assert len(frames) == len(expected)
    assert all(same(a, b) for a, b in zip(frames, expected, strict=True))
    assert synchronizer.counters == reference.counters
    check_accounts(synchronizer)


def test_a_scan_waits_until_no_nearer_image_can_come(calibration: Calibration) -> None:
    synchronizer = Synchronizer(Sync(), calibration, {"left", "cloud"})
    early = [("left", T0 - 30 * MS, picture(1)), ("cloud", T0 - OFFSET, points())]
    assert feed(synchronizer, early) == []
    assert synchronizer.counters["cloud"].used == 0
    frame = feed(synchronizer, [("left", T0 + 3 * MS, picture(2))])[0]
    assert frame.image_stamp_ns == T0 + 3 * MS


def test_images_beyond_the_slop_do_not_count(calibration: Calibration) -> None:
    measurements = [
        ("left", T0 - 51 * MS, picture()),
        ("cloud", T0 - OFFSET, points()),
        ("left", T0 + 51 * MS, picture()),
    ]
    frame = feed(Synchronizer(Sync(), calibration, {"left", "cloud"}), measurements)[0]
    assert frame.left is None and frame.image_stamp_ns is None
    strict = Synchronizer(Sync(require_image=True), calibration, {"left", "cloud"})
    assert feed(strict, measurements) + strict.flush() == []
    assert strict.counters["cloud"].dropped == {"no image": 1}
    check_accounts(strict)


@pytest.mark.parametrize("name", ["left", "right", "odometry"])
def test_an_input_that_dies_delays_scans_by_stream_time_only(name: str, calibration: Calibration) -> None:
    streams = rover()
    streams[name] = [item for item in streams[name] if item[1] < T0 + 3 * S]
    synchronizer = Synchronizer(Sync(), calibration)
    keys: list[tuple[int, int]] = []
    for item in in_order(streams):
        keys += [(frame.stamp_ns, item[1]) for frame in feed(synchronizer, [item])]
    frames = len(keys) + len(synchronizer.flush())
    assert frames == len(streams["cloud"])
    waited = [now - key for key, now in keys]
    assert max(waited[:10]) < 0.35 * S
    # as long as it may still come, scans wait for it; after five seconds of silence they do not
    early = [now - key for key, now in keys if T0 + 3.5 * S < key < T0 + 6.5 * S]
    late = [now - key for key, now in keys if key > T0 + 9.5 * S]
    assert early and all(S < wait < 1.1 * S for wait in early)
    assert late and max(late) < 0.35 * S
    check_accounts(synchronizer)


def test_an_input_that_never_speaks_costs_no_latency_after_a_while(calibration: Calibration) -> None:
    streams = rover(12.0)
    late_odometry = [item for item in streams["odometry"] if item[1] > T0 + 9 * S]
    synchronizer = Synchronizer(Sync(), calibration, {*INPUTS, "camera_info"})
    waits: dict[int, float] = {}
    frames: list[Frame] = []
    for item in in_order({**streams, "odometry": late_odometry}):
        new = feed(synchronizer, [item])
        waits |= {frame.stamp_ns: (item[1] - frame.stamp_ns) / S for frame in new}
        frames += new
    assert max(wait for stamp, wait in waits.items() if stamp < T0 + 4 * S) > 1
    assert max(wait for stamp, wait in waits.items() if stamp > T0 + 5.5 * S) < 0.2
    # it is used, and waited for, as soon as it speaks
    known = [frame.stamp_ns for frame in frames if frame.odom_T_body is not None]
    assert len(known) > 10 and min(known) < T0 + 9.4 * S


def test_images_that_come_too_late_are_told_from_surplus(calibration: Calibration) -> None:
    synchronizer = Synchronizer(Sync(max_wait_s=0.2), calibration, {"left", "cloud"})
    feed(synchronizer, [("cloud", T0 + i * 200 * MS, points()) for i in range(5)])
    feed(synchronizer, [("left", T0 + OFFSET + i * 200 * MS, picture(i)) for i in range(5)])
    synchronizer.flush()
    assert synchronizer.counters["left"].dropped["late"] == 3
    assert synchronizer.counters["left"].used == 2
    assert synchronizer.counters["left"].lost == 3
    check_accounts(synchronizer)


def test_camera_alone_makes_one_frame_per_image(calibration: Calibration) -> None:
    streams = rover(3.0)
    del streams["cloud"]
    synchronizer = Synchronizer(Sync(), calibration, {"left", "right", "odometry"})
    frames = feed(synchronizer, in_order(streams)) + synchronizer.flush()
    assert [frame.stamp_ns for frame in frames] == [stamp for _, stamp, _ in streams["left"]]
    assert all(frame.points is None and frame.left is not None for frame in frames)
    assert sum(frame.right is not None for frame in frames) == len(streams["right"])
    check_accounts(synchronizer)


def test_neither_image_nor_points_is_no_frame(calibration: Calibration) -> None:
    empty = Cloud(np.empty((0, 3), np.float32), np.empty(0, np.float32))
    alone = Synchronizer(Sync(), calibration, {"cloud"})
    assert feed(alone, [("cloud", T0, empty)]) == []
    assert alone.counters["cloud"].dropped == {"empty": 1}
    with_image = Synchronizer(Sync(), calibration, {"cloud", "left"})
    frame = feed(with_image, [("cloud", T0 - OFFSET, empty), ("left", T0, picture())])[0]
    assert frame.points is None and frame.left is not None


def test_duplicates_and_messages_out_of_order_are_counted_not_used(calibration: Calibration) -> None:
    synchronizer = Synchronizer(Sync(), calibration, {"left", "cloud"})
    feed(synchronizer, [("left", T0, picture(1)), ("left", T0, picture(2)), ("left", T0 - 20 * MS, picture(3))])
    feed(synchronizer, [("cloud", T0 - OFFSET, points())])
    synchronizer.flush()
    assert synchronizer.counters["left"].dropped == {"duplicate": 1, "out of order": 1}
    assert (synchronizer.session, synchronizer.counters["left"].used) == (0, 1)
    check_accounts(synchronizer)


@pytest.mark.parametrize("name", ["left", "odometry", "cloud"])
def test_memory_is_bounded_when_only_one_input_talks(name: str, calibration: Calibration) -> None:
    sync = Sync(queue_size=10, max_wait_s=10, odometry_buffer_s=1)
    synchronizer = Synchronizer(sync, calibration)
    values = {"left": picture(), "odometry": np.eye(4), "cloud": points()}
    held = []
    tracemalloc.start()
    for i in range(1000):
        copied = Cloud(values[name].points.copy()) if name == "cloud" else values[name].copy()
        feed(synchronizer, [(name, T0 + i * 10 * MS, copied)])
        held += [tracemalloc.get_traced_memory()[0]] if i in (499, 999) else []
    tracemalloc.stop()
    assert held[1] - held[0] < 60_000  # 500 messages of odometry that stay take 250,000 bytes
    assert synchronizer.counters[name].received == 1000
    synchronizer.flush()
    check_accounts(synchronizer)


def test_nothing_is_interpolated_across_a_gap_of_the_odometry(calibration: Calibration) -> None:
    streams = rover(6.0)
    streams["odometry"] = [item for item in streams["odometry"] if not T0 + 2 * S < item[1] < T0 + 4 * S]
    frames = feed(Synchronizer(Sync(max_wait_s=5), calibration), in_order(streams))
    known = [frame.stamp_ns for frame in frames if frame.odom_T_body is not None]
    assert all(not T0 + 2 * S < stamp < T0 + 4 * S for stamp in known)
    assert len(known) > 15 and len(frames) > 25


def test_an_image_of_another_size_is_refused_and_counted_once(calibration: Calibration) -> None:
    synchronizer = Synchronizer(Sync(), calibration)
    with pytest.raises(MessageError, match="32 x 24 pixels, the calibration is for 64 x 48") as caught:
        synchronizer.add("left", T0, np.zeros((24, 32), np.uint8))
    synchronizer.reject("left", caught.value.kind)
    assert synchronizer.counters["left"].dropped == {"size": 1}
    check_accounts(synchronizer)


def test_frames_wait_for_the_camera_info_they_shall_use(calibration: Calibration) -> None:
    other = StereoCamera(64, 48, 70.0, 70.0, 31.0, 23.0, 0.3)
    streams = rover(2.0)
    synchronizer = Synchronizer(Sync(), calibration, {*INPUTS, "camera_info"})
    before = in_order(streams)[:40]
    assert feed(synchronizer, before) == []
    synchronizer.use_camera(other)
    frames = feed(synchronizer, in_order(streams)[40:]) + synchronizer.flush()
    assert len(frames) == len(streams["cloud"])
    assert {frame.camera for frame in frames} == {other}
    # one that is useless is not waited for
    synchronizer = Synchronizer(Sync(), calibration, {*INPUTS, "camera_info"})
    synchronizer.reject("camera_info", "camera_info")
    assert feed(synchronizer, in_order(streams))[0].camera == calibration.camera


@pytest.mark.parametrize("from_start", [True, False])
def test_without_a_lidar_that_was_expected_images_become_frames(calibration: Calibration, from_start: bool) -> None:
    streams = rover(14.0)
    streams["cloud"] = [item for item in streams["cloud"] if not from_start and item[1] < T0 + 3 * S]
    synchronizer = Synchronizer(Sync(), calibration)
    frames = feed(synchronizer, in_order(streams)) + synchronizer.flush()
    seen = [frame for frame in frames if frame.points is None]
    assert min(frame.stamp_ns for frame in seen) < T0 + 9 * S and len(seen) > 150
    assert all(frame.left is not None for frame in seen)
    check_accounts(synchronizer)


def test_a_lidar_that_comes_back_is_what_frames_are_built_around_again(calibration: Calibration) -> None:
    streams = rover(16.0)
    streams["cloud"] = [item for item in streams["cloud"] if not T0 + 2 * S < item[1] < T0 + 10 * S]
    synchronizer = Synchronizer(Sync(), calibration)
    frames = feed(synchronizer, in_order(streams)) + synchronizer.flush()
    late = [frame for frame in frames if frame.stamp_ns > T0 + 11 * S]
    assert late and all(frame.points is not None for frame in late)


def whole_scan(count: int = 4000, duration_ns: int = 100 * MS) -> Cloud:
    """A rotation of a room's walls, by azimuth."""
    azimuth = np.linspace(-np.pi, np.pi, count, endpoint=False)
    up = np.tile(np.linspace(-0.25, 0.25, 16), count // 16)
    xyz = 5 * np.stack([np.cos(azimuth) * np.cos(up), np.sin(azimuth) * np.cos(up), np.sin(up)], 1)
    times = np.linspace(0, duration_ns, count, endpoint=False).astype(np.int64)
    return Cloud(xyz.astype(np.float32), np.full(count, 50, np.float32), times)


def cut(cloud: Cloud, count: int, timed: bool, bands: bool) -> list[tuple[int, Cloud]]:
    """Stamps after the scan's, and parts: sectors, or bands of elevation."""
    assert cloud.time_offset_ns is not None and cloud.intensity is not None
    order = np.argsort(cloud.points[:, 2], kind="stable") if bands else np.arange(len(cloud.points))
    parts = []
    for number, rows in enumerate(np.array_split(order, count)):
        start = number * 100 * MS // count
        times = np.linspace(0, 100 * MS // count, len(rows), endpoint=False).astype(np.int64) if timed else None
        parts.append((start, Cloud(cloud.points[rows], cloud.intensity[rows], times)))
    return parts


@pytest.mark.parametrize("timed", [True, False])
@pytest.mark.parametrize("bands", [True, False])
@pytest.mark.parametrize(("count", "every_ms"), [(4, 100), (10, 100), (2, 100), (4, 250)])
def test_scan_parts_are_joined(calibration: Calibration, count: int, every_ms: int, bands: bool, timed: bool) -> None:
    synchronizer = Synchronizer(Sync(), calibration, {"cloud"})
    stream = [
        ("cloud", T0 + scan * every_ms * MS + start, part)
        for scan in range(12)
        for start, part in cut(whole_scan(), count, timed, bands and count < 10)
    ]
    frames = feed(synchronizer, stream) + synchronizer.flush()
    whole = [frame for frame in frames if frame.points is not None and len(frame.points) == 4000]
    assert len(whole) == len(frames) == 12
    if every_ms > 100:  # after a pause a scan begins
        starts = {scan * every_ms * MS for scan in range(12)}
        assert {frame.stamp_ns - OFFSET - T0 for frame in whole} <= starts
    assert synchronizer.counters["cloud"].used == 12 * count
    check_accounts(synchronizer)


def test_a_joined_scan_is_deskewed_by_the_stamps_of_its_parts(calibration: Calibration) -> None:
    synchronizer = Synchronizer(Sync(), calibration, {"cloud", "odometry"})
    poses = [("odometry", T0 + at * 10 * MS, drive(at / 100)) for at in range(-10, 160)]
    parts, truth, begins = [], [], {}
    for start in range(0, 1200 * MS, 100 * MS):
        for after, part in cut(whole_scan(), 4, True, False):
            assert part.time_offset_ns is not None
            begins[T0 + start + after + OFFSET] = sum(map(len, truth))
            parts.append(("cloud", T0 + start + after, part))
            at_s = (start + after + part.time_offset_ns[:, None]) * 1e-9
            truth.append(
                [
                    transform(drive(one) @ calibration.body_T_lidar, point[None])[0]
                    for one, point in zip(at_s[:, 0], part.points, strict=True)
                ]
            )
    frames = feed(synchronizer, in_order({"o": poses, "c": parts})) + synchronizer.flush()
    whole = [frame for frame in frames if frame.points is not None and len(frame.points) == 4000]
    assert len(whole) >= 9
    for frame in whole:
        assert frame.odom_T_body is not None and frame.points is not None
        first = begins[frame.stamp_ns]
        expected = np.concatenate(truth)[first : first + 4000]
        np.testing.assert_allclose(transform(frame.odom_T_body, frame.points), expected, atol=2e-3)


@pytest.mark.parametrize("count", [2, 16])
def test_parts_of_one_stamp_are_joined_and_a_message_twice_is_a_duplicate(calibration: Calibration, count: int) -> None:
    synchronizer = Synchronizer(Sync(), calibration, {"cloud"})
    parts = [part for _, part in cut(whole_scan(), count, True, True)]
    stream = [("cloud", T0 + scan * 200 * MS, part) for scan in range(6) for part in [*parts, parts[-1]]]
    frames = feed(synchronizer, stream) + synchronizer.flush()
    assert [len(frame.points) for frame in frames if frame.points is not None] == [4000] * 6
    assert synchronizer.counters["cloud"].dropped["duplicate"] == 6
    check_accounts(synchronizer)


def test_of_two_whole_scans_with_one_stamp_the_first_is_used(calibration: Calibration) -> None:
    synchronizer = Synchronizer(Sync(), calibration, {"cloud"})
    both = [Cloud(size * whole_scan().points) for size in (1, 1.5)]
    stream = [("cloud", T0 + scan * 200 * MS, cloud) for scan in range(6) for cloud in both]
    frames = feed(synchronizer, stream) + synchronizer.flush()
    assert len(frames) == 6 and synchronizer.counters["cloud"].dropped["duplicate"] == 6


@pytest.mark.parametrize("period_ms", [100, 200, 900])
def test_the_first_scans_wait_with_their_images(calibration: Calibration, period_ms: int) -> None:
    synchronizer = Synchronizer(Sync(), calibration, {"cloud", "left"})
    scans = [("cloud", T0 + at * period_ms * MS - OFFSET, whole_scan()) for at in range(4)]
    images = [("left", T0 + at * 100 * MS, picture(at)) for at in range(3 * period_ms // 100 + 2)]
    frames = feed(synchronizer, in_order({"c": scans, "l": images})) + synchronizer.flush()
    assert [frame.image_stamp_ns for frame in frames] == [T0 + at * period_ms * MS for at in range(4)]


def test_packets_of_the_whole_view_are_joined_by_time(calibration: Calibration, rng: np.random.Generator) -> None:
    synchronizer = Synchronizer(Sync(), calibration, {"cloud"})
    for at in range(100):
        rows = rng.choice(4000, 400, replace=False)
        cloud = whole_scan()
        part = Cloud(cloud.points[rows], None, np.sort(rng.integers(0, 10 * MS, 400)))
        feed_one = synchronizer.add("cloud", T0 + at * 10 * MS, part)
        assert feed_one is None
    frames = synchronizer.pop() + synchronizer.flush()
    counts = [len(frame.points) for frame in frames if frame.points is not None]
    assert counts == [4000] * 10
    check_accounts(synchronizer)


@pytest.mark.parametrize("period_ms", [25, 50, 100, 200])
def test_whole_scans_are_never_joined(calibration: Calibration, period_ms: int) -> None:
    """Not even of a rover that turns by 10 deg between them, nor on another channel of the walls."""
    synchronizer, counts = Synchronizer(Sync(), calibration, {"cloud"}), []
    full = whole_scan()
    for at in range(20):
        turn = Rotation.from_euler("z", 10 * at, degrees=True).as_matrix()
        turned = transform(make_pose(turn, [0, 0, 0]), full.points)
        narrow = np.abs(turned[:, 1]) < turned[:, 0]
        synchronizer.add("cloud", T0 + at * period_ms * MS, Cloud(turned[narrow].astype(np.float32)))
        counts.append(len(synchronizer.pop()))
    assert counts == [0, 0, 3] + 17 * [1]
