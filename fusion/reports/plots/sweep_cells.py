"""The runs of a sweep gathered in cells of one or two axes."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array

NUMERIC_AXES = ("friction", "slope_deg", "payload_kg", "speed_mps")
MAX_LEVELS = 40
"""An axis with more distinct values, as in a random sweep, is cut into bins."""
RUNS_A_CELL = 20
"""Bins are as fine as leaves a cell of two such axes about so many runs."""


def with_mobile(runs: pd.DataFrame) -> pd.DataFrame:
    """The runs (a row each) with a column `mobile`: 1 where one drove to the end, NaN where it failed."""
    mobile = (runs["status"] == "done").astype(float)
    return runs.assign(mobile=mobile.where(runs["status"] != "failed"))


def varied(runs: pd.DataFrame) -> list[str]:
    """Numeric axes with more than one value on some terrain: terrains differ in friction by themselves."""
    counts = runs.groupby("terrain")[list(NUMERIC_AXES)].nunique().max()
    return [name for name in NUMERIC_AXES if counts[name] > 1]


def plane_of(runs: pd.DataFrame) -> tuple[str, str] | None:
    """The two axes of the maps: friction and slope where both vary, else those with most levels."""
    names = varied(runs)
    if "friction" in names and "slope_deg" in names:
        return "friction", "slope_deg"
    names = sorted(names, key=lambda name: -runs[name].nunique())
    return (names[0], names[1]) if len(names) > 1 else None


@dataclass(frozen=True, eq=False)
class CellAxis:
    """Cells of one axis: centres (n,), edges (n + 1,)."""

    centres: Array
    edges: Array

    @classmethod
    def of(cls, values: pd.Series) -> Self:
        """One cell a level where there are few; equal bins otherwise."""
        distinct = np.unique(values.dropna())
        if len(distinct) > MAX_LEVELS:
            bins = int(np.clip(np.sqrt(len(values) / RUNS_A_CELL), 3, MAX_LEVELS))
            edges = np.linspace(distinct[0], distinct[-1], bins + 1)
            return cls(0.5 * (edges[1:] + edges[:-1]), edges)
        middle = 0.5 * (distinct[1:] + distinct[:-1])
        first = distinct[0] - (middle[0] - distinct[0] if len(middle) else 0.5)
        last = distinct[-1] + (distinct[-1] - middle[-1] if len(middle) else 0.5)
        return cls(distinct, np.concatenate([[first], middle, [last]]))

    def cells(self, values: pd.Series) -> NDArray[np.int64]:
        """Number of the cell (N,) of each value; -1 for NaN."""
        cell = np.clip(np.searchsorted(self.edges, values, side="right") - 1, 0, len(self.centres) - 1)
        return np.where(values.notna(), cell, -1)


def in_cells(runs: pd.DataFrame, name: str, statistic: str, axes: dict[str, CellAxis]) -> Any:
    """Statistic, "median" or "mean", of a column in each cell of one axis (n,) or of two (second, first)."""
    cells = [axis.cells(runs[column]) for column, axis in axes.items()]
    found = runs[name].groupby(cells).agg(statistic)
    numbers = [range(len(axis.centres)) for axis in axes.values()]
    if len(cells) == 1:
        return found.reindex(numbers[0]).to_numpy()
    return found.unstack(0).reindex(index=numbers[1], columns=numbers[0]).to_numpy()
