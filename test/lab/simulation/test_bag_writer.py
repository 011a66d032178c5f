from __future__ import annotations

import errno
from pathlib import Path

import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from umf_ros.bags.reader import message_types, open_bag
from umf_ros.core.errors import OutputError
from umf_ros.lab.simulation.bag_writer import BagWriter


def text(value: str):
    return message_types().types["std_msgs/msg/String"](data=value)


def write_some(path: Path) -> None:
    with BagWriter(path) as bag:
        bag.note("origin", {"seed": "3"})
        for index in range(5):
            bag.write("/words", text(f"word {index}"), 10**9 + index)


def test_a_bag_is_read_back_by_our_reader_mcap_and_rosbags(tmp_path):
    path = tmp_path / "new" / "words.mcap"
    write_some(path)
    assert [message.data for _, _, message in open_bag(path).messages()] == [f"word {i}" for i in range(5)]
    with path.open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == "ros2"
        schemas = [
            (schema.name, schema.encoding, channel.message_encoding) for schema, channel, _ in reader.iter_messages()
        ]
        assert set(schemas) == {("std_msgs/msg/String", "ros2msg", "cdr")}
        assert next(reader.iter_metadata()).metadata == {"seed": "3"}
    with AnyReader([path]) as reader:
        stamps = [stamp for _, stamp, _ in reader.messages()]
    assert stamps == [10**9 + index for index in range(5)]


def test_the_same_messages_give_the_same_bytes(tmp_path):
    for name in ("a.mcap", "b.mcap"):
        write_some(tmp_path / name)
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_an_interrupted_bag_leaves_nothing(tmp_path):
    with pytest.raises(KeyboardInterrupt), BagWriter(tmp_path / "half.mcap") as bag:
        bag.write("/words", text("first"), 1)
        assert not (tmp_path / "half.mcap").exists()
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_a_failed_bag_leaves_the_older_one_alone(tmp_path):
    write_some(tmp_path / "words.mcap")
    before = (tmp_path / "words.mcap").read_bytes()
    with pytest.raises(ValueError, match="broken"), BagWriter(tmp_path / "words.mcap"):
        raise ValueError("broken")
    assert (tmp_path / "words.mcap").read_bytes() == before


class FullDisk:
    """A stream on a disk with no room left."""

    def __init__(self, stream):
        self._stream = stream

    def write(self, data):
        raise OSError(errno.ENOSPC, "No space left on device")

    def __getattr__(self, name):
        return getattr(self._stream, name)


def test_a_full_disk_is_one_clear_line_and_leaves_nothing(tmp_path, monkeypatch):
    real_open = Path.open
    monkeypatch.setattr(Path, "open", lambda self, *arguments: FullDisk(real_open(self, *arguments)))
    with pytest.raises(OutputError, match=r"cannot write .*full\.mcap: No space left on device$"):
        write_some(tmp_path / "full.mcap")
    assert list(tmp_path.iterdir()) == []


def test_paths_that_cannot_be_written_are_named(tmp_path):
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file" / "bag.mcap", tmp_path):
        with pytest.raises(OutputError, match="cannot write"):
            BagWriter(path)


def test_a_topic_keeps_its_type(tmp_path):
    other = message_types().types["std_msgs/msg/Bool"](data=True)
    with pytest.raises(OutputError, match="/words holds std_msgs/msg/String"), BagWriter(tmp_path / "b.mcap") as bag:
        bag.write("/words", text("one"), 1)
        bag.write("/words", other, 2)
