"""Trials of the CMU single-wheel test bed (MATLAB v5): recognised, but not a recording."""

from __future__ import annotations

from pathlib import Path
from typing import NoReturn

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.readers.formats import Request
from terrafusion.datasets.readers.sets.matlab_v5 import is_v5, structures_with
from terrafusion.datasets.readers.sets.single_wheel import FIELDS, read_wheel_trials


def claims(path: Path, head: bytes) -> bool:
    """Whether it is a MATLAB v5 file with the trials' fields."""
    return is_v5(head) and structures_with(path, FIELDS)


def read(request: Request) -> NoReturn:
    """Refuse, with the function that reads it.

    Raises:
        DataError: always.
    """
    trials = read_wheel_trials(request.path)
    raise DataError(
        f"holds {len(trials)} trials of a single wheel, not a drive",
        file=request.path,
        remedy="`terrafusion inspect` sums them up; in Python, single_wheel.read_wheel_trials reads them",
    )
