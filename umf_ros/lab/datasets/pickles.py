"""Pickles of other people's data sets, read without running what they may contain.

Only the few names that such a file needs are known, and what stands for them is our own: NumPy's arrays and types are
put together here from plain numbers, for NumPy itself believes whatever state a pickle gives it. Data frames are read
without pandas.
"""

from __future__ import annotations

import math
import pickle
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.errors import UmfError, one_line

Names = Mapping[str, Callable[..., Any]]

_PLAIN = re.compile(r"(?:[fiuc](?:1|2|4|8|16)|b1|O8?|[US][0-9]{1,5})")


class _DataType:
    """Stands for a `numpy.dtype`: numbers, truth values, text and objects, nothing composed."""

    def __init__(self, name: str, *_: Any) -> None:
        if not isinstance(name, str) or not _PLAIN.fullmatch(name):
            raise pickle.UnpicklingError(f"it holds an array of type {str(name)[:40]!r}")
        self.value = np.dtype(name)

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, order, *composed = state
        if order not in ("<", ">", "=", "|") or any(part is not None for part in composed[:3]):
            raise pickle.UnpicklingError("it holds an array of a composed type")
        self.value = self.value.newbyteorder(order)


class _Array:
    """Stands for a `numpy.ndarray` until all of its state has come."""

    def __init__(self, *_: Any) -> None:
        self.value: NDArray[Any] = np.empty(0)

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, shape, kind, by_column, data = state
        self.value = _from_data(data, kind, shape, "F" if by_column else "C")


def _from_data(data: Any, kind: Any, shape: Any, order: str) -> NDArray[Any]:
    if not isinstance(kind, _DataType) or not isinstance(shape, tuple) or order not in ("C", "F"):
        raise pickle.UnpicklingError("it holds an array of no type or shape")
    if not all(type(size) is int and size >= 0 for size in shape) or len(shape) > 8:
        raise pickle.UnpicklingError("it holds an array of no shape")
    count = math.prod(shape)
    if kind.value.hasobject:
        if not isinstance(data, list) or len(data) != count:
            raise pickle.UnpicklingError("it holds an array whose objects do not fit its shape")
        objects = np.empty(count, object)
        objects[:] = data if count != 1 else [data[0]]
        return objects.reshape(shape, order="F" if order == "F" else "C")
    if not isinstance(data, bytes | bytearray) or len(data) != count * kind.value.itemsize:
        raise pickle.UnpicklingError("it holds an array whose bytes do not fit its shape")
    return np.frombuffer(bytes(data), kind.value).reshape(shape, order="F" if order == "F" else "C").copy(order="K")


def _frombuffer(data: Any, kind: Any, shape: Any, order: str, *_: Any) -> NDArray[Any]:
    return _from_data(data, kind, shape, order)


def _scalar(kind: Any, data: Any) -> Any:
    return _from_data([data] if kind.value.hasobject else data, kind, (), "C")[()]


def _latin1(text: str, encoding: str) -> bytes:
    """How bytes are written by protocols that know none."""
    if encoding != "latin1":
        raise pickle.UnpicklingError(f"it asks for the encoding {encoding[:40]!r}")
    return text.encode("latin1")


_NUMPY: dict[str, Callable[..., Any]] = {
    "numpy.ndarray": _Array,
    "numpy.dtype": _DataType,
    "builtins.slice": slice,
    "_codecs.encode": _latin1,
    "__builtin__.bytes": lambda: b"",
}
for _package in ("numpy.core", "numpy._core"):
    _NUMPY |= {f"{_package}.multiarray._reconstruct": _Array, f"{_package}.multiarray.scalar": _scalar}
    _NUMPY[f"{_package}.numeric._frombuffer"] = _frombuffer


class _Unpickler(pickle._Unpickler):
    """The one written in Python: that in C takes the memory that a hostile file names."""

    def __init__(self, stream: Any, known: Names) -> None:
        super().__init__(stream)
        self._known = known

    def find_class(self, module: str, name: str) -> Any:
        # a class is asked for by its module, which is wherever the writer's script had it
        found = self._known.get(f"{module}.{name}", self._known.get(name))
        if found is None:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}, which has no business there")
        return found


def _plain(value: Any) -> Any:
    """The array, where something stands for one."""
    return value.value if isinstance(value, _Array) else value


