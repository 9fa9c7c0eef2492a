"""Types of arrays, and arrays of texts."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Array of floating-point numbers; shapes are in the docstrings."""
Complex = NDArray[np.complex128]
"""Array of complex numbers, such as positions east + i north."""
TimesNs = NDArray[np.int64]
"""Times in nanoseconds."""
Mask = NDArray[np.bool_]
"""Array of truth values."""


def distinct(texts: NDArray[Any]) -> tuple[list[str], NDArray[np.intp]]:
    """The different texts of (N,), in order of appearance, and which of them each is (N,).

    NumPy's own arrays of texts give every one the room of the longest.
    """
    listed = list(map(str, texts.tolist()))
    number = {text: k for k, text in enumerate(dict.fromkeys(listed))}
    return list(number), np.fromiter(map(number.__getitem__, listed), dtype=np.intp, count=len(listed))
