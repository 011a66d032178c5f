from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recordings import CALIBRATION, CLOUD, LEFT, LEFT_INFO, RIGHT, START_NS, camera_info, cloud, image, odometry, scan

from umf_ros.core.config import TRANSFORMS, Settings, Sync, Topics
from umf_ros.sensors.calibration import calibration_of, load_calibration
from umf_ros.sensors.router import EARLY_IMAGES, MessageRouter, wanted_inputs
from umf_ros.sensors.synchronizer import Synchronizer

RIGHT_INFO = Topics().right_info


@pytest.fixture
def synchronizer(tmp_path: Path) -> Synchronizer:
    path = tmp_path / "calibration.yaml"
    path.write_text(CALIBRATION)
    return Synchronizer(
        Sync(), load_calibration(path), wanted_inputs(Topics(odometry="", right_image="", right_info=""))
    )


def test_inputs_without_a_topic_are_not_wanted() -> None:
    assert wanted_inputs(Topics()) == {"left", "right", "cloud", "odometry", "camera_info"}
    assert wanted_inputs(Topics(cloud="", left_info="", odometry="")) == {"left", "right"}


def test_every_bad_message_is_counted_and_each_kind_told_once(synchronizer: Synchronizer) -> None:
    told: list[str] = []
    intake = MessageRouter(synchronizer, Topics(), told.append)
    pixels = np.zeros((48, 64), np.uint8)
    for i in range(3):
        intake.take(LEFT, image(START_NS + i, pixels, "nv12"))
        intake.take(LEFT, image(START_NS + i, pixels, step=10))
        intake.take(LEFT, image(START_NS + i, np.zeros((4, 4), np.uint8)))
        intake.take(CLOUD, cloud(START_NS + i, scan(np.ones((3, 3))), data=np.zeros(5, np.uint8)))
        broken = odometry(START_NS + i, np.eye(4))
        broken.pose.pose.orientation.w = 0.0
        intake.take("/odom", broken)
    assert synchronizer.counters["left"].dropped == {"encoding": 3, "step": 3, "size": 3}
    assert synchronizer.counters["cloud"].dropped == {"truncated": 3}
    assert synchronizer.counters["odometry"].dropped == {"pose": 3}
    assert len(told) == 5
    assert any(LEFT in line and "nv12" in line for line in told)


def test_good_messages_after_bad_ones_still_make_a_frame(synchronizer: Synchronizer) -> None:
    intake = MessageRouter(synchronizer, Topics(right_info=""), lambda _: None)
    intake.take(LEFT_INFO, camera_info(START_NS, 77.0, (64, 48)))
    intake.take(CLOUD, cloud(START_NS, scan(np.full((3, 3), 4.0))))
    intake.take(LEFT, image(START_NS + 90_000_000, np.zeros((48, 64), np.uint8), height=0))
    intake.take(LEFT, image(START_NS + 100_000_000, np.full((48, 64), 9, np.uint8)))
    (frame,) = synchronizer.pop()
    assert frame.left is not None and frame.left.max() == 9
    assert frame.points is not None and len(frame.points) == 3
    assert (frame.camera.fx, frame.camera.baseline) == (77, 0.2)


@pytest.mark.parametrize(
    ("topics", "seconds"), [(Topics(right_image=""), 0), (Topics(right_info=""), 0), (Topics(), 6)]
)
def test_a_left_camera_alone_is_used_with_its_own_intrinsics(
    synchronizer: Synchronizer, topics: Topics, seconds: int
) -> None:
    """At once where no right camera is expected, after some silence where one is."""
    intake = MessageRouter(synchronizer, topics, lambda _: None)
    intake.take(LEFT_INFO, camera_info(START_NS, 77.0, (64, 48)))
    start = START_NS + seconds * 10**9
    intake.take(LEFT_INFO, camera_info(start, 77.0, (64, 48)))
    intake.take(CLOUD, cloud(start, scan(np.full((3, 3), 4.0))))
    intake.take(LEFT, image(start + 100_000_000, np.full((48, 64), 9, np.uint8)))
    (frame,) = synchronizer.pop()
    assert frame.camera.fx == 77


def test_useless_camera_info_is_told_and_the_calibration_file_stands(synchronizer: Synchronizer) -> None:
    told: list[str] = []
    intake = MessageRouter(synchronizer, Topics(right_info=""), told.append)
    intake.take(LEFT_INFO, camera_info(START_NS, 77.0, (64, 48), k=np.zeros(9), p=np.zeros(12)))
    intake.take(CLOUD, cloud(START_NS, scan(np.full((3, 3), 4.0))))
    intake.take(LEFT, image(START_NS + 100_000_000, np.zeros((48, 64), np.uint8)))
    (frame,) = synchronizer.pop()
    assert frame.camera.fx == 60
    assert len(told) == 1 and "not calibrated" in told[0]


