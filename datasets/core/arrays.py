"""Types of arrays, rows in time, and arrays of texts."""

import dataclasses
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Array of floating-point numbers; shapes are in the docstrings."""
Complex = NDArray[np.complex128]
"""Array of complex numbers, such as positions east + i north."""
TimesNs = NDArray[np.int64]
"""Times in nanoseconds."""
Stamp = int | np.integer | np.datetime64
"""A time as callers give it: whole nanoseconds, or a datetime64."""
Mask = NDArray[np.bool_]
"""Array of truth values."""


class TimeRows:
    """A dataclass of arrays whose first axis is time, `t_ns` (N,)."""

    t_ns: TimesNs

    def __len__(self) -> int:
        return len(self.t_ns)

    def __repr__(self) -> str:
        seconds = float((self.t_ns[-1:] - self.t_ns[:1]).sum()) * 1e-9
        fields = [
            f"{name} {value.shape}" if isinstance(value, np.ndarray) else f"{name} {value!r}"
            for name, value in vars(self).items()
            if value is not None
        ]
        return f"{type(self).__name__}: {len(self)} rows over {seconds:.1f} s; {', '.join(fields)}"

    def select(self, rows: Any) -> Self:
        """The same with the rows of a boolean mask, slice or index array."""
        changed = {name: value[rows] for name, value in vars(self).items() if isinstance(value, np.ndarray)}
        return dataclasses.replace(self, **changed)  # type: ignore[type-var]

    def between(self, start_ns: int, end_ns: int) -> Self:
        """Rows with start_ns <= t < end_ns."""
        first, last = np.searchsorted(self.t_ns, [start_ns, end_ns], side="left")
        return self.select(slice(int(first), int(last)))


def distinct(texts: NDArray[Any]) -> tuple[list[str], NDArray[np.intp]]:
    """The different texts of (N,), in order of appearance, and which of them each is (N,).

    NumPy's own arrays of texts give every one the room of the longest.
    """
    listed = list(map(str, texts.tolist()))
    number = {text: k for k, text in enumerate(dict.fromkeys(listed))}
    return list(number), np.fromiter(map(number.__getitem__, listed), dtype=np.intp, count=len(listed))
