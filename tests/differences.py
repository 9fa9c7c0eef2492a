"""Where two recordings differ, for tests of what reads and writes them."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np


def differences(a: Any, b: Any, where: str = "") -> list[str]:
    """Names of the fields in which two recordings (or parts of them) differ, [] when they are equal.

    Arrays are compared to the bit, except that any NaN equals any other.
    """
    if dataclasses.is_dataclass(a) and type(a) is type(b):
        names = [spec.name for spec in dataclasses.fields(a)]
        return [
            found
            for name in names
            for found in differences(getattr(a, name), getattr(b, name), f"{where}.{name}".lstrip("."))
        ]
    return [] if _equal(a, b) else [where]


def _equal(a: Any, b: Any) -> bool:
    if not (isinstance(a, np.ndarray) and isinstance(b, np.ndarray)):
        return type(a) is type(b) and bool(a == b)
    if a.shape != b.shape:
        return False
    if a.dtype.kind != "f":
        return bool(a.tolist() == b.tolist())
    return bool(((np.isnan(a) & np.isnan(b)) | ((a == b) & (np.signbit(a) == np.signbit(b)))).all())
