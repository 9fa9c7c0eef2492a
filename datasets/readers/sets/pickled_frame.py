"""Stand-ins for what a pickled DataFrame is made of: pickles build these, never pandas' or NumPy's own.

Each takes what the real one would take and keeps the numbers only, so that a frame written by any
pandas (its block manager before 1.3, `new_block` of 1.3 to 2.1, `_unpickle_block` since, the string
arrays of 3) reads alike, whatever pandas is installed. All check their arguments: shapes against
bytes, kinds of numbers against a short list.
"""

import math
import re
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core import limits


class StandIn:
    """Something that a pickle may hand a state to."""

    def set_state(self, state: Any) -> None:
        """Take the state that the pickle hands over."""
        raise ValueError(f"{type(self).__name__} takes no state")

    def cells(self) -> int:
        """Values that it holds: a pickle can name the same list again and again, each time to be copied."""
        return 0


class PickledDtype(StandIn):
    """`numpy.dtype` of booleans, integers, floats and objects."""

    def __init__(self, text: str, *_: Any) -> None:
        if not re.fullmatch(r"b1|[iuf][1248]|O8?", text):
            raise ValueError(f"values of the kind '{text[:20]}' are no numbers or texts")
        self.text, self.order = text, "="

    def set_state(self, state: Any) -> None:
        self.order = {"<": "<", ">": ">"}.get(state[1], "=")

    def is_object(self) -> bool:
        return self.text.startswith("O")

    def numbers(self, data: Any, shape: tuple[int, ...], order: str) -> NDArray[Any]:
        """An array over the bytes `data`, or over a list of texts and numbers where the kind is "object"."""
        count = math.prod(shape)
        if len(shape) > 2 or min(shape, default=0) < 0 or count > limits.PICKLE_CELLS:
            raise ValueError(f"an array of the shape {str(shape)[:60]}")
        if self.is_object():
            if not isinstance(data, list) or len(data) != count:
                raise ValueError("an array whose values do not fill its shape")
            return np.fromiter(data, dtype=object, count=count).reshape(shape)  # lists stand row by row
        kind = np.dtype(self.order + self.text)
        if not isinstance(data, bytes | bytearray) or len(data) != count * kind.itemsize:
            raise ValueError("an array whose bytes do not fill its shape")
        return np.frombuffer(data, kind).reshape(shape, order="F" if order == "F" else "C")


class PickledArray(StandIn):
    """`numpy.ndarray`, filled by its state."""

    values: NDArray[Any] = np.zeros(0)

    def set_state(self, state: Any) -> None:
        _, shape, kind, fortran, data = state
        self.values = kind.numbers(data, shape, "F" if fortran else "C")

    def cells(self) -> int:
        return self.values.size


def reconstruct(*_: Any) -> PickledArray:
    """`numpy._core.multiarray._reconstruct`."""
    return PickledArray()


def from_buffer(data: Any, kind: PickledDtype, shape: tuple[int, ...], order: str) -> PickledArray:
    """`numpy._core.numeric._frombuffer`."""
    array = PickledArray()
    array.values = kind.numbers(data, shape, order)
    return array


def scalar(kind: PickledDtype, data: bytes) -> Any:
    """`numpy._core.multiarray.scalar`."""
    return kind.numbers(data, (1,), "C")[0].item()


class PickledStrings(StandIn):
    """`pandas.arrays.StringArray` and `ArrowStringArray`: (N,) texts."""

    values: NDArray[Any] = np.zeros(0, dtype=object)

    def set_state(self, state: Any) -> None:
        parts = state.values() if isinstance(state, dict) else state
        found = [part.values for part in parts if isinstance(part, PickledArray)]
        if len(found) != 1:
            raise ValueError("a string array without its strings")
        self.values = found[0]


def strings_of_numpy(*_: Any) -> PickledStrings:
    """`pandas._libs.arrays.__pyx_unpickle_NDArrayBacked`."""
    return PickledStrings()


def named(*names: Any) -> tuple[Any, ...]:
    """Types that matter by their name only: `pyarrow.lib.type_for_alias`, `pandas.StringDtype`."""
    return names


def buffer(data: Any) -> bytes:
    """`pyarrow.lib.py_buffer` and `bytearray`, of bytes only: a number would make room for as many."""
    if not isinstance(data, bytes | bytearray):
        raise ValueError("a buffer of something else than bytes")
    return bytes(data)


def arrow_array(data: tuple[Any, ...]) -> PickledArray:
    """`pyarrow.lib._restore_array` of strings without missing values."""
    kind, length, _, start, (_, offsets, letters) = data[:5]
    width = {"large_string": np.int64, "string": np.int32}[kind[0]]
    ends = np.frombuffer(offsets, width)[start : start + length + 1]
    if len(ends) != length + 1 or length > limits.PICKLE_CELLS or (np.diff(ends) < 0).any() or ends[0] < 0:
        raise ValueError("an arrow array whose offsets do not fill it")
    cuts = ends.tolist()
    array = PickledArray()
    texts = (letters[a:b].decode() for a, b in pairwise(cuts))
    array.values = np.fromiter(texts, dtype=object, count=length)
    return array


