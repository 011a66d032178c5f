"""Messages, geodetic coordinates and parameters of absolute measurements."""

from __future__ import annotations

import numpy as np
import pytest
from sensor_msgs.msg import Imu, NavSatFix

from umf_ros.absolute.measurement import AbsoluteDecoder, AbsoluteMeasurement, Aid, parse_numbers
from umf_ros.core.errors import ConfigError, MessageError
from umf_ros.core.geometry import from_enu, from_quaternion, make_pose, to_enu

ORIGIN = np.array([37.72, 15.0, 2550.0])
TURNED = from_quaternion((0, 0, 0), (0, 0, np.sin(np.pi / 4), np.cos(np.pi / 4)))
DECODER = AbsoluteDecoder(
    np.array([0.1, 0.2, 1.0]), TURNED, lambda frame: make_pose(np.eye(3), [0, 0, 2]) if frame == "mast" else None
)


def fix(**changes: object) -> NavSatFix:
    message = NavSatFix(latitude=37.7, longitude=15.0, altitude=2500.0, position_covariance_type=2)
    message.position_covariance = np.diag([1.0, 1.0, 4.0]).ravel()
    message.status.status = 0
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def imu(force: tuple[float, float, float], rate: float = 0.0) -> Imu:
    message = Imu()
    message.orientation_covariance[0] = -1.0
    message.linear_acceleration.x, message.linear_acceleration.y, message.linear_acceleration.z = force
    message.angular_velocity.z = rate
    return message


def test_positions_go_to_the_world_and_back() -> None:
    # one minute of latitude is a sea mile, within what the ellipsoid changes
    north = to_enu(np.array([[37.72 + 1 / 60, 15.0, 2550.0]]), ORIGIN)[0]
    assert north[1] == pytest.approx(1850.0, abs=3.0) and abs(north[0]) < 1e-6
    points = np.random.default_rng(1).uniform(-2000, 2000, (50, 3))
    assert np.allclose(to_enu(from_enu(points, ORIGIN), ORIGIN), points, atol=1e-4)


def test_a_fix_has_the_lever_of_the_calibration_or_of_the_transforms() -> None:
    found = DECODER.decode(Aid.GNSS, fix(), 5)
    assert found is not None and np.allclose(found.lever, [0.1, 0.2, 1.0]) and found.covariance[2, 2] == 4.0
    message = fix()
    message.header.frame_id = "mast"
    assert np.allclose(DECODER.decode(Aid.GNSS, message, 5).lever, [0, 0, 2])


@pytest.mark.parametrize(
    ("message", "kind"),
    [
        (fix(position_covariance_type=0), "covariance"),
        (fix(latitude=float("nan")), "fix"),
        (fix(position_covariance=np.zeros(9)), "fix"),
    ],
)
def test_an_unusable_fix_is_refused(message: NavSatFix, kind: str) -> None:
    with pytest.raises(MessageError) as error:
        DECODER.decode(Aid.GNSS, message, 5)
    assert error.value.kind == kind


def test_a_receiver_without_a_fix_is_refused() -> None:
    message = fix()
    message.status.status = -1
    with pytest.raises(MessageError, match="no fix"):
        DECODER.decode(Aid.GNSS, message, 5)


def test_gravity_is_the_mean_acceleration_at_rest() -> None:
    decoder = AbsoluteDecoder(np.zeros(3), TURNED, lambda _: None)
    found = [decoder.decode(Aid.GRAVITY, imu((0.5, 0.0, 9.79)), k * 20_000_000) for k in range(100)]
    given = [one for one in found if one is not None]
    assert 1 <= len(given) <= 2
    # the IMU is turned by a quarter: its x is the body's y
    assert np.allclose(given[0].value, np.array([0, 0.5, 9.79]) / np.hypot(0.5, 9.79), atol=1e-6)


@pytest.mark.parametrize(("force", "rate"), [((0.5, 0.0, 11.0), 0.0), ((0.0, 0.0, 9.81), 0.5)])
def test_a_moving_imu_says_nothing_of_gravity(force: tuple[float, float, float], rate: float) -> None:
    decoder = AbsoluteDecoder(np.zeros(3), np.eye(4), lambda _: None)
    swings = [imu(force, rate * (-1) ** k) for k in range(100)]
    assert not any(decoder.decode(Aid.GRAVITY, one, k * 20_000_000) for k, one in enumerate(swings))


def test_an_orientation_is_gravity_twice_per_second() -> None:
    decoder = AbsoluteDecoder(np.zeros(3), np.eye(4), lambda _: None)
    message = Imu()
    message.orientation.x, message.orientation.w = np.sin(0.05), np.cos(0.05)
    given = [one for k in range(200) if (one := decoder.decode(Aid.GRAVITY, message, k * 10_000_000)) is not None]
    assert len(given) == 4 and np.allclose(given[0].value, [0, np.sin(0.1), np.cos(0.1)])
    message.orientation.w = 5.0
    with pytest.raises(MessageError, match="orientation"):
        decoder.decode(Aid.GRAVITY, message, 10**10)


def test_a_measurement_survives_storage() -> None:
    one = AbsoluteMeasurement(Aid.GNSS, 7, np.arange(3.0), np.eye(3), np.array([0.1, 0, 1]))
    again = AbsoluteMeasurement.stored("gnss", 7, one.numbers)
    assert again.source is Aid.GNSS and np.array_equal(again.numbers, one.numbers)
    with pytest.raises(ValueError, match="4 numbers"):
        AbsoluteMeasurement.stored("gnss", 7, np.zeros(4))


def test_a_parameter_that_is_no_numbers_is_one_line() -> None:
    assert parse_numbers(" ", 3, "pose_graph.origin") is None
    with pytest.raises(ConfigError, match=r"pose_graph.origin: expected 3 numbers, got '1 2'"):
        parse_numbers("1 2", 3, "pose_graph.origin")
