"""Runs gathered in cells: levels and bins, medians, shares, and which axes the plots take."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from terrafusion.fusion.reports.plots.sweep_cells import (
    CellAxis,
    in_cells,
    plane_of,
    varied,
    with_mobile,
)


def table(**columns: list[Any]) -> pd.DataFrame:
    still = {"friction": 0.5, "slope_deg": 0.0, "payload_kg": 0.0, "speed_mps": 1.0, "terrain": "mud"}
    given = pd.DataFrame(columns)
    return given.assign(**{name: value for name, value in still.items() if name not in columns})


def test_levels_have_a_cell_each_and_many_values_share_bins() -> None:
    few = CellAxis.of(pd.Series([0.0, 5.0, 20.0, 5.0]))
    np.testing.assert_array_equal(few.centres, [0.0, 5.0, 20.0])
    np.testing.assert_array_equal(few.edges, [-2.5, 2.5, 12.5, 27.5])
    np.testing.assert_array_equal(few.cells(pd.Series([0.0, 5.0, 20.0, np.nan])), [0, 1, 2, -1])
    values = pd.Series(np.linspace(0.0, 1.0, 1000))
    many = CellAxis.of(values)
    assert 3 <= len(many.centres) < 40
    assert set(many.cells(values)) == set(range(len(many.centres)))


def test_medians_and_shares_of_cells() -> None:
    runs = table(
        friction=[0.2, 0.2, 0.2, 0.8, 0.8],
        slope_deg=[0.0, 0.0, 0.0, 0.0, 9.0],
        energy=[1.0, 2.0, 30.0, np.nan, 7.0],
        status=["done", "done", "immobilised", "failed", "slid"],
    )
    axes = {name: CellAxis.of(runs[name]) for name in ("friction", "slope_deg")}
    nan = np.nan
    np.testing.assert_array_equal(in_cells(runs, "energy", "median", axes), [[2.0, nan], [nan, 7.0]])
    share = in_cells(with_mobile(runs), "mobile", "mean", axes)
    np.testing.assert_allclose(share, [[2.0 / 3.0, nan], [nan, 0.0]])


def test_an_axis_varies_where_it_does_on_one_ground() -> None:
    grounds = ["mud", "mud", "sand", "sand"]
    runs = table(friction=[0.1, 0.1, 0.9, 0.9], slope_deg=[0.0, 5.0, 0.0, 5.0], terrain=grounds)
    assert varied(runs) == ["slope_deg"]
    assert plane_of(runs) is None
    assert plane_of(table(payload_kg=[0.0, 0.0, 9.0], speed_mps=[1.0, 2.0, 3.0])) == (
        "speed_mps",
        "payload_kg",
    )
    swept = table(slope_deg=[0.0, 1.0, 2.0], payload_kg=[0.0, 1.0, 2.0], friction=[0.1, 0.1, 0.2])
    assert plane_of(swept) == ("friction", "slope_deg")