def chunked(chunks: list[PickledArray], *_: Any) -> PickledArray:
    """`pyarrow.lib.chunked_array`."""
    array = PickledArray()
    if sum(chunk.cells() for chunk in chunks) > limits.PICKLE_CELLS:
        raise ValueError(f"more than {limits.PICKLE_CELLS} cells")
    array.values = np.concatenate([chunk.values for chunk in chunks])
    return array


class PickledIndex(StandIn):
    """An index: its labels, or None where it counts rows."""

    def __init__(self, _: Any, state: dict[str, Any]) -> None:
        data = state.get("data")
        self.values = None if data is None else data.values.tolist()

    def cells(self) -> int:
        return len(self.values or ())


class PickledBlock:
    """Columns of one kind: values (items, rows), or (rows,) for one column, at the places `items`."""

    def __init__(self, values: PickledArray | PickledStrings, placement: Any, ndim: int = 2) -> None:
        self.rows = np.atleast_2d(values.values)
        self.placement = placement

    def items(self, count: int) -> list[int]:
        """Places of its rows among `count` columns."""
        place = self.placement.values if isinstance(self.placement, PickledArray) else self.placement
        places = range(count)[place] if isinstance(place, slice) else np.atleast_1d(place).tolist()
        if len(places) != len(self.rows):
            raise ValueError("a block whose columns have no place")
        return list(places)


class PickledPartial(StandIn):
    """`functools.partial` of `new_block`, the one function a frame is pickled with."""

    def __init__(self, function: Callable[..., Any]) -> None:
        if function is not PickledBlock:
            raise ValueError("a partial function other than new_block")

    def set_state(self, state: Any) -> None:
        """Keeps nothing: how many dimensions a block has is seen from its values."""

    def __call__(self, values: PickledArray | PickledStrings, placement: Any) -> PickledBlock:
        return PickledBlock(values, placement)


class PickledManager(StandIn):
    """`BlockManager`: by its arguments, before pandas 1.3 by its state."""

    def __init__(self, blocks: Any = (), axes: Any = ()) -> None:
        self.blocks, self.axes = blocks, axes

    def set_state(self, state: Any) -> None:
        inner = state[3]["0.14.1"]
        self.axes = inner["axes"]
        self.blocks = [PickledBlock(block["values"], block["mgr_locs"]) for block in inner["blocks"]]

    def columns(self) -> dict[str, NDArray[Any]]:
        """Columns (N,) by name."""
        names = self.axes[0].values
        if names is None or len(set(names)) != len(names) or not all(isinstance(n, str) for n in names):
            raise ValueError("columns without names of their own")
        found: dict[str, NDArray[Any]] = {}
        for block in self.blocks:
            for row, place in zip(block.rows, block.items(len(names)), strict=True):
                found[names[place]] = row
        if len(found) != len(names) or len({len(column) for column in found.values()}) > 1:
            raise ValueError("columns that are missing or differ in length")
        if sum(len(column) for column in found.values()) > limits.PICKLE_CELLS:
            raise ValueError(f"more than {limits.PICKLE_CELLS} cells")
        return {name: found[name] for name in names}


class PickledFrame(StandIn):
    """`pandas.DataFrame`."""

    manager: PickledManager | None = None

    def set_state(self, state: Any) -> None:
        self.manager = state.get("_mgr", state.get("_data"))


def _modules(*modules: str, **names: Any) -> dict[tuple[str, str], Any]:
    return {(module, name): stand_in for module in modules for name, stand_in in names.items()}


ALLOWED: dict[tuple[str, str], Any] = {
    **_modules("pandas", "pandas.core.frame", DataFrame=PickledFrame),
    **_modules("pandas.core.internals.managers", "pandas.core.internals", BlockManager=PickledManager),
    **_modules("pandas.core.internals.blocks", new_block=PickledBlock),
    **_modules("pandas._libs.internals", _unpickle_block=PickledBlock),
    **_modules("pandas.core.indexes.base", _new_Index=PickledIndex),
    **_modules("pandas", "pandas.core.indexes.base", Index=named),
    **_modules("pandas", "pandas.core.indexes.range", RangeIndex=named),
    **_modules("pandas.core.indexes.numeric", Int64Index=named),
    **_modules("pandas.arrays", "pandas.core.arrays.string_", StringArray=PickledStrings),
    **_modules("pandas.arrays", "pandas.core.arrays.string_arrow", ArrowStringArray=PickledStrings),
    **_modules("pandas._libs.arrays", __pyx_unpickle_NDArrayBacked=strings_of_numpy),
    **_modules("pandas", "pandas.core.arrays.string_", StringDtype=named),
    **_modules("pyarrow.lib", _restore_array=arrow_array, py_buffer=buffer),
    **_modules("pyarrow.lib", type_for_alias=named, chunked_array=chunked),
    **_modules("numpy", dtype=PickledDtype, ndarray=named),
    **_modules("numpy.core.numeric", "numpy._core.numeric", _frombuffer=from_buffer),
    **_modules("numpy.core.multiarray", "numpy._core.multiarray", _reconstruct=reconstruct, scalar=scalar),
    ("functools", "partial"): PickledPartial,
    ("builtins", "bytearray"): buffer,
    ("builtins", "slice"): slice,
}
"""Every (module, name) that a pickle may ask for, and the stand-in that it gets."""
