from __future__ import annotations

import os
import pickle
from pathlib import Path

import numpy as np
import pytest

from umf_ros.errors import UmfError
from umf_ros.lab.datasets.pickles import load_data_frame, load_pickle

DATA = Path(__file__).parent / "data"


class Trap:
    """Runs a command when it is unpickled carelessly."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self):
        return os.system, (f"touch {self.mark}",)


def dump(path: Path, content: object, protocol: int = pickle.HIGHEST_PROTOCOL) -> Path:
    path.write_bytes(pickle.dumps(content, protocol=protocol))
    return path


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_plain_content_and_arrays_come_back(tmp_path: Path, protocol: int) -> None:
    content = {1: [np.arange(6.0).reshape(2, 3).T, "a"], "b": (np.float64(2.5), None, np.array(["x"], object))}
    found = load_pickle(dump(tmp_path / "a.pickle", content, protocol))
    assert np.array_equal(found[1][0], content[1][0]) and found[1][1] == "a"
    assert found["b"][:2] == (2.5, None) and found["b"][2].tolist() == ["x"]


def test_code_is_refused_and_not_run(tmp_path: Path) -> None:
    mark = tmp_path / "ran"
    with pytest.raises(UmfError, match=r"posix\.system, which has no business there"):
        load_pickle(dump(tmp_path / "trap.pickle", {"data": Trap(mark)}))
    with pytest.raises(UmfError, match=r"posix\.system"):
        load_data_frame(dump(tmp_path / "trap.pkl", Trap(mark)))
    assert not mark.exists()


def test_builtins_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.pickle").write_bytes(b"cbuiltins\neval\n(S'1+1'\ntR.")
    with pytest.raises(UmfError, match=r"builtins\.eval"):
        load_pickle(tmp_path / "a.pickle")


@pytest.mark.parametrize("content", [b"", b"not a pickle", pickle.dumps(list(range(1000)))[:50]])
def test_damage_is_one_clear_error(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.pickle").write_bytes(content)
    with pytest.raises(UmfError, match="cannot read the pickle"):
        load_pickle(tmp_path / "a.pickle")
    with pytest.raises(UmfError, match="No such file"):
        load_pickle(tmp_path / "b.pickle")


@pytest.mark.parametrize("version", [2, 3])
def test_a_data_frame_is_read_without_pandas(version: int) -> None:
    """The files were written by pandas 2.2.3 and 3.1.1 themselves, through `DataFrame.to_pickle`."""
    table = load_data_frame(DATA / f"toolkit_pandas{version}.pkl")
    assert sorted(table) == sorted(
        "seq_name time_stamp img_path overlay point_cloud latitude longitude elevation orientation "
        "slam_orientation slam_position".split()
    )
    assert table["time_stamp"].tolist() == [1625680800.0 + 0.5 * i for i in range(5)]
    assert table["elevation"].tolist() == [2650.0, 2651, 2652, 2653, 2654]
    assert table["orientation"] == pytest.approx([0, 0.1, 0.2, 0.3, 0.4])
    assert table["img_path"][3] == "/data/s3li/images/s3li_loops/left/0003.png"
    assert table["point_cloud"][4].shape == (7, 3) and table["point_cloud"][4][:, 2].min() > 8
    assert table["slam_position"][2] == pytest.approx([2.22, 0.2, 0.1])


def test_what_is_no_data_frame_is_said(tmp_path: Path) -> None:
    with pytest.raises(UmfError, match="holds a dict, not a pandas DataFrame"):
        load_data_frame(dump(tmp_path / "a.pkl", {"img_path": []}))