def open_rig(**sync: float) -> Synchronizer:
    """A synchronizer that knows the rig from messages only."""
    return Synchronizer(Sync(**sync), calibration_of(Settings(calibration=TRANSFORMS)), wanted_inputs(Topics()))


def test_images_wait_for_their_first_camera_info() -> None:
    told: list[str] = []
    synchronizer = open_rig()
    intake = MessageRouter(synchronizer, Topics(), told.append)
    pixels = np.zeros((48, 64), np.uint8)
    for at in (0, 1, 2):
        stamp = START_NS + at * 100_000_000
        intake.take(LEFT, image(stamp, pixels))
        intake.take(RIGHT, image(stamp, pixels))
        intake.take(CLOUD, cloud(stamp, scan(np.full((3, 3), 4.0))))
        if at == 1:
            intake.take(LEFT_INFO, camera_info(stamp, 77.0, (64, 48)))
            intake.take(RIGHT_INFO, camera_info(stamp, 77.0, (64, 48), baseline=0.2))
    frames = synchronizer.flush()
    assert [(frame.camera.fx, frame.left is not None, frame.right is not None) for frame in frames] == [
        (77, True, True)
    ] * 3
    assert not told and not synchronizer.counters["left"].dropped.total()


def test_images_do_not_wait_forever_for_a_camera_info() -> None:
    told: list[str] = []
    synchronizer = open_rig()
    intake = MessageRouter(synchronizer, Topics(right_image="", right_info=""), told.append)
    for at in range(EARLY_IMAGES + 3):
        intake.take(LEFT, image(START_NS + at * 100_000_000, np.zeros((48, 64), np.uint8)))
    assert len(told) == 1 and "image before its camera_info" in told[0]
    intake.take(LEFT_INFO, camera_info(START_NS, 0.0, (64, 48), k=np.zeros(9), p=np.zeros(12)))
    intake.take(LEFT, image(START_NS + at * 10**9, np.zeros((48, 64), np.uint8)))
    assert synchronizer.counters["left"].dropped == {"camera_info": EARLY_IMAGES + 4}


@pytest.mark.parametrize("changes", [{"baseline": 0.0}, {"k": np.zeros(9), "p": np.zeros(12)}])
def test_a_right_camera_info_without_use_leaves_the_left_camera(changes: dict[str, Any]) -> None:
    told: list[str] = []
    synchronizer = open_rig()
    intake = MessageRouter(synchronizer, Topics(), told.append)
    intake.take(RIGHT_INFO, camera_info(START_NS, 77.0, (64, 48), **changes))
    intake.take(LEFT_INFO, camera_info(START_NS, 77.0, (64, 48)))
    intake.take(CLOUD, cloud(START_NS, scan(np.full((3, 3), 4.0))))
    intake.take(LEFT, image(START_NS, np.zeros((48, 64), np.uint8)))
    (frame,) = synchronizer.flush()
    assert frame.left is not None and (frame.camera.fx, frame.camera.baseline) == (77, 0)
    assert len(told) == 1 and told[0].startswith(RIGHT_INFO)


@pytest.mark.parametrize("calibrated", [True, False])
def test_binned_images_of_a_calibrated_sensor(synchronizer: Synchronizer, calibrated: bool) -> None:
    """Also of a driver that knows the binning but no intrinsics: the file's are those of the full sensor."""
    told: list[str] = []
    intake = MessageRouter(synchronizer, Topics(right_image="", right_info="", odometry=""), told.append)
    blank = {} if calibrated else {"k": np.zeros(9), "p": np.zeros(12)}
    intake.take(LEFT_INFO, camera_info(START_NS, 60.0, (64, 48), binning_x=2, binning_y=2, **blank))
    intake.take(CLOUD, cloud(START_NS, scan(np.full((3, 3), 4.0))))
    intake.take(LEFT, image(START_NS + 100_000_000, np.zeros((24, 32), np.uint8)))
    (frame,) = synchronizer.flush()
    assert frame.left is not None and frame.left.shape == (24, 32)
    assert (frame.camera.width, frame.camera.height, frame.camera.fx) == (32, 24, 30)
    assert len(told) == (not calibrated)


def test_images_of_no_reading_are_refused_with_both_sizes(synchronizer: Synchronizer) -> None:
    told: list[str] = []
    intake = MessageRouter(synchronizer, Topics(right_image="", right_info="", odometry=""), told.append)
    intake.take(LEFT_INFO, camera_info(START_NS, 60.0, (64, 48), binning_x=2, binning_y=2))
    intake.take(LEFT, image(START_NS, np.zeros((24, 40), np.uint8)))
    assert told == [f"{LEFT}: image of 40 x 24 pixels, the calibration is for 32 x 24; such messages are skipped"]


