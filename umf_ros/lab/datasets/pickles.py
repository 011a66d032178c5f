"""Pickles of other people's data sets, read without running what they may contain.

Only the few names that such a file needs are known; every other one is refused. Data frames
are read without pandas.
"""

from __future__ import annotations

import codecs
import pickle
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy._core.numeric as _numeric
from numpy._core.multiarray import _reconstruct, scalar
from numpy.typing import NDArray

from umf_ros.errors import UmfError

Names = Mapping[str, Callable[..., Any]]

_NUMPY: dict[str, Callable[..., Any]] = {
    "numpy.ndarray": np.ndarray,
    "numpy.dtype": np.dtype,
    "builtins.slice": slice,
    "_codecs.encode": codecs.encode,
}
for _package in ("numpy.core", "numpy._core"):
    _NUMPY |= {f"{_package}.multiarray._reconstruct": _reconstruct, f"{_package}.multiarray.scalar": scalar}
    _NUMPY[f"{_package}.numeric._frombuffer"] = _numeric._frombuffer  # type: ignore[attr-defined]


class _Unpickler(pickle.Unpickler):
    def __init__(self, stream: Any, known: Names) -> None:
        super().__init__(stream)
        self._known = known

    def find_class(self, module: str, name: str) -> Any:
        # a class is asked for by its module, which is wherever the writer's script had it
        found = self._known.get(f"{module}.{name}", self._known.get(name))
        if found is None:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}, which has no business there")
        return found


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
            return _Unpickler(stream, _NUMPY | dict(known or {})).load()
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
        self.values = state[1]


def _index(_: Any, content: dict[str, Any]) -> list[Any]:
    data = content.get("data", ())
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
    if not isinstance(frame, _Frame):
        raise UmfError(f"{path} holds a {type(frame).__name__}, not a pandas DataFrame")
    names = frame.manager.names
    columns: dict[str, NDArray[Any]] = {}
    for values, place in frame.manager.blocks:
        rows = values.values if isinstance(values, _Strings) else values
        where = np.arange(len(names))[place]
        if not isinstance(rows, np.ndarray) or len(where) != len(np.atleast_2d(rows)):
            raise UmfError(f"{path}: cannot read the columns {', '.join(str(names[i]) for i in where)}")
        columns |= {str(names[column]): row for column, row in zip(where, np.atleast_2d(rows), strict=True)}
    return columns
