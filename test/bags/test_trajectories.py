from __future__ import annotations

import os
import time
from pathlib import Path
from time import process_time

import numpy as np
import pytest
from recordings import LEFT, START_NS, TRUTH, drive, traverse, write_mcap
from scipy.spatial.transform import Rotation

from umf_ros.bags.reader import open_bag
from umf_ros.bags.trajectories import read_ground_truth, read_odometry, read_tum
from umf_ros.core.config import load_settings
from umf_ros.core.errors import BagError, OutputError
from umf_ros.core.geometry import make_pose
from umf_ros.core.trajectory import Trajectory, write_tum
from umf_ros.sensors.calibration import load_calibration

S = 10**9


def trajectory(count: int = 20, step_s: float = 0.5) -> Trajectory:
    seconds = np.arange(count) * step_s
    stamps = START_NS + (seconds * S).astype(np.int64) + 123
    return Trajectory(stamps, np.stack([drive(second) for second in seconds]))


def test_tum_keeps_every_nanosecond_and_the_pose(tmp_path: Path) -> None:
    path, written = tmp_path / "a.tum", trajectory()
    write_tum(path, written)
    read = read_tum(path)
    assert (read.stamps_ns == written.stamps_ns).all()
    assert np.abs(read.poses - written.poses).max() < 5e-9
    assert read.has_orientation
    stamp, *numbers = path.read_text().splitlines()[3].split()
    assert len(stamp.split(".")[1]) == 9 and all(len(number.split(".")[1]) == 9 for number in numbers)


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("1.0 0 0 0 0 0 0", "expected 8 numbers"),
        ("1.0 0 0 0", "expected 8 numbers"),
        ("1.0 0 0 zero 0 0 0 1", "expected numbers, found '1.0 0 0 zero 0 0 0 1'"),
        ("soon 0 0 0 0 0 0 1", "expected numbers"),
        ("1.0 0 0 0 0 0 0 2", "no unit quaternion"),
        ("1.0 0 0 0 0 0 0 0", "no unit quaternion"),
        ("0.5 1 0 0 0 0 0 1", "not later than the one before"),
        ("0.4 0 0 0 0 0 0 1", "not later than the one before"),
        ("nan 0 0 0 0 0 0 1", "expected numbers"),
        ("inf 0 0 0 0 0 0 1", "expected numbers"),
        ("1e30 0 0 0 0 0 0 1", "later than any time"),
        ("9223372037.0 0 0 0 0 0 0 1", "later than any time"),
        ("1.0 0 0 0 0.1 0.2 0.3", "expected 8 numbers"),
    ],
)
def test_wrong_line_of_a_tum_file_is_named(line: str, text: str, tmp_path: Path) -> None:
    path = tmp_path / "a.tum"
    path.write_text(f"# stamp x y z qx qy qz qw\n0.5 0 0 0 0 0 0 1\n\n{line}\n")
    with pytest.raises(BagError) as caught:
        read_tum(path)
    assert f"{path}, line 4: " in str(caught.value)
    assert text in str(caught.value)


ROUND = [drive(second) for second in np.arange(0, 40, 0.5)]


def _lines(form: str = "{s}.{n:09d} {x:.9f} {y:.9f} {z:.9f} {qx:.9f} {qy:.9f} {qz:.9f} {qw:.9f}") -> list[str]:
    lines = []
    for k, pose in enumerate(ROUND):
        ns = START_NS + k * S // 2
        (x, y, z), (qx, qy, qz, qw) = pose[:3, 3], Rotation.from_matrix(pose[:3, :3]).as_quat()
        s, n = divmod(ns, S)
        lines.append(
            form.format(ns=ns, s=s, n=n, x=x, y=y, z=z, qx=qx, qy=qy, qz=qz, qw=qw, t=ns / S, k=k, f=float(ns))
        )
    return lines