def take_frame(intake: MessageRouter, synchronizer: Synchronizer, at_s: float) -> float:
    """Focal length of the frame that a scan and an image make."""
    stamp = START_NS + round(at_s * 1e9)
    intake.take(CLOUD, cloud(stamp, scan(np.full((3, 3), 4.0))))
    intake.take(LEFT, image(stamp + 100_000_000, np.zeros((48, 64), np.uint8)))
    (frame,) = synchronizer.pop()
    return frame.camera.fx


def test_intrinsics_that_change_are_followed_and_one_stray_message_is_not(synchronizer: Synchronizer) -> None:
    told: list[str] = []
    intake = MessageRouter(synchronizer, Topics(right_info="", right_image="", odometry=""), told.append)

    def say(focal: float, at_s: float) -> None:
        intake.take(LEFT_INFO, camera_info(START_NS + round(at_s * 1e9), focal, (64, 48)))

    say(77.0, 0)
    assert take_frame(intake, synchronizer, 0) == 77
    say(300.0, 0.2)
    assert take_frame(intake, synchronizer, 0.3) == 77
    say(77.0, 0.5)
    assert take_frame(intake, synchronizer, 0.6) == 77
    say(81.0, 0.8)
    say(81.0, 0.9)
    assert take_frame(intake, synchronizer, 1.0) == 81


@pytest.mark.parametrize("focal", [1e-300, 1e300, 0.5, float("nan")])
def test_intrinsics_of_no_camera_are_refused_and_right_ones_used_then(synchronizer: Synchronizer, focal: float) -> None:
    told: list[str] = []
    intake = MessageRouter(synchronizer, Topics(right_info="", right_image="", odometry=""), told.append)
    intake.take(LEFT_INFO, camera_info(START_NS, focal, (64, 48)))
    assert take_frame(intake, synchronizer, 0) == 60 and len(told) == 1
    for at in (1, 2):
        intake.take(LEFT_INFO, camera_info(START_NS + at, 70.0, (64, 48)))
    assert take_frame(intake, synchronizer, 1.0) == 70


@pytest.mark.parametrize("step", [2**31, 2**32 - 1])
def test_a_point_of_gigabytes_is_refused(synchronizer: Synchronizer, step: int) -> None:
    told: list[str] = []
    intake = MessageRouter(synchronizer, Topics(), told.append)
    intake.take(CLOUD, cloud(START_NS, scan(np.ones((3, 3))), point_step=step))
    assert synchronizer.counters["cloud"].dropped == {"step": 1} and "\n" not in told[0]


def test_odometry_from_beyond_the_earth_is_refused(synchronizer: Synchronizer) -> None:
    intake = MessageRouter(synchronizer, Topics(), lambda _: None)
    for far in (1e200, -2e7):
        matrix = np.eye(4)
        matrix[1, 3] = far
        intake.take("/odom", odometry(START_NS, matrix))
    assert synchronizer.counters["odometry"].dropped == {"pose": 2}


def test_whatever_a_message_provokes_is_counted(synchronizer: Synchronizer) -> None:
    told: list[str] = []
    intake = MessageRouter(synchronizer, Topics(), told.append)
    for _ in range(3):
        intake.take(CLOUD, cloud(START_NS, scan(np.ones((3, 3))), fields=[None]))
    assert synchronizer.counters["cloud"].dropped == {"unusable": 3}
    assert len(told) == 1 and "AttributeError" in told[0]


def test_mutated_messages_are_used_or_counted(synchronizer: Synchronizer) -> None:
    rng = np.random.default_rng(2)
    intake = MessageRouter(synchronizer, Topics(), lambda _: None)
    values = [0, 1, 2**31, 2**32 - 1, float("nan"), 1e308, -1, "", "\0", "mono16", None, [], b"", np.zeros(3)]
    for number in range(1500):
        topic, message = [
            (LEFT, image(START_NS + number, np.zeros((48, 64), np.uint8))),
            (CLOUD, cloud(START_NS + number, scan(np.ones((3, 3))))),
            ("/odom", odometry(START_NS + number, np.eye(4))),
            (LEFT_INFO, camera_info(START_NS + number, 60.0, (64, 48))),
        ][number % 4]
        names = list(message.__dataclass_fields__)
        changes = {names[rng.integers(len(names))]: values[rng.integers(len(values))] for _ in range(2)}
        intake.take(topic, replace(message, **{name: value for name, value in changes.items() if name != "header"}))
    received = sum(counter.received for counter in synchronizer.counters.values())
    assert received >= 1500 * 3 // 4 - 5
