from __future__ import annotations

import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from recordings import (
    CLOUD,
    LEFT,
    ODOMETRY,
    START_NS,
    STORE,
    TRUTH,
    Entry,
    camera_info,
    image,
    traverse,
    write_db3,
    write_mcap,
    write_ros1,
)
from rosbags.typesys import Stores, get_typestore
from zstandard import ZstdCompressor

from umf_ros.bags.presets import detect_dataset, settings_for
from umf_ros.bags.reader import open_bag
from umf_ros.core import resources
from umf_ros.core.config import load_preset, load_settings, topics_of
from umf_ros.core.errors import BagError, ConfigError
from umf_ros.core.resources import find, share_folders
from umf_ros.sensors.calibration import calibration_of, load_calibration
from umf_ros.sensors.decode import decode_cloud, decode_image, decode_pose, stamp_ns

ENTRIES = traverse(1.0)


def write_mcap_folder(path: Path) -> Path:
    """As `ros2 bag record` leaves it when it splits: x_9.mcap before x_10.mcap, and metadata.yaml."""
    path.mkdir()
    write_mcap(path / "run_9.mcap", ENTRIES[: len(ENTRIES) // 2])
    write_mcap(path / "run_10.mcap", ENTRIES[len(ENTRIES) // 2 :])
    (path / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": {"version": 9}}))
    return path


def write_db3_file(path: Path) -> Path:
    (file,) = write_db3(path, ENTRIES).glob("*.db3")
    return file


def write_db3_without_metadata(path: Path) -> Path:
    (write_db3(path, ENTRIES) / "metadata.yaml").unlink()
    return path


def raw_mcap(path: Path, entries: list[Entry], **options: Any) -> Path:
    """An mcap of another writer, in one chunk."""
    return write_mcap(path, entries, chunk_size=2**20, profile="other", **options)


def packed_message(number: int, topic: str, data: bytes) -> bytes:
    """A zstd frame, as `--compression-mode message` makes it of each message."""
    return ZstdCompressor().compress(data)


def packed_file(folder: Path) -> Path:
    """A folder as `--compression-mode file` leaves it, without metadata."""
    folder.mkdir()
    plain = write_mcap(folder / "a.mcap", ENTRIES)
    (folder / "a.mcap.zstd").write_bytes(ZstdCompressor().compress(plain.read_bytes()))
    plain.unlink()
    return folder


def packed_db3(folder: Path) -> Path:
    file = write_db3_file(folder)
    (folder / "metadata.yaml").unlink()
    with closing(sqlite3.connect(file)) as connection, connection:
        rows = connection.execute("SELECT id, data FROM messages").fetchall()
        packed = [(ZstdCompressor().compress(data), number) for number, data in rows]
        connection.executemany("UPDATE messages SET data = ? WHERE id = ?", packed)
    return folder


def parallel(folder: Path, of_topic: Callable[[str], str]) -> Path:
    """One recorder for each sensor, split in the middle."""
    half = len(ENTRIES) // 2
    for number, part in enumerate((ENTRIES[:half], ENTRIES[half:])):
        for name in {of_topic(topic) for topic, _, _ in part}:
            path = folder / f"{name}_{number}.mcap"
            path.parent.mkdir(parents=True, exist_ok=True)
            write_mcap(path, [entry for entry in part if of_topic(entry[0]) == name])
    return folder


def with_metadata(folder: Path, change: Callable[[dict[str, Any]], Any]) -> Path:
    path = write_db3(folder, ENTRIES) / "metadata.yaml"
    known = yaml.safe_load(path.read_text())
    change(known["rosbag2_bagfile_information"])
    path.write_text(yaml.safe_dump(known))
    return folder


def forget_counts(known: dict[str, Any]) -> None:
    known["message_count"] = known["duration"]["nanoseconds"] = 0
    known["topics_with_message_count"] = []


def second_half_unlisted(folder: Path) -> Path:
    """Two db3 files of which the metadata list the first only."""
    half = len(ENTRIES) // 2
    with_metadata(folder, lambda known: known)
    for path in folder.glob("*.db3"):
        path.unlink()
    for number, part in enumerate((ENTRIES[:half], ENTRIES[half:])):
        write_db3_part(folder.parent / f"part_{number}", part).rename(folder / f"b_{number}.db3")
    return folder


def write_db3_part(folder: Path, entries: list[Entry]) -> Path:
    (file,) = write_db3(folder, entries).glob("*.db3")
    return file


BY_TOPIC = sorted(ENTRIES, key=lambda entry: entry[0])
BARE = {"use_chunking": False, "use_statistics": False, "use_summary_offsets": False}
FORMATS: dict[str, Callable[[Path], Path]] = {
    "mcap with packed messages": lambda folder: raw_mcap(folder / "a.mcap", ENTRIES, change=packed_message),
    "mcap packed as a whole": lambda folder: next(packed_file(folder / "b").iterdir()),
    "folder of an mcap packed as a whole": lambda folder: packed_file(folder / "b"),
    "db3 with packed messages": lambda folder: packed_db3(folder / "b"),
    "parallel recorders": lambda folder: parallel(folder / "b", lambda topic: topic.split("/")[1]),
    "parallel recorders in folders": lambda folder: parallel(folder / "b", lambda topic: f"{topic.split('/')[1]}/x"),
    "metadata without counts": lambda folder: with_metadata(folder / "b", forget_counts),
    "metadata without storage": lambda folder: with_metadata(
        folder / "b", lambda known: known.update(storage_identifier="")
    ),
    "metadata of the first file": lambda folder: second_half_unlisted(folder / "b"),
    "mcap without chunks": lambda folder: raw_mcap(folder / "a.mcap", ENTRIES, use_chunking=False),
    "mcap without chunks by topic": lambda folder: raw_mcap(folder / "a.mcap", BY_TOPIC, use_chunking=False),
    "mcap without a summary": lambda folder: raw_mcap(folder / "a.mcap", ENTRIES, **BARE),
    "mcap without channels in its summary": lambda folder: raw_mcap(
        folder / "a.mcap", ENTRIES, repeat_channels=False, repeat_schemas=False
    ),
    "mcap without statistics": lambda folder: raw_mcap(folder / "a.mcap", ENTRIES, use_statistics=False),
    "mcap": lambda folder: write_mcap(folder / "a.mcap", ENTRIES),
    "mcap folder": lambda folder: write_mcap_folder(folder / "run"),
    "db3 folder": lambda folder: write_db3(folder / "b", ENTRIES),
    "db3 file": lambda folder: write_db3_file(folder / "b"),
    "db3 without metadata": lambda folder: write_db3_without_metadata(folder / "b"),
    "ROS 1": lambda folder: write_ros1(folder / "c.bag", traverse(1.0, get_typestore(Stores.ROS1_NOETIC))),
}


@pytest.mark.parametrize("form", FORMATS)
def test_every_format_gives_the_same_messages_in_the_same_order(form: str, tmp_path: Path) -> None:
    bag = open_bag(FORMATS[form](tmp_path))
    read = list(bag.messages())
    assert [log_ns for _, log_ns, _ in read] == [log_ns for _, log_ns, _ in ENTRIES]
    # messages of one time in different files have no order
    read, written = (sorted(entries, key=lambda entry: (entry[1], entry[0])) for entries in (read, ENTRIES))
    assert [topic for topic, _, _ in read] == [topic for topic, _, _ in written]
    for (topic, _, got), (_, _, put) in zip(read, written, strict=True):
        if topic == LEFT:
            assert (decode_image(got) == decode_image(put)).all()
        elif topic == CLOUD:
            assert (decode_cloud(got).points == decode_cloud(put).points).all()
        elif topic == ODOMETRY:
            assert np.allclose(decode_pose(got.pose.pose), decode_pose(put.pose.pose))
        assert stamp_ns(got) == stamp_ns(put)
    assert {topic: info.count for topic, info in bag.topics.items()} == {
        topic: sum(entry[0] == topic for entry in ENTRIES) for topic in {entry[0] for entry in ENTRIES}
    }
    assert bag.topics[LEFT].type == "sensor_msgs/msg/Image"
    assert (bag.start_ns, bag.end_ns) == (ENTRIES[0][1], ENTRIES[-1][1])
    assert bag.duration_s == pytest.approx((ENTRIES[-1][1] - ENTRIES[0][1]) / 1e9)
    assert bag.warning == ""


def test_files_of_one_recorder_whose_clock_was_set_back_stay_in_their_order(tmp_path: Path) -> None:
    long = traverse(3.0)
    for number in (0, 1):
        write_mcap(tmp_path / f"a_{number}.mcap", long)
    assert [log_ns for _, log_ns, _ in open_bag(tmp_path).messages()] == 2 * [log_ns for _, log_ns, _ in long]


def test_folders_of_different_times_are_not_one_recording(tmp_path: Path) -> None:
    half = len(ENTRIES) // 2
    for name, part in (("monday", ENTRIES[:half]), ("tuesday", ENTRIES[half:])):
        (tmp_path / name).mkdir()
        write_mcap(tmp_path / name / "a.mcap", part)
    with pytest.raises(BagError, match=r"holds 2 recordings of different times, name one: .*monday, .*tuesday"):
        open_bag(tmp_path)


@pytest.mark.parametrize("form", ["mcap", "db3 folder", "ROS 1"])
def test_topics_can_be_chosen_and_read_again(form: str, tmp_path: Path) -> None:
    bag = open_bag(FORMATS[form](tmp_path))
    for _ in range(2):
        assert {topic for topic, _, _ in bag.messages([CLOUD, "/not/there"])} == {CLOUD}
    assert list(bag.messages(["/not/there"])) == []
    raw = next(bag.raw_messages([CLOUD]))
    assert (raw.type, type(raw.data)) == ("sensor_msgs/msg/PointCloud2", bytes)
    assert stamp_ns(STORE.deserialize_cdr(raw.data, raw.type)) == START_NS


@pytest.mark.parametrize("part", [0.3, 0.9, 0.999])
def test_truncated_mcap_is_read_as_far_as_it_goes(part: float, tmp_path: Path) -> None:
    whole = write_mcap(tmp_path / "a.mcap", ENTRIES).read_bytes()
    path = tmp_path / "broken.mcap"
    path.write_bytes(whole[: int(len(whole) * part)])
    bag = open_bag(path)
    read = [(topic, log_ns) for topic, log_ns, _ in bag.messages()]
    expected = [(topic, log_ns) for topic, log_ns, _ in ENTRIES]
    assert 0 < len(read) == sum(info.count for info in bag.topics.values())
    assert read == expected[: len(read)]
    assert part < 0.5 or len(read) > 0.5 * len(expected)
    assert f"{path} is truncated" in bag.warning and f"{len(read)} messages" in bag.warning


def test_mcap_whose_tail_is_garbage_is_read_up_to_it(tmp_path: Path) -> None:
    whole = write_mcap(tmp_path / "a.mcap", ENTRIES).read_bytes()
    path = tmp_path / "broken.mcap"
    path.write_bytes(whole[: len(whole) // 2] + bytes(range(256)) * 50)
    bag = open_bag(path)
    assert len(list(bag.messages())) > 20
    assert "is truncated" in bag.warning


def test_mcap_without_an_index_is_put_in_order(tmp_path: Path) -> None:
    whole = write_mcap(tmp_path / "a.mcap", [ENTRIES[i] for i in (3, 1, 0, 2, 5, 4)], chunk_size=10**9).read_bytes()
    path = tmp_path / "broken.mcap"
    path.write_bytes(whole[:-20])
    assert [log_ns for _, log_ns, _ in open_bag(path).messages()] == [log_ns for _, log_ns, _ in ENTRIES[:6]]


@pytest.mark.parametrize(
    ("name", "content", "text"),
    [
        ("empty.mcap", b"", "is empty"),
        ("foreign.mcap", b"PK\x03\x04 a zip file, renamed", "is not a recording"),
        ("short.mcap", b"\x89MCAP0\r\n", "holds no message"),
        ("foreign.bag", b"\x00" * 5000, "is not a recording"),
        ("broken.bag", b"#ROSBAG V2.0\n" + bytes(50), "cannot be read"),
        ("broken.db3", b"SQLite format 3\x00" + bytes(5000), "cannot be read"),
    ],
)
def test_what_is_no_recording_is_one_clear_line(name: str, content: bytes, text: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(BagError) as caught:
        open_bag(path)
    assert text in str(caught.value) and str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_file_and_foreign_folder(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="there is no recording"):
        open_bag(tmp_path / "nothing.mcap")
    (tmp_path / "metadata.yaml").write_text("nonsense: true")
    with pytest.raises(BagError, match="holds neither mcap nor db3 files"):
        open_bag(tmp_path)


def test_recording_without_messages_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="holds no message"):
        open_bag(write_mcap(tmp_path / "a.mcap", []))


def test_data_sets_are_told_by_their_topics(tmp_path: Path) -> None:
    def dataset(name: str, topics: set[str]) -> str:
        return detect_dataset(open_bag(write_mcap(tmp_path / name, [e for e in ENTRIES if e[0] in topics])))

    assert dataset("a.mcap", {LEFT, CLOUD, TRUTH}) == "simulated"
    assert dataset("b.mcap", {LEFT, CLOUD}) == "s3li-etna"
    assert dataset("c.mcap", {CLOUD}) == "s3li-etna"
    raw = load_preset("s3li-vulcano").topics.left_image
    bayer = [(raw, START_NS, image(START_NS, np.zeros((4, 4), np.uint8), "bayer_rggb8"))]
    assert detect_dataset(open_bag(write_mcap(tmp_path / "d.mcap", bayer))) == "s3li-vulcano"
    with pytest.raises(BagError, match="/odom"):
        dataset("e.mcap", {ODOMETRY})


def test_a_data_set_is_not_recognised_where_camera_info_contradicts(tmp_path: Path) -> None:
    raw = load_preset("s3li-vulcano").topics.left_image
    entries = [(raw, START_NS, image(START_NS, np.zeros((4, 4), np.uint8), "bayer_rggb8"))]
    entries.append(("/g319c_left/camera_info", START_NS, camera_info(START_NS, 700.0, (1242, 375))))
    entries.append(next(entry for entry in ENTRIES if entry[0] == CLOUD))  # of other data sets, too
    bag = open_bag(write_mcap(tmp_path / "a.mcap", entries))
    with pytest.raises(BagError, match=r"of s3li-vulcano, but .* 1242 x 375 pixels, .* 2064 x 1544"):
        settings_for(bag, None, "auto")
    own = settings_for(bag, None, "auto", calibration="my_calibration.yaml")
    assert own.dataset == settings_for(bag, None, "s3li-vulcano").dataset == "s3li-vulcano"
    # one that is damaged is no contradiction
    entries.append(("/g319c_left/camera_info", START_NS, camera_info(START_NS, 700.0, (2064, 1544))))
    assert settings_for(open_bag(write_mcap(tmp_path / "b.mcap", entries)), None, "auto").dataset == "s3li-vulcano"


def test_a_recording_is_read_as_the_file_says_and_only_then_by_its_topics(tmp_path: Path) -> None:
    bag = open_bag(write_mcap(tmp_path / "a.mcap", [entry for entry in ENTRIES if entry[0] in (LEFT, CLOUD, TRUTH)]))
    strange = open_bag(write_mcap(tmp_path / "b.mcap", [entry for entry in ENTRIES if entry[0] == ODOMETRY]))
    config = tmp_path / "config.yaml"
    config.write_text("dataset: s3li-etna\n")
    assert settings_for(bag, None, "auto").dataset == "simulated"
    assert settings_for(bag, config, "auto").dataset == "s3li-etna"
    assert settings_for(bag, config, "s3li-vulcano", loop__top_k=3).dataset == "s3li-vulcano"
    assert settings_for(bag, config, "auto", loop__top_k=3).loop.top_k == 3
    config.write_text("calibration: mine.yaml\ntopics: {left_image: /my/image, cloud: /my/points}\n")
    assert settings_for(strange, config, "auto").topics.cloud == "/my/points"
    with pytest.raises(BagError, match="no topic of a known data set"):
        settings_for(strange, None, "auto")


def test_a_data_set_is_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    datasets = tmp_path / "config" / "datasets"
    datasets.mkdir(parents=True)
    (tmp_path / "config" / "rig.yaml").write_text(find("config/calibration/simulated.yaml").read_text())
    (datasets / "my-rover.yaml").write_text(
        "calibration: ../rig.yaml\ntopics: {left_image: /nav/left}\nmark: /nav/left\n"
    )
    monkeypatch.setattr(resources, "share_folders", lambda: [tmp_path, *share_folders()])
    scans = [entry for entry in ENTRIES if entry[0] == CLOUD]
    picture = ("/nav/left", START_NS, image(START_NS, np.zeros((4, 4), np.uint8)))
    settings = settings_for(open_bag(write_mcap(tmp_path / "a.mcap", [*scans, picture])), None, "auto")
    assert settings.dataset == "my-rover" and topics_of(settings).left_image == "/nav/left"
    assert calibration_of(settings).camera == load_calibration("simulated").camera
    assert settings_for(open_bag(write_mcap(tmp_path / "b.mcap", scans)), None, "auto").dataset == "s3li-etna"
    (datasets / "my-rover.yaml").write_text("topics: {left: /nav/left}\n")
    with pytest.raises(ConfigError, match=r"my-rover\.yaml: calibration is missing; unknown parameter topics\.left"):
        topics_of(settings)
    with pytest.raises(ConfigError, match=r"dataset: input should be 'simulated', .*'my-rover'"):
        load_settings(dataset="kitti")


def test_topics_of_the_settings_win_over_those_of_the_data_set() -> None:
    assert topics_of(load_settings()).left_image == LEFT
    settings = load_settings(dataset="s3li-vulcano", topics__cloud="/other/points")
    topics = topics_of(settings)
    assert (topics.left_image, topics.cloud, topics.left_info) == ("/g319c_left/image_raw", "/other/points", "")
