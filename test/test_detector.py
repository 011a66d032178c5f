from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import make_frame, unit
from scipy.spatial.transform import Rotation

from umf_ros.core.config import Settings, load_settings
from umf_ros.core.errors import OutputError
from umf_ros.core.frames import Embedding, Frame
from umf_ros.core.geometry import heading, invert, make_pose, relative, rotation_angle, transform
from umf_ros.detector import NOTHING_METRIC, WITHHELD, Detection, LoopDetector
from umf_ros.verification import RejectReason

LAP_S = 40
RADIUS_M = 8.0


def pose_at(second: float) -> np.ndarray:
    angle = 2 * math.pi * second / LAP_S
    place = [RADIUS_M * math.cos(angle), RADIUS_M * math.sin(angle), 0.3 * math.sin(3 * angle)]
    return make_pose(Rotation.from_euler("z", angle + math.pi / 2).as_matrix(), place)


class TrueEmbedder:
    """Knows the true poses: the whole pipeline runs without a network.

    Random Fourier features of position and heading approximate a Gaussian kernel: similarity is about
    exp(-d^2 / 2 scale^2) for equal headings, near zero for opposite ones.

    Args:
        poses: world_T_body by stamp in ns.
        scale_m: distance at which similarity has fallen to 0.6.
    """

    name, dimension = "true", 2048

    def __init__(self, poses: dict[int, np.ndarray], scale_m: float = 6.0) -> None:
        self._poses = poses
        # a quarter turn counts as much as three times the scale
        widths = np.array([scale_m] * 3 + [0.47] * 2)
        self._frequencies = np.random.default_rng(0).normal(size=(5, self.dimension // 2)) / widths[:, None]

    def embed(self, frame: Frame) -> Embedding:
        pose = self._poses[frame.stamp_ns]
        angle = heading(pose)
        phase = np.concatenate([pose[:3, 3], [np.cos(angle), np.sin(angle)]]) @ self._frequencies
        return Embedding(unit(np.concatenate([np.cos(phase), np.sin(phase)])))


@pytest.mark.parametrize(("metres", "degrees"), [(2.0, 0), (5.0, 0), (9.0, 0), (0.0, 180)])
def test_true_descriptors_fall_with_distance_and_turn(metres: float, degrees: float) -> None:
    turned = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    embedder = TrueEmbedder({0: make_pose(np.eye(3), [10, -4, 1]), 10**9: make_pose(turned, [10 + metres, -4, 1])})
    one, two = (embedder.embed(make_frame(second)).descriptor for second in (0, 1))
    assert one @ two == pytest.approx(np.exp(-(metres**2) / 72) if degrees == 0 else 0, abs=0.1)


@pytest.fixture(scope="module")
def ground() -> np.ndarray:
    """(N, 3) points of a rough hilly ground with boulders, m, world frame."""
    rng = np.random.default_rng(3)
    xy = rng.uniform(-45, 45, (160_000, 2))
    waves = [(0.5, 0.3), (0.3, 0.6), (0.12, 1.2)] * 4
    z = sum(a * np.sin(xy @ rng.normal(0, k, 2) + rng.uniform(0, 6)) for a, k in waves)
    for centre, size in zip(rng.uniform(-40, 40, (150, 2)), rng.uniform(0.3, 1.5, 150), strict=True):
        z += size * np.exp(-((np.linalg.norm(xy - centre, axis=1) / size) ** 2))
    return np.c_[xy, z - 1.5]


def scan_from(ground: np.ndarray, world_T_body: np.ndarray, seed: int) -> np.ndarray:
    """The part that a 70 degree LiDAR sees, thinned with range, with 1 cm noise."""
    rng = np.random.default_rng(seed)
    points = transform(invert(world_T_body), ground)
    reach = np.linalg.norm(points[:, :2], axis=1)
    seen = (np.abs(np.arctan2(points[:, 1], points[:, 0])) < 0.61) & (reach < 35) & (reach > 2)
    seen &= rng.random(len(points)) < np.minimum(1, 8 / np.maximum(reach, 1))
    return (points[seen] + rng.normal(0, 0.01, (seen.sum(), 3))).astype(np.float32)


@pytest.fixture(scope="module")
def frames(ground: np.ndarray) -> list[Frame]:
    made = []
    for i, second in enumerate(np.arange(0, 1.5 * LAP_S, 1.0)):
        pose = pose_at(second)
        points = scan_from(ground, pose, i)
        frame = make_frame(second, odom_T_body=pose)
        made.append(replace(frame, points=points, intensity=np.full(len(points), 100, np.float32)))
    return made


def detector(settings: Settings | None = None) -> LoopDetector:
    truth = {round(second * 1e9): pose_at(second) for second in np.arange(0, 1.5 * LAP_S, 1.0)}
    return LoopDetector(settings or load_settings(), TrueEmbedder(truth))


@pytest.fixture(scope="module")
def detections(frames: list[Frame]) -> list[Detection]:
    found = detector()
    return [found.process(frame) for frame in frames]


def test_a_revisit_becomes_a_metric_closure_without_any_network(detections: list[Detection]) -> None:
    closures = [closure for detection in detections for closure in detection.closures]
    assert len(closures) >= 8
    for closure in closures:
        truth = relative(pose_at(closure.match_stamp_ns * 1e-9), pose_at(closure.query_stamp_ns * 1e-9))
        error = invert(truth) @ closure.match_T_query
        assert np.linalg.norm(error[:3, 3]) < 0.3 and np.degrees(rotation_angle(error)) < 3
        assert closure.query_stamp_ns - closure.match_stamp_ns >= 20e9
        assert closure.probability >= 0.9
        assert (np.linalg.eigvalsh(closure.covariance) > 0).all()


def test_closures_are_withheld_while_the_axes_of_the_odometry_are_impossible(
    ground: np.ndarray, frames: list[Frame], detections: list[Detection], caplog: pytest.LogCaptureFixture
) -> None:
    mirror = np.diag([1.0, -1, 1, 1])
    first = [
        replace(frames[0], points=scan_from(ground, pose_at(s), i), odom_T_body=pose_at(s), stamp_ns=round(s * 1e9))
        for i, s in enumerate(np.arange(0, 8, 0.25))
    ]
    truth = {round(second * 1e9): pose_at(second) for second in np.arange(0, 1.5 * LAP_S, 0.25)}
    drive = [*first, *frames[8:]]
    mirrored = LoopDetector(load_settings(), TrueEmbedder(truth))
    spoilt = [
        replace(one, odom_T_body=mirror @ one.odom_T_body @ mirror) for one in drive if one.odom_T_body is not None
    ]
    verdicts = [verdict for one in spoilt for verdict in mirrored.process(one).verdicts]
    mirrored.close()
    withheld = [one for one in verdicts if one.reason is RejectReason.SENSORS]
    assert len(withheld) >= 8 and not any(one.accepted for one in verdicts)
    assert all("left-handed" in one.outcome for one in withheld)
    said = [record.message for record in caplog.records if WITHHELD in record.message]
    assert 1 <= len(said) <= 2, "said once for each suspect"


def test_the_first_lap_has_nothing_to_close(detections: list[Detection]) -> None:
    assert not any(detection.verdicts for detection in detections[:20])


def test_every_verdict_has_a_reason_and_every_stage_a_time(detections: list[Detection]) -> None:
    last = detections[-1]
    assert last.keyframe is not None and last.verdicts
    assert all(verdict.accepted or verdict.reason for verdict in last.verdicts)
    stages = "embed", "query", "verify", "submaps"
    assert set(last.latency_ms) == {*stages, "total"}
    assert last.latency_ms["total"] == pytest.approx(sum(last.latency_ms[stage] for stage in stages))


def test_closing_twice_is_harmless() -> None:
    found = detector()
    found.close()
    found.close()


def test_a_standing_rover_makes_no_keyframes(frames: list[Frame]) -> None:
    found = detector()
    still = [replace(frames[0], stamp_ns=frames[0].stamp_ns + i * 10**7) for i in range(20)]
    assert [found.process(frame).keyframe is not None for frame in still] == [True] + [False] * 19


@pytest.mark.slow
def test_a_clock_that_jumps_back_deletes_nothing(frames: list[Frame]) -> None:
    found = detector()
    for frame in frames[10:40]:
        found.process(frame)
    stray = found.process(replace(frames[2], session=1)).keyframe
    assert stray is not None and stray.session == 1
    later = found.process(replace(frames[59], session=1))
    assert later.keyframe is not None and later.keyframe.session == 1
    # closures name stamps, which now are those of the new clock
    assert {verdict.candidate.stamp_ns for verdict in later.verdicts} <= {frames[2].stamp_ns}
    assert [found.database[row].stamp_ns for row in range(30)] == [frame.stamp_ns for frame in frames[10:40]]


def pairs(detections: list[Detection]) -> set[tuple[int, int]]:
    return {(c.match_stamp_ns, c.query_stamp_ns) for detection in detections for c in detection.closures}


@pytest.mark.slow
def test_a_recording_again_gives_the_same_closures_bit_for_bit_and_adds_nothing_to_its_store(
    frames: list[Frame], detections: list[Detection], tmp_path: Path
) -> None:
    for reopened in (False, True):
        found = detector(load_settings(database__path=str(tmp_path / "map.sqlite")))
        again = [found.process(frame) for frame in frames]
        assert len(found.database) == len(frames)
        for now, before in zip(again, detections, strict=True):
            assert [v.reason for v in now.verdicts] == [v.reason for v in before.verdicts]
            for a, b in zip(now.closures, before.closures, strict=True):
                np.testing.assert_array_equal(a.match_T_query, b.match_T_query)
                np.testing.assert_array_equal(a.covariance, b.covariance)
        if not reopened:
            found.database.close()
    # a player that loops sends the same messages again
    looped = [found.process(replace(frame, session=1)) for frame in frames[::2]]
    assert len(found.database) == len(frames)
    assert {one.keyframe.session for one in looped if one.keyframe} == {0}
    expected = {pair for pair in pairs(detections) if pair[1] in {frame.stamp_ns for frame in frames[::2]}}
    assert pairs(looped) <= expected and len(pairs(looped)) >= 0.9 * len(expected) > 0
    found.database.close()


@pytest.mark.slow
def test_a_drive_that_was_interrupted_goes_on_in_its_session(
    frames: list[Frame], detections: list[Detection], tmp_path: Path
) -> None:
    settings = load_settings(database__path=str(tmp_path / "map.sqlite"))
    first = detector(settings)
    for frame in frames[:35]:
        first.process(frame)
    first.database.close()
    second = detector(settings)
    for frame in frames[:30]:
        second.resume(frame)
    rest = [second.process(frame) for frame in frames[30:]]
    assert len(second.database) == len(frames)
    last, before = rest[-1].keyframe, detections[-1].keyframe
    assert last is not None and before is not None
    assert (last.session, last.path_length_m) == (before.session, pytest.approx(before.path_length_m))
    for one, other in zip(rest, detections[30:], strict=True):
        assert [c.match_stamp_ns for c in one.closures] == [c.match_stamp_ns for c in other.closures]


@pytest.mark.slow
def test_a_full_disk_costs_the_memory_and_not_the_closures(
    frames: list[Frame], detections: list[Detection], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = detector()
    for frame, before in zip(frames, detections, strict=True):
        if before.closures:
            break
        found.process(frame)

    def full(_: object) -> int:
        raise OutputError("no space left on device")

    monkeypatch.setattr(found.database, "add", full)
    now = found.process(frame)
    assert len(now.closures) == len(before.closures) > 0 and str(now.fault) == "no space left on device"


def test_a_session_that_is_ended_keeps_its_places(frames: list[Frame]) -> None:
    found = detector()
    for frame in frames[:5]:
        found.process(frame)
    found.end_session()
    later = found.process(frames[6]).keyframe
    assert later is not None and (later.session, later.path_length_m) == (1, 0.0)
    assert len(found.database) == 6


@pytest.fixture
def image() -> Iterator[np.ndarray]:
    yield np.random.default_rng(0).integers(0, 255, (512, 688), np.uint8)


def test_either_modality_may_be_missing(frames: list[Frame], image: np.ndarray) -> None:
    found = detector()
    camera_only = replace(frames[0], left=image, right=image, points=None, intensity=None)
    lidar_only, blind = frames[3], replace(frames[6], left=image * 0, points=np.empty((0, 3), np.float32))
    for frame in (camera_only, lidar_only, blind):
        assert found.process(frame).keyframe is not None
    assert len(found.database) == 3


def test_one_camera_without_a_scan_says_once_why_nothing_becomes_metric(
    frames: list[Frame], image: np.ndarray, caplog: pytest.LogCaptureFixture
) -> None:
    found = detector()
    mono = [replace(frame, left=image, points=None, intensity=None) for frame in frames[:50]]
    detections = [found.process(frame) for frame in mono]
    verdicts = [verdict for detection in detections for verdict in detection.verdicts]
    assert len(verdicts) > 10 and not any(detection.closures for detection in detections)
    assert {verdict.reason for verdict in verdicts} <= {RejectReason.NO_DEPTH, RejectReason.NOT_SELECTED}
    assert [record.message for record in caplog.records].count(f"{NOTHING_METRIC}: {RejectReason.NO_DEPTH.value}") == 1
