from __future__ import annotations

import contextlib
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
from numpy._core.multiarray import _reconstruct

from umf_ros.core.errors import UmfError
from umf_ros.lab.datasets.s3li import load_data_frame, load_pickle

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


MANAGER = b"pandas.core.internals.managers\nBlockManager"


def test_what_is_no_data_frame_is_said(tmp_path: Path) -> None:
    with pytest.raises(UmfError, match="holds a dict, not a pandas DataFrame"):
        load_data_frame(dump(tmp_path / "a.pkl", {"img_path": []}))


@pytest.mark.parametrize(
    "state",
    [b"", b"}(X\x04\x00\x00\x00_mgrI3\nub", b"}(X\x04\x00\x00\x00_mgrc" + MANAGER + b"\n((I1\nI2\nt](I5\naltRub"],
    ids=["none", "a number", "blocks that are none"],
)
def test_a_data_frame_that_lies_is_one_line(tmp_path: Path, state: bytes) -> None:
    (tmp_path / "a.pkl").write_bytes(b"cpandas\nDataFrame\n)\x81" + state + b".")
    with pytest.raises(UmfError) as caught:
        load_data_frame(tmp_path / "a.pkl")
    assert "\n" not in str(caught.value)


def array_state(shape: object, kind: object, data: object) -> bytes:
    """A pickle of an array whose state is whatever is asked for."""

    class Forged:
        def __reduce__(self):
            return _reconstruct, (np.ndarray, (0,), b"b"), (1, shape, kind, False, data)

    return pickle.dumps(Forged())


@pytest.mark.parametrize(
    ("shape", "kind", "data"),
    [
        ((10**9,), np.dtype("f8"), b"\0" * 16),
        ((-1,), np.dtype("f8"), b"\0" * 8),
        ((2**62, 4), np.dtype("f8"), b""),
        ((1,), np.dtype("O"), b"\x41" * 8),  # a pointer to anywhere
        ((2,), np.dtype("O"), [1]),
        ((1,), np.dtype([("a", "O"), ("b", "f8")]), b"\x41" * 16),
        ((1,), np.dtype("V16"), b"\x41" * 16),
        ((1,), np.dtype("M8[ns]"), b"\x41" * 8),
    ],
)
def test_a_forged_state_is_refused_and_crashes_nothing(
    tmp_path: Path, shape: object, kind: np.dtype, data: object
) -> None:
    (tmp_path / "a.pickle").write_bytes(array_state(shape, kind, data))
    with pytest.raises(UmfError, match="cannot read the pickle") as caught:
        load_pickle(tmp_path / "a.pickle")
    assert "\n" not in str(caught.value)


def test_a_forged_type_is_refused(tmp_path: Path) -> None:
    class Forged:
        def __reduce__(self):
            return np.dtype, ("f8", False, True), (3, "<", None, ("a",), {"a": (np.dtype("O"), 0)}, 8, 1, 27)

    with pytest.raises(UmfError, match="composed type"):
        load_pickle(dump(tmp_path / "a.pickle", Forged()))


def test_a_memo_of_two_thousand_million_entries_costs_no_memory(tmp_path: Path) -> None:
    (tmp_path / "a.pickle").write_bytes(b"\x80\x04Nr\xff\xff\xff\x7f.")
    assert load_pickle(tmp_path / "a.pickle") is None


def test_what_numpy_writes_comes_back_whatever_its_order(tmp_path: Path) -> None:
    nested = np.empty(2, object)
    nested[:] = [np.arange(3, dtype=">i4"), {"x": np.array(["ab", "c"])}]
    content = [np.zeros((0, 3)), np.asfortranarray(np.arange(6.0).reshape(2, 3)), nested, np.array(True), np.float32(2)]
    for protocol in (2, 5):
        found = load_pickle(dump(tmp_path / "a.pickle", content, protocol))
        assert found[0].shape == (0, 3) and np.array_equal(found[1], content[1])
        assert found[2][0].tolist() == [0, 1, 2] and found[2][1]["x"].tolist() == ["ab", "c"]
        assert found[3] == np.array(True) and found[4] == 2


def test_mutated_pickles_are_read_or_refused(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    whole = pickle.dumps({"a": [np.arange(50.0), "text", np.float64(1)], "b": np.array([None, "x"], object)}, 4)
    for _ in range(300):
        mutated = bytearray(whole)
        for place in rng.integers(0, len(whole), rng.integers(1, 6)):
            mutated[place] = rng.integers(0, 256)
        (tmp_path / "a.pickle").write_bytes(mutated)
        with contextlib.suppress(UmfError):
            load_pickle(tmp_path / "a.pickle")