Q = "{qx:.9f} {qy:.9f} {qz:.9f} {qw:.9f}"
P = "{x:.9f} {y:.9f} {z:.9f}"
DIALECTS = {
    "nanoseconds": _lines(f"{{ns}} {P} {Q}"),
    "nanoseconds as a float": _lines(f"{{f:.6f}} {P} {Q}"),
    "microseconds": [line.replace("000 ", " ", 1) for line in _lines(f"{{ns}} {P} {Q}")],
    "milliseconds": [line.replace("000000 ", " ", 1) for line in _lines(f"{{ns}} {P} {Q}")],
    "exponents": _lines(f"{{t:.18e}} {P} {Q}"),
    "header": ["timestamp tx ty tz qx qy qz qw", *_lines()],
    "percent": ["% timestamp tx ty tz qx qy qz qw", *_lines()],
    "tabs": [line.replace(" ", "\t") for line in _lines()],
    "commas": [line.replace(" ", ", ") for line in _lines()],
    "semicolons": [line.replace(" ", ";") for line in _lines()],
    "decimal commas": [line.replace(".", ",") for line in _lines()],
    "decimal commas and semicolons": [line.replace(".", ",").replace(" ", ";") for line in _lines()],
    "trailing": [line + " 0.1 0 0.1 " for line in _lines()],
    "empty lines": ["", *_lines(), "", "  "],
    "twice": [line for line in _lines() for _ in range(2)],
    "index": ["num,t,x,y,z,qx,qy,qz,qw", *_lines(f"{{k}} {{t:.6f}} {P} {Q}".replace(" ", ","))],
    "lost tracking": [*_lines()[:9], f"{START_NS / S + 4.1:.3f} {'nan ' * 7}", *_lines()[9:]],
    "EuRoC": [
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v_x",
        *_lines(f"{{ns}} {P} {{qw:.9f}} {{qx:.9f}} {{qy:.9f}} {{qz:.9f}} 0.5".replace(" ", ",")),
    ],
    "w first": _lines(f"{{s}}.{{n:09d}} {P} {{qw:.9f}} {{qx:.9f}} {{qy:.9f}} {{qz:.9f}}"),
}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize("name", DIALECTS)
def test_trajectories_of_other_programs_are_read(
    name: str, encoding: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "a.csv"
    path.write_text("\r\n".join([*DIALECTS[name], ""]), encoding)
    found = read_tum(path)
    assert len(found) == len(ROUND) and found.has_orientation
    assert np.abs(found.stamps_ns - START_NS - np.arange(len(ROUND)) * S // 2).max() < 1000
    np.testing.assert_allclose(found.poses, ROUND, atol=1e-7)
    said = {"w first": "w first, as the motion shows", "lost tracking": "1 lines without a pose"}.get(name)
    messages = [record.message for record in caplog.records]
    assert len(messages) == bool(said) and (not said or said in messages[0])


def test_a_straight_drive_keeps_the_usual_order_of_its_quaternions(tmp_path: Path) -> None:
    path, upside_down = tmp_path / "a.tum", Rotation.from_euler("xz", [180, 1], degrees=True).as_matrix()
    straight = [make_pose(upside_down if k % 2 else np.diag([1.0, -1, -1]), [k, 0, 0]) for k in range(40)]
    write_tum(path, Trajectory(START_NS + np.arange(40) * S, np.stack(straight)))
    np.testing.assert_allclose(read_tum(path).poses, straight, atol=1e-8)


@pytest.mark.filterwarnings("error")
def test_one_pose_is_refused_without_a_warning_of_numpy(tmp_path: Path) -> None:
    (tmp_path / "a.tum").write_text("1.0 0 0 0 0 0 0 1\n")
    with pytest.raises(BagError, match=r"a\.tum holds a single pose, which is no odometry$"):
        read_odometry(tmp_path / "a.tum", "body", load_settings())


@pytest.mark.parametrize("tail", ["", " 0 0 0 1", " 0 0 0 0", " 0.6 0 0 0.8"])
def test_positions_alone_have_no_orientation_and_are_no_odometry(tail: str, tmp_path: Path) -> None:
    path = tmp_path / "a.tum"
    path.write_text("".join(line + "\n" for line in _lines(f"{{s}}.{{n:09d}} {P}{tail}")))
    found = read_tum(path)
    assert not found.has_orientation
    np.testing.assert_allclose(found.poses[:, :3, 3], np.stack(ROUND)[:, :3, 3], atol=1e-8)
    with pytest.raises(BagError, match="has no rotations"):
        read_odometry(path, "body", load_settings())


def test_odometry_of_a_straight_drive_may_have_one_rotation(tmp_path: Path) -> None:
    straight = [make_pose(np.eye(3), [0.1 * k, 0, 0]) for k in range(30)]
    write_tum(tmp_path / "a.tum", Trajectory(START_NS + np.arange(30) * S, np.stack(straight)))
    np.testing.assert_allclose(read_odometry(tmp_path / "a.tum", "body", load_settings()).poses, straight, atol=1e-8)


def test_tum_files_that_cannot_be_read_or_written(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="cannot read"):
        read_tum(tmp_path / "nothing.tum")
    (tmp_path / "kitti.txt").write_text("1.0 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(BagError, match="KITTI's poses have no stamps"):
        read_tum(tmp_path / "kitti.txt")
    (tmp_path / "empty.tum").write_text("# nothing\n")
    with pytest.raises(BagError, match="holds no pose"):
        read_tum(tmp_path / "empty.tum")
    (tmp_path / "binary.tum").write_bytes(b"\x00\x81\xfe")
    with pytest.raises(BagError, match="not a text file"):
        read_tum(tmp_path / "binary.tum")
    with pytest.raises(OutputError, match="cannot write"):
        write_tum(tmp_path / "no folder" / "a.tum", trajectory())


@pytest.mark.parametrize(
    "line", ["1" + " " * 10**6 + "2", "q" + "," * 900_000 + "2", "# q" + "[" * 10**6, "1 " * 10**7], ids=len
)
def test_long_lines_take_no_time(tmp_path: Path, line: str) -> None:
    path = tmp_path / "a.tum"
    path.write_text(line + "\n")
    start = process_time()
    with pytest.raises(BagError, match=r"expected|no pose|a line has more than") as caught:
        read_tum(path)
    assert process_time() - start < 3
    assert "\n" not in str(caught.value)


def test_poses_between_the_samples_are_those_of_the_drive() -> None:
    path = trajectory()
    stamps = START_NS + np.array([0.25, 3.1, 9.4]) * S + 123
    poses, known = path.at(stamps.astype(np.int64))
    assert known.all()
    for pose, second in zip(poses, (0.25, 3.1, 9.4), strict=True):
        assert np.allclose(pose[:3, :3], drive(second)[:3, :3], atol=1e-6)
        assert np.allclose(pose[:3, 3], drive(second)[:3, 3], atol=0.012)


def test_nothing_is_known_outside_and_across_gaps() -> None:
    path = trajectory()
    keep = np.r_[0:5, 12:20]
    path = Trajectory(path.stamps_ns[keep], path.poses[keep])
    seconds = np.array([-0.001, 0.0, 2.0, 2.001, 5.999, 6.0, 9.5, 9.501])
    poses, known = path.at(START_NS + np.round(seconds * S).astype(np.int64) + 123)
    assert known.tolist() == [False, True, True, False, False, True, True, False]
    assert (poses[~known] == np.eye(4)).all()
    assert np.array_equal(poses[1], path.poses[0])


def test_trajectory_of_a_sensor_becomes_that_of_the_body() -> None:
    body_T_imu = make_pose(Rotation.from_euler("x", 180, degrees=True).as_matrix(), [0.3, 0.0, 0.1])
    body = trajectory()
    imu = Trajectory(body.stamps_ns, body.poses @ body_T_imu)
    assert np.allclose(imu.of_body(body_T_imu).poses, body.poses)


def test_truth_of_a_recording(tmp_path: Path) -> None:
    bag = open_bag(write_mcap(tmp_path / "a.mcap", traverse(1.0)))
    truth = read_ground_truth(bag)
    assert truth is not None and len(truth) == 20 and truth.has_orientation
    assert np.allclose(truth.poses[-1], drive(0.95))
    assert truth.stamps_ns[1] - truth.stamps_ns[0] == 50_000_000
    without = open_bag(write_mcap(tmp_path / "b.mcap", [entry for entry in traverse(0.5) if entry[0] == LEFT]))
    assert TRUTH not in without.topics and read_ground_truth(without) is None
    write_tum(tmp_path / "a.tum", trajectory())
    chosen = read_ground_truth(bag, tmp_path / "a.tum")
    assert chosen is not None and len(chosen) == 20 and chosen.stamps_ns[0] == START_NS + 123


POS = """% program   : RTKPOST
%  GPST                  latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)
2021/07/07 10:00:18.000   37.750000000   15.000000000  2600.0000   1  12   0.0100
2021/07/07 10:00:18.200   37.750009000   15.000000000  2600.0000   2  12   0.0100
2021/07/07 10:00:18.400   37.750000000   15.000011300  2600.0000   5  12   0.0100
2021/07/07 10:00:18.600   37.750000000   15.000011300  2601.5000   1  12   0.0100
"""


@pytest.mark.parametrize("zone", ["UTC", "Europe/Berlin", "America/New_York"])
def test_rtklib_positions_are_in_utc_and_metres_on_every_machine(
    zone: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(os.environ, "TZ", zone)
    time.tzset()
    path = tmp_path / "a.pos"
    path.write_text(POS)
    truth = read_ground_truth(None, path)
    monkeypatch.undo()
    time.tzset()
    assert truth is not None and not truth.has_orientation
    # 2021-07-07 10:00:00 UTC is 1625652000; the float solution counts, the single one does not
    assert [(stamp - 1625652000 * S) / 1e9 for stamp in truth.stamps_ns] == [0.0, 0.2, 0.6]
    assert np.allclose(truth.poses[:, :3, :3], np.eye(3))
    east_north_up = truth.poses[:, :3, 3]
    # a degree of latitude is 110.99 km and one of longitude 88.13 km there (GRS 80 at 37.75 deg), plus height
    assert np.allclose(east_north_up[1], [0, 9e-6 * 110_988 * (1 + 2600 / 6.36e6), 0], atol=1e-3)
    assert np.allclose(east_north_up[2], [11.3e-6 * 88_128 * (1 + 2600 / 6.38e6), 0, 1.5], atol=2e-3)


def test_rtklib_week_and_seconds_are_the_same_time(tmp_path: Path) -> None:
    path = tmp_path / "a.pos"
    # 2021-07-07 is a Wednesday: day 3 of GPS week 2165
    path.write_text("2165 295218.000 37.75 15.0 2600.0 1 12\n")
    truth = read_ground_truth(None, path)
    assert truth is not None and truth.stamps_ns[0] == 1625652000 * S


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("2021/07/07 10:00:18.000 37.75 15.0 2600.0", "line 1"),
        ("2021/07/07 noon 37.75 15.0 2600.0 1", "line 1"),
        ("99999999999 5 37.75 15.0 2600.0 1", "line 1"),
        ("2165 1e30 37.75 15.0 2600.0 1", "line 1"),
        ("2021/07/07 10:00:18.000 95.0 15.0 2600.0 1", "line 1"),
        ("2021/07/07 10:00:18.000 37.75 15.0 2600.0 5", "no position of quality 2"),
    ],
)
def test_wrong_rtklib_files_are_one_clear_line(line: str, text: str, tmp_path: Path) -> None:
    path = tmp_path / "a.pos"
    path.write_text(line + "\n")
    with pytest.raises(BagError, match=text) as caught:
        read_ground_truth(None, path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("frame", ["body", "imu", "camera", "lidar"])
def test_odometry_of_any_sensor_becomes_that_of_the_body(tmp_path: Path, frame: str) -> None:
    settings = load_settings(None, dataset="s3li-etna")
    calibration = load_calibration("s3li-etna")
    mounting = np.eye(4) if frame == "body" else getattr(calibration, f"body_T_{frame}")
    rng = np.random.default_rng(5)
    bodies = np.stack([make_pose(Rotation.random(random_state=rng).as_matrix(), rng.normal(0, 9, 3)) for _ in range(4)])
    write_tum(tmp_path / "sensor.tum", Trajectory(np.arange(4) * 10**8, bodies @ mounting))
    found = read_odometry(tmp_path / "sensor.tum", frame, settings)
    np.testing.assert_allclose(found.poses, bodies, atol=1e-6)


def test_an_unknown_frame_of_the_odometry_is_named(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="unknown frame 'wheel'"):
        read_odometry(tmp_path / "any.tum", "wheel", load_settings())
