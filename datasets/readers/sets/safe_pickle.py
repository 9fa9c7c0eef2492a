"""Tables out of pickled DataFrames.

A pickle is a program: it names functions and calls them. Give only bytes whose SHA-256 is in a catalogue: a
crafted pickle can crash the process. As a catalogue may come from someone else, too, a pickle gets the parts
of a DataFrame and no other function.
"""

import io
import pickle
import struct
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.quantity import shown

LARGEST = 1e30
"""No number of a log is larger; squares of these are still numbers."""

ALLOWED = {
    f"{module}.{name}"
    for modules, names in {
        "pandas pandas.core.frame": "DataFrame",
        "pandas.core.internals pandas.core.internals.managers": "BlockManager",
        "pandas.core.internals.blocks": "new_block",
        "pandas._libs.internals": "_unpickle_block",
        "pandas.core.indexes.base": "_new_Index",
        "pandas pandas.core.indexes.base": "Index",
        "pandas pandas.core.indexes.range": "RangeIndex",
        "pandas.core.indexes.numeric": "Int64Index",
        "pandas.arrays pandas.core.arrays.string_": "StringArray",
        "pandas.arrays pandas.core.arrays.string_arrow": "ArrowStringArray",
        "pandas pandas.core.arrays.string_": "StringDtype",
        "pandas._libs.arrays": "__pyx_unpickle_NDArrayBacked",
        "pyarrow.lib": "_restore_array py_buffer type_for_alias chunked_array",
        "numpy": "dtype ndarray",
        "numpy.core.numeric numpy._core.numeric": "_frombuffer",
        "numpy.core.multiarray numpy._core.multiarray": "_reconstruct scalar",
        "functools": "partial",
        "builtins": "bytearray slice",
    }.items()
    for module in modules.split()
    for name in names.split()
}
"""What pandas of any version pickles a DataFrame of numbers and texts with."""

_BROKEN = (
    pickle.UnpicklingError,
    EOFError,
    ImportError,
    LookupError,
    TypeError,
    ValueError,
    AttributeError,
    ArithmeticError,
    AssertionError,
    RecursionError,
    MemoryError,
    struct.error,
)


def read_table(data: bytes) -> dict[str, NDArray[Any]]:
    """The columns (N,) of a pickled DataFrame by name: numbers, or objects that are texts or numbers.

    Raises:
        DataError: the pickle asks for anything but a DataFrame, or is cut off or garbled.
    """
    import pandas as pd
    from pandas.compat.pickle_compat import Unpickler  # type: ignore[import-not-found]

    class Frames(Unpickler):
        """The reader behind `pd.read_pickle`, which takes frames of older versions of pandas, too."""

        def find_class(self, module: str, name: str) -> Any:
            if f"{module}.{name}" not in ALLOWED:
                raise DataError(
                    f"the pickle asks for {shown(f'{module}.{name}')}, which no table needs",
                    remedy="do not trust this file",
                )
            return super().find_class(module, name)

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of modules that have moved
            frame = Frames(io.BytesIO(data)).load()
        if not isinstance(frame, pd.DataFrame):
            raise DataError("the pickle holds no DataFrame", remedy="pickle a pandas DataFrame")
        if not frame.columns.is_unique or not all(isinstance(name, str) for name in frame.columns):
            raise ValueError("columns without names of their own")
        return {name: _values(frame[name]) for name in frame.columns}
    except _BROKEN as error:
        why = f": {shown(str(error))}" if str(error) else ""
        raise DataError(
            f"the pickle cannot be read{why}", remedy="copy it again; it holds no plain DataFrame"
        ) from None


def _values(column: Any) -> NDArray[Any]:
    kind = column.dtype
    return np.asarray(column.to_numpy() if isinstance(kind, np.dtype) else column.to_numpy(dtype=object))


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
