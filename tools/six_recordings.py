"""Follow the README with six recordings of a new user, by the commands that the program prints.

python tools/six_recordings.py DRIVE.mcap FOLDER      a drive of `umf simulate`; the folder takes 2 GB

The recordings: the drive; its topics renamed, without camera_info and /tf_static; LiDAR alone; one camera alone; as a
ROS 1 bag; cut off. Of each, every command that `umf inspect` prints is executed as printed, and each quaternion that a
replay names is pasted into the calibration, once. The exit status is 1 unless one camera alone is refused for lack of
depth before a replay, and the five others lead to closures.
"""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.typesys import Stores, get_typestore

RENAMED = {
    "/stereo/left/image_rect": "/front/left/image_rect",
    "/stereo/right/image_rect": "/front/right/image_rect",
    "/bf_lidar/points_raw": "/lidar/points",
    "/odom": "/wheel/odometry",
}
ONE_CAMERA = {
    "/stereo/left/image_rect": "/front/image_rect",
    "/stereo/left/camera_info": "/front/camera_info",
    "/odom": "/wheel/odometry",
}
LONGEST = 4
"""Commands in a row that one recording may take."""
PRINTED = re.compile(r"(?:with a first parameter file|Ready for loop closure): (umf .*)")
TURN = re.compile(r"correct (body_T_\w+) of the calibration .*quaternion: (\[.*?\])")
FOUND = re.compile(r"closures +(\d+) published")


def messages(drive: Path) -> Iterator[tuple[str, str, bytes, int]]:
    """Topic, type, bytes and time of every message."""
    with drive.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            yield channel.topic, schema.name, message.data, message.log_time


def write_mcap(drive: Path, path: Path, names: dict[str, str]) -> None:
    """Write the topics that have a new name, without compression."""
    store = get_typestore(Stores.ROS2_JAZZY)
    with path.open("wb") as file:
        writer, channels = Writer(file, compression=CompressionType.NONE), dict[str, int]()
        writer.start("ros2")
        for topic, kind, data, stamp_ns in messages(drive):
            if topic not in names:
                continue
            if topic not in channels:
                schema = writer.register_schema(kind, "ros2msg", store.generate_msgdef(kind, ros_version=2)[0].encode())
                channels[topic] = writer.register_channel(names[topic], "cdr", schema)
            writer.add_message(channels[topic], stamp_ns, data, stamp_ns)
        writer.finish()


def write_ros1(drive: Path, path: Path) -> None:
    """Write all messages as a ROS 1 bag."""
    jazzy, noetic, connections = get_typestore(Stores.ROS2_JAZZY), get_typestore(Stores.ROS1_NOETIC), {}
    with Ros1Writer(path) as writer:
        for topic, kind, data, stamp_ns in messages(drive):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=noetic)
            writer.write(connections[topic], stamp_ns, bytes(jazzy.cdr_to_ros1(data, kind)))


def make_all(drive: Path, folder: Path) -> list[Path]:
    """Write the recordings; existing ones are kept."""
    lidar = {topic: name for topic, name in RENAMED.items() if "lidar" in topic}
    makers = {
        "demo.mcap": lambda path: path.symlink_to(drive.resolve()),
        "renamed.mcap": lambda path: write_mcap(drive, path, RENAMED),
        "lidar_alone.mcap": lambda path: write_mcap(drive, path, lidar),
        "one_camera.mcap": lambda path: write_mcap(drive, path, ONE_CAMERA),
        "ros1.bag": lambda path: write_ros1(drive, path),
        "cut_off.mcap": lambda path: path.write_bytes(drive.read_bytes()[: drive.stat().st_size * 7 // 10]),
    }
    for name, make in makers.items():
        if not (folder / name).exists():
            make(folder / name)
    return [Path(name) for name in makers]


def run(folder: Path, words: list[str]) -> tuple[int, str]:
    """Run a command from the folder that the user is in; print it, and return its exit status and output."""
    command = [sys.executable, "-m", "umf_ros.cli", *words[1:]]
    done = subprocess.run(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    print(f"  {done.returncode}  {shlex.join(words)}", flush=True)
    return done.returncode, done.stdout


def paste(folder: Path, told: str) -> bool:
    """Paste the quaternions that were named into the calibration, as a user does; return whether there were any."""
    path = folder / "config" / "my_calibration.yaml"
    turns = dict(TURN.findall(told))
    if turns and path.exists():
        text = path.read_text()
        for name, quaternion in turns.items():
            text = re.sub(rf"({name}:.*\n.*\n  quaternion: )\[.*\]", rf"\g<1>{quaternion}", text)
            print(f"     {name}: {quaternion}")
        path.write_text(text)
    return bool(turns)


def follow(folder: Path, recording: Path) -> tuple[str, int]:
    """Return the last output, and the number of closures, of the printed commands from `umf inspect RECORDING` on."""
    print(recording)
    words, told, pasted = ["umf", "inspect", str(recording)], "", False
    for _ in range(LONGEST):
        told = run(folder, words)[1]
        if next_one := PRINTED.search(told):
            words = shlex.split(next_one[1])
        elif words[1] != "replay" or pasted or not (pasted := paste(folder, told)):
            break
    found = FOUND.search(told)
    return told, int(found[1]) if found else 0


def main() -> int:
    """Follow all recordings; return the exit status."""
    drive, parent = Path(sys.argv[1]), Path(sys.argv[2])
    parent.mkdir(parents=True, exist_ok=True)
    right = 0
    for recording in make_all(drive, parent):
        folder = parent / recording.stem
        folder.mkdir(exist_ok=True)
        if not (folder / recording).is_symlink():
            (folder / recording).symlink_to((parent / recording).absolute())
        told, closures = follow(folder, recording)
        is_right = "Not usable for loop closure: no depth" in told if "camera" in recording.stem else closures > 0
        right += is_right
        print(f"     {closures} closures{'' if is_right else '   <-- not as it should be'}", flush=True)
    print(f"{right} of 6 as they should be")
    return int(right < 6)


if __name__ == "__main__":
    sys.exit(main())
