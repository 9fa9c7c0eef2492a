"""Tables out of pickled DataFrames, without running what else a pickle can hold.

A pickle is a program: it names functions and calls them. Here it gets the stand-ins of
`pickled_frame.ALLOWED` and nothing else, whatever it names; only the instructions that a frame
needs are obeyed; and what it calls must be one of the stand-ins.
"""

import io
import pickle
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core import limits
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.quantity import shown
from terrafusion.datasets.readers.sets.pickled_frame import ALLOWED, PickledFrame, PickledPartial, StandIn

LARGEST = 1e30
"""No number of a log is larger; squares of these are still numbers."""


_OPCODES = b"".join(
    (
        pickle.PROTO + pickle.FRAME + pickle.MARK + pickle.STOP,
        pickle.NONE + pickle.NEWTRUE + pickle.NEWFALSE,
        pickle.BININT + pickle.BININT1 + pickle.BININT2 + pickle.LONG1 + pickle.BINFLOAT,
        pickle.SHORT_BINUNICODE + pickle.BINUNICODE,
        pickle.SHORT_BINBYTES + pickle.BINBYTES + pickle.BINBYTES8 + pickle.BYTEARRAY8,
        pickle.EMPTY_LIST + pickle.APPEND + pickle.APPENDS,
        pickle.EMPTY_DICT + pickle.SETITEM + pickle.SETITEMS,
        pickle.EMPTY_TUPLE + pickle.TUPLE + pickle.TUPLE1 + pickle.TUPLE2 + pickle.TUPLE3,
        pickle.MEMOIZE + pickle.BINPUT + pickle.LONG_BINPUT + pickle.BINGET + pickle.LONG_BINGET,
        pickle.GLOBAL + pickle.STACK_GLOBAL + pickle.NEWOBJ + pickle.REDUCE + pickle.BUILD,
    )
)
"""All instructions that a DataFrame is pickled with, in protocols 3 to 5."""

_BROKEN = (
    pickle.UnpicklingError,
    EOFError,
    LookupError,
    TypeError,
    ValueError,
    AttributeError,
    ArithmeticError,
    RecursionError,
    MemoryError,
    struct.error,
)


class _RefusedError(Exception):
    """The pickle asks for what no table needs."""


class _Machine(pickle._Unpickler):
    """The pickle machine in Python, not in C: its instructions can be taken away, and its memo is a dict."""

    cells: int = 0
    stack: list[Any]
    read: Callable[[int], bytes]
    append: Callable[[Any], None]
    dispatch: ClassVar[dict[int, Callable[..., None]]] = {
        code: pickle._Unpickler.dispatch[code] for code in _OPCODES
    }

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in ALLOWED:
            raise _RefusedError(f"{module}.{name}")
        return ALLOWED[module, name]

    def _call(self, function: Any, arguments: Any) -> Any:
        known = isinstance(function, PickledPartial) or any(
            function is stand_in for stand_in in ALLOWED.values()
        )
        if not known or not isinstance(arguments, tuple):
            raise _RefusedError(f"to call {type(function).__name__}")
        return self._counted(function(*arguments))

    def _counted(self, made: Any) -> Any:
        self.cells += made.cells() if isinstance(made, StandIn) else 0
        if self.cells > limits.PICKLE_CELLS:
            raise ValueError(f"more than {limits.PICKLE_CELLS} cells")
        return made

    def load_reduce(self) -> None:
        arguments = self.stack.pop()
        self.stack[-1] = self._call(self.stack[-1], arguments)

    def load_build(self) -> None:
        state = self.stack.pop()
        if not isinstance(self.stack[-1], StandIn):
            raise _RefusedError(f"to change {type(self.stack[-1]).__name__}")
        self.stack[-1].set_state(state)
        self._counted(self.stack[-1])

    def load_bytes8(self) -> None:
        """Reads at most what is there; the library's own makes room for what is claimed."""
        (size,) = struct.unpack("<Q", self.read(8))
        if size > limits.PICKLE_BYTES:
            raise EOFError
        self.append(self.read(size))

    dispatch[pickle.REDUCE[0]] = dispatch[pickle.NEWOBJ[0]] = load_reduce
    dispatch[pickle.BUILD[0]] = load_build
    dispatch[pickle.BYTEARRAY8[0]] = dispatch[pickle.BINBYTES8[0]] = load_bytes8


def read_table(path: Path) -> dict[str, NDArray[Any]]:
    """The columns (N,) of a pickled DataFrame by name: numbers, or objects that are texts or numbers.

    Raises:
        DataError: the pickle asks for anything but a DataFrame, is cut off or garbled, or too large.
    """
    try:
        size = path.stat().st_size
        data = path.read_bytes() if size <= limits.PICKLE_BYTES else b""
    except OSError as error:
        raise DataError(f"cannot be read: {error.strerror or error}") from None
    if not data:
        what = f"the pickle has {size / 2**20:.0f} MiB" if size else "the file is empty"
        raise DataError(what, remedy=f"give a table of up to {limits.PICKLE_BYTES // 2**20} MiB")
    try:
        frame = _Machine(io.BytesIO(data)).load()
        if not isinstance(frame, PickledFrame) or frame.manager is None:
            raise DataError("the pickle holds no DataFrame", remedy="pickle a pandas DataFrame")
        return frame.manager.columns()
    except _RefusedError as refused:
        raise DataError(
            f"the pickle asks for {shown(str(refused))}, which no table needs",
            remedy="do not trust this file",
        ) from None
    except _BROKEN as error:
        why = f": {shown(str(error))}" if str(error) else ""
        raise DataError(
            f"the pickle cannot be read{why}", remedy="copy it again; it holds no plain DataFrame"
        ) from None


def numbers(column: NDArray[Any]) -> NDArray[np.float64]:
    """A column (N,) of numbers, or of texts that are numbers; an empty text or None is NaN.

    Raises:
        ValueError: a cell is something else, or beyond `LARGEST`.
    """
    if column.dtype == object:
        cells = [np.nan if cell is None or cell == "" else cell for cell in column.tolist()]
        if not all(isinstance(cell, str | float | int) for cell in cells):
            raise ValueError("a cell is no number")
        values = np.array([float(cell) for cell in cells])
    else:
        values = column.astype(float)
        values[np.isnan(values)] = np.nan  # a signalling NaN, which only broken files have, warns when used
    if (np.abs(values) > LARGEST).any():
        raise ValueError(f"a number beyond {LARGEST:g}")
    return values
