from __future__ import annotations

import numpy as np
import pytest
from maps_made import COVARIANCE, START_NS, on_circle

from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.frames import LoopClosure, State
from umf_ros.core.geometry import Array, expmap, invert, make_pose, relative, rotation_angle
from umf_ros.core.trajectory import Trajectory
from umf_ros.localizer import ACCEPTED_ODDS, Localizer
from umf_ros.map_poses import MIN_SIGMAS, InitialPose
from umf_ros.pose_graph.closures import ClosureReason

SECOND_NS = 10**9
LATER_NS = START_NS + 5000 * SECOND_NS
MAP = Trajectory(START_NS + np.arange(101) * SECOND_NS, on_circle(np.arange(101)))
ORIGIN = make_pose([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [3.0, 8.0, 0.0])
"""Where the rover's odometry begins, in the map."""


class Drive:
    """A rover on the map's circle that wakes up at a metre of it; its odometry begins at the identity."""

    def __init__(self, start_m: float, drift: float = 0.0) -> None:
        self.localizer = Localizer(MAP, PoseGraphSettings())
        self.start_m, self.way_m, self.drift = start_m, 0.0, drift
        self.heard()

    @property
    def true(self) -> Array:
        return on_circle(np.array([self.start_m + self.way_m]))[0]

    @property
    def stamp_ns(self) -> int:
        return LATER_NS + round(self.way_m * 1e9)

    def heard(self) -> None:
        step = relative(on_circle(np.array([self.start_m]))[0], self.true)
        step[:3, 3] *= 1 + self.drift
        self.localizer.add_odometry(self.stamp_ns, step)

    def drive(self, metres: float) -> Drive:
        for _ in range(round(metres / 0.25)):
            self.way_m += 0.25
            self.heard()
        return self

    def closure(self, at_m: float | None = None, probability: float = 0.99, stamp_ns: int | None = None) -> LoopClosure:
        """With the map's keyframe nearest to where the rover is, or, wrongly, to a metre of the circle."""
        match = round(self.start_m + self.way_m if at_m is None else at_m) % 100
        pose = relative(on_circle(np.array([match]))[0], self.true if at_m is None else on_circle(np.array([at_m]))[0])
        noise = expmap(np.random.default_rng(match).normal(0, 0.01, (1, 6)))[0]
        stamp_ns = self.stamp_ns if stamp_ns is None else stamp_ns
        return LoopClosure(stamp_ns, int(MAP.stamps_ns[match]), pose @ noise, COVARIANCE, probability)

    def error_m(self) -> float:
        found = self.localizer.estimate()
        assert found is not None
        return float(np.linalg.norm(found.map_T_body[:3, 3] - self.true[:3, 3]))


def test_a_cold_start_is_localised_within_some_metres_of_closures() -> None:
    rover = Drive(37)
    known = []
    for _ in range(7):
        rover.localizer.add_closure(rover.closure())
        known.append(rover.localizer.estimate() is not None)
        rover.drive(1)
    assert not any(known[:2]) and all(known[5:])  # one alone is not believed
    found = rover.localizer.estimate()
    assert found is not None and found.probability > 0.999
    assert rover.error_m() < 0.1
    error = relative(rover.true, found.map_T_body)
    assert np.degrees(rotation_angle(error)) < 2
    assert np.allclose(rover.localizer.map_T_odom(), on_circle(np.array([37]))[0], atol=0.15)


def test_many_closures_of_one_place_do_not_localise() -> None:
    rover = Drive(37)
    rover.drive(1)
    for _ in range(30):
        rover.localizer.add_closure(rover.closure())
    assert rover.localizer.estimate() is None and rover.localizer.map_T_odom() is None


def test_inconsistent_closures_do_not_localise() -> None:
    rover = Drive(37)
    for row in range(10):
        wrong = 70 + 3 * (row % 4)  # every time another one
        rover.drive(1).localizer.add_closure(rover.closure(wrong))
    assert rover.localizer.estimate() is None


def test_a_single_wrong_closure_does_not_move_the_pose() -> None:
    rover = Drive(10)
    for row in range(12):
        rover.drive(1).localizer.add_closure(rover.closure(at_m=80 if row == 8 else None))
    assert rover.error_m() < 0.15 and rover.localizer.relocalised == 1
    assert rover.localizer.reasons[ClosureReason.CONTRADICTS_POSE] == 1


def test_a_moved_rover_is_relocalised() -> None:
    rover = Drive(10)
    for _ in range(8):
        rover.drive(1).localizer.add_closure(rover.closure())
    rover.start_m += 40  # its wheels did not turn: the odometry goes on
    for _ in range(12):
        moved = relative(on_circle(np.array([rover.start_m]))[0], on_circle(np.array([rover.start_m + rover.way_m]))[0])
        assert moved is not None
        rover.drive(1).localizer.add_closure(rover.closure())
    assert rover.localizer.relocalised == 2 and rover.error_m() < 0.3


def test_a_new_session_forgets_the_pose() -> None:
    rover = Drive(10)
    for _ in range(8):
        rover.drive(1).localizer.add_closure(rover.closure())
    rover.localizer.begin_session()
    assert rover.localizer.estimate() is None
    assert rover.localizer.relocalised == 1


def test_without_closures_the_covariance_grows() -> None:
    rover = Drive(10, drift=0.02)
    for _ in range(8):
        rover.drive(1).localizer.add_closure(rover.closure())
    before = rover.localizer.estimate()
    after = rover.drive(20).localizer.estimate()
    assert before is not None and after is not None and after.stamp_ns == rover.stamp_ns
    sigmas = [np.sqrt(np.trace(one.covariance[:2, :2])) for one in (before, after)]
    assert sigmas[1] > 3 * sigmas[0]
    assert rover.error_m() < 3 * sigmas[1]


def test_covariance_is_about_the_maps_axes() -> None:
    rover = Drive(25)  # a quarter round: it heads along the map's y axis
    for _ in range(4):
        rover.drive(0.5).localizer.add_closure(rover.closure())
    for _ in range(4):
        rover.drive(1).localizer.add_closure(rover.closure())
    found = rover.drive(15).localizer.estimate()
    assert found is not None
    heading_sigma = np.sqrt(found.covariance[5, 5])
    along, across = (direction @ found.covariance[:2, :2] @ direction for direction in found.map_T_body[:2, :2].T)
    assert heading_sigma > np.deg2rad(1) and across > along  # heading that is unsure shows across the way


def test_a_closure_before_its_odometry_is_pending() -> None:
    rover = Drive(50)
    for _ in range(6):
        rover.drive(1).localizer.add_closure(rover.closure())
    known = rover.localizer.reasons[ClosureReason.AGREES_WITH_POSE]
    early = rover.closure()
    ahead = LoopClosure(
        early.query_stamp_ns + 10**8,
        *(getattr(early, n) for n in ("match_stamp_ns", "match_T_query", "covariance")),
        0.99,
    )
    pending = rover.localizer.verdict_counts()[State.PENDING]
    (verdict,) = rover.localizer.add_closure(ahead)
    assert verdict.state is State.PENDING and rover.localizer.verdict_counts()[State.PENDING] == pending + 1
    assert rover.localizer.reasons[ClosureReason.AGREES_WITH_POSE] == known
    assert rover.localizer.update() == []
    rover.drive(0.25)
    assert rover.localizer.reasons[ClosureReason.AGREES_WITH_POSE] == known + 1
    assert [(one.closure, one.state) for one in rover.localizer.update()] == [(ahead, State.ACCEPTED)]
    assert rover.localizer.update() == []


@pytest.mark.parametrize("kind", ["unknown match", "before all odometry", "broken pose"])
def test_unusable_closures_are_counted(kind: str) -> None:
    rover = Drive(50).drive(1)
    closure = rover.closure()
    match, stamp, pose = closure.match_stamp_ns, closure.query_stamp_ns, closure.match_T_query
    match, stamp, pose = {
        "unknown match": (match + 1, stamp, pose),
        "before all odometry": (match, LATER_NS - SECOND_NS, pose),
        "broken pose": (match, stamp, 2 * pose),
    }[kind]
    (verdict,) = rover.localizer.add_closure(LoopClosure(stamp, match, pose, COVARIANCE, 0.99))
    assert verdict.state is State.REFUSED
    assert rover.localizer.reasons[ClosureReason.NOT_OF_MAP] == 1


def test_invalid_odometry_is_refused() -> None:
    localizer = Localizer(MAP, PoseGraphSettings())
    assert localizer.add_odometry(5, np.eye(4))
    assert not localizer.add_odometry(5, np.eye(4))  # the same stamp again
    assert not localizer.add_odometry(6, np.full((4, 4), np.nan))


def test_less_probable_closures_take_longer() -> None:
    needed = []
    for probability in (0.99, 0.9, float("nan")):
        rover, count = Drive(37), 0
        while rover.localizer.estimate() is None and count < 30:
            rover.drive(1).localizer.add_closure(rover.closure(probability=probability))
            count += 1
        needed.append(count)
    assert needed[0] < needed[1] == needed[2] < 12
    assert ACCEPTED_ODDS > 6


def test_origin_of_the_odometry_does_not_matter() -> None:
    rover = Drive(37)
    other = Localizer(MAP, PoseGraphSettings())
    poses = []
    for step in range(8):
        rover.drive(1)
        odometry = ORIGIN @ relative(on_circle(np.array([37]))[0], rover.true)
        other.add_odometry(rover.stamp_ns, odometry)
        other.add_closure(rover.closure())
        rover.localizer.add_closure(rover.closure())
        if step > 5:
            poses.append([one.estimate() for one in (other, rover.localizer)])
    for ours, theirs in poses:
        assert ours is not None and theirs is not None
        gap = invert(ours.map_T_body) @ theirs.map_T_body
        assert np.linalg.norm(gap[:3, 3]) < 0.1


def initial(at_m: float) -> InitialPose:
    """A click beside a metre of the circle."""
    pose = on_circle(np.array([at_m]))[0] @ make_pose(np.eye(3), [0.2, -0.3, 0.0])
    return InitialPose(pose, np.diag(MIN_SIGMAS**2))


@pytest.mark.parametrize("late", [False, True])
def test_an_initial_pose_is_a_pose_with_the_first_closure_that_agrees(late: bool) -> None:
    rover = Drive(37)
    if not late:
        rover.localizer.begin_session()
        rover.localizer.expect(initial(37.0))  # before any odometry
        rover.drive(0.25)
    else:
        rover.localizer.expect(initial(37.0))
    assert rover.localizer.estimate() is None  # it is no fact
    rover.localizer.add_closure(rover.closure(probability=0.95))
    assert rover.error_m() < 0.15


@pytest.mark.parametrize("off_m", [5.0, 30.0])
def test_a_wrong_initial_pose_is_given_up_for_closures(off_m: float) -> None:
    rover, other = Drive(37), Drive(37)
    rover.localizer.expect(initial(37.0 + off_m))
    for _ in range(7):
        known = [one.localizer.estimate() is not None for one in (rover, other)]
        assert known[0] == known[1]
        for one in (rover, other):
            one.drive(1).localizer.add_closure(one.closure())
    assert rover.error_m() < 0.15 and rover.localizer.relocalised == 1