def _settled(value: Any, done: dict[int, Any]) -> Any:
    """`value` with arrays in place of what stood for them, however deep."""
    if id(value) in done:
        return done[id(value)]
    if isinstance(value, _Array):
        done[id(value)] = value.value
        return _settled(value.value, done)
    done[id(value)] = value
    if isinstance(value, np.ndarray):
        if value.dtype.hasobject:
            for index, item in enumerate(value.flat):
                value.flat[index] = _settled(item, done)
    elif isinstance(value, list):
        value[:] = [_settled(item, done) for item in value]
    elif isinstance(value, dict):
        value.update({key: _settled(item, done) for key, item in value.items()})
    elif type(value) is tuple:
        done[id(value)] = tuple(_settled(item, done) for item in value)
    elif hasattr(value, "__dict__") and not callable(value):
        vars(value).update({name: _settled(item, done) for name, item in vars(value).items()})
    return done[id(value)]


def load_pickle(path: Path, known: Names | None = None) -> Any:
    """What a pickle holds.

    Args:
        path: the file.
        known: what stands for the names it may ask for, by `module.name` or by name alone, beside NumPy's arrays.

    Raises:
        UmfError: the file is missing, damaged, or asks for anything else.
    """
    try:
        with path.open("rb") as stream:
            return _settled(_Unpickler(stream, _NUMPY | dict(known or {})).load(), {})
    except OSError as error:
        raise UmfError(f"cannot read {path}: {error.strerror}") from None
    except Exception as error:  # damaged bytes provoke anything
        raise UmfError(f"cannot read the pickle {path}: {' '.join(str(error).split())[:200]}") from None


class _Frame:
    """Stands for a pandas DataFrame."""

    manager: _Manager

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.manager = state["_mgr"]


class _Manager:
    """Stands for the blocks and axes of a DataFrame."""

    def __init__(self, blocks: tuple[tuple[Any, Any], ...], axes: list[Any]) -> None:
        self.blocks, self.names = blocks, axes[0]


class _Strings:
    """Stands for an array of strings of pandas 3."""

    def __init__(self, *_: Any) -> None:
        self.values = np.empty(0, object)

    def __setstate__(self, state: tuple[Any, NDArray[Any], Any]) -> None:
        self.values = _plain(state[1])


def _index(_: Any, content: dict[str, Any]) -> list[Any]:
    data = _plain(content.get("data", ()))
    return list(data.values if isinstance(data, _Strings) else data)


_PANDAS: dict[str, Callable[..., Any]] = {
    "pandas.core.frame.DataFrame": _Frame,
    "pandas.DataFrame": _Frame,
    "pandas.core.internals.managers.BlockManager": _Manager,
    "pandas._libs.internals._unpickle_block": lambda values, place, dimensions: (values, place),
    "pandas.core.indexes.base._new_Index": _index,
    "pandas._libs.arrays.__pyx_unpickle_NDArrayBacked": _Strings,
    "pandas.StringDtype": lambda *_: None,
    # only named as arguments of the above
    "pandas.core.indexes.base.Index": object,
    "pandas.core.indexes.range.RangeIndex": object,
    "pandas.Index": object,
    "pandas.RangeIndex": object,
    "pandas.arrays.StringArray": object,
}


def load_data_frame(path: Path) -> dict[str, NDArray[Any]]:
    """The columns of a pickled pandas DataFrame (pandas 1.3 to 3), by name.

    Raises:
        UmfError: the file cannot be read or is no DataFrame of plain columns.
    """
    frame = load_pickle(path, _PANDAS)
    if not isinstance(frame, _Frame) or not isinstance(getattr(frame, "manager", None), _Manager):
        raise UmfError(f"{path} holds a {type(frame).__name__}, not a pandas DataFrame")
    try:
        return _columns(frame, path)
    except (ValueError, TypeError, LookupError) as error:
        raise UmfError(f"{path} is no DataFrame of plain columns: {one_line(error)}") from None


def _columns(frame: _Frame, path: Path) -> dict[str, NDArray[Any]]:
    names = frame.manager.names
    columns: dict[str, NDArray[Any]] = {}
    for values, place in frame.manager.blocks:
        rows = values.values if isinstance(values, _Strings) else values
        where = np.arange(len(names))[place]
        if not isinstance(rows, np.ndarray) or len(where) != len(np.atleast_2d(rows)):
            raise UmfError(f"{path}: cannot read the columns {', '.join(str(names[i]) for i in where)}")
        columns |= {str(names[column]): row for column, row in zip(where, np.atleast_2d(rows), strict=True)}
    return columns
