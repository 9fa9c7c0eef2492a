"""The runs of a sweep gathered in cells of one or two axes."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array

Columns = Mapping[str, NDArray[Any]]
"""The table of a sweep by column, (N,) each; NaN where a number is null."""

NUMERIC_AXES = ("friction", "slope_deg", "payload_kg", "speed_mps")
MAX_LEVELS = 40
"""An axis with more distinct values, as in a random sweep, is cut into bins."""
RUNS_A_CELL = 20
"""Bins are as fine as leaves a cell of two such axes about so many runs."""


def columns_of(table: Any) -> dict[str, NDArray[Any]]:
    """The columns of a pyarrow `Table`: texts as objects, numbers as floats with NaN for null."""
    out: dict[str, NDArray[Any]] = {}
    for name in table.column_names:
        values = table.column(name).to_pylist()
        is_text = str(table.schema.field(name).type) == "string"
        out[name] = np.array(values, dtype=object if is_text else float)
    return out


def select(columns: Columns, rows: NDArray[np.bool_]) -> dict[str, NDArray[Any]]:
    """The rows (N,) that are True."""
    return {name: values[rows] for name, values in columns.items()}


def varied(columns: Columns) -> list[str]:
    """Numeric axes with more than one value on some terrain: terrains differ in friction by themselves."""
    terrains = [columns["terrain"] == terrain for terrain in dict.fromkeys(columns["terrain"])]
    return [name for name in NUMERIC_AXES if any(len(levels(columns[name][rows])) > 1 for rows in terrains)]


def plane_of(columns: Columns) -> tuple[str, str] | None:
    """The two axes of the maps: friction and slope where both vary, else those with most levels."""
    names = varied(columns)
    if "friction" in names and "slope_deg" in names:
        return "friction", "slope_deg"
    names = sorted(names, key=lambda name: -len(levels(columns[name])))
    return (names[0], names[1]) if len(names) > 1 else None


def levels(values: Array) -> Array:
    """Distinct values, sorted, without NaN."""
    return np.unique(values[np.isfinite(values)])


@dataclass(frozen=True, eq=False)
class CellAxis:
    """Cells of one axis: centres (n,), edges (n + 1,)."""

    centres: Array
    edges: Array

    @classmethod
    def of(cls, values: Array) -> Self:
        """One cell a level where there are few; equal bins otherwise."""
        distinct = levels(values)
        if len(distinct) > MAX_LEVELS:
            bins = int(np.clip(np.sqrt(len(values) / RUNS_A_CELL), 3, MAX_LEVELS))
            edges = np.linspace(distinct[0], distinct[-1], bins + 1)
            return cls(0.5 * (edges[1:] + edges[:-1]), edges)
        middle = 0.5 * (distinct[1:] + distinct[:-1])
        first = distinct[0] - (middle[0] - distinct[0] if len(middle) else 0.5)
        last = distinct[-1] + (distinct[-1] - middle[-1] if len(middle) else 0.5)
        return cls(distinct, np.concatenate([[first], middle, [last]]))

    def cells(self, values: Array) -> NDArray[np.int64]:
        """Number of the cell (N,) of each value; -1 for NaN."""
        cell = np.clip(np.searchsorted(self.edges, values, side="right") - 1, 0, len(self.centres) - 1)
        return np.where(np.isfinite(values), cell, -1)


def per_cell(cell: NDArray[np.int64], values: Array, count: int, statistic: str) -> Array:
    """Statistic (count,), "median" or "mean", of the finite values (N,) in each cell; NaN for none."""
    good = np.isfinite(values) & (cell >= 0)
    result = pd.Series(values[good]).groupby(cell[good]).agg(statistic)
    out = np.full(count, np.nan)
    out[result.index] = result
    return out


def in_cells(
    columns: Columns,
    values: Array,
    x: CellAxis,
    y: CellAxis,
    plane: tuple[str, str],
    statistic: str = "median",
) -> Array:
    """Statistic (rows of y, columns of x) of values (N,) in each cell of the plane."""
    column, row = x.cells(columns[plane[0]]), y.cells(columns[plane[1]])
    cell = np.where((column >= 0) & (row >= 0), row * len(x.centres) + column, -1)
    shape = (len(y.centres), len(x.centres))
    return per_cell(cell, values, shape[0] * shape[1], statistic).reshape(shape)


def mobile(columns: Columns) -> Array:
    """1 for a run (N,) that drove to the end, 0 for one that did not, NaN for one that failed."""
    status = columns["status"]
    return np.where(status == "failed", np.nan, np.where(status == "done", 1.0, 0.0))


def share_mobile(columns: Columns, x: CellAxis, y: CellAxis, plane: tuple[str, str]) -> Array:
    """Share (rows of y, columns of x) of mobile runs in each cell; NaN where there is none."""
    return in_cells(columns, mobile(columns), x, y, plane, "mean")
