"""The study's batch, and energy a metre."""

from __future__ import annotations

import math

import pytest

from tests.studies.source_study.batch import (
    BatchCell,
    BatchResult,
    grid,
    least_growth,
    neighbours,
    run_cell,
    share_of_pairs,
    slip_cost,
    steepening,
)
from tests.studies.source_study.published import FRICTION


def result(energy: float, slip: float = 1.0, advance: float = 1.0, **cell: float) -> BatchResult:
    return BatchResult(
        BatchCell("loose_sand", **{"friction": 0.5, **cell}), advance, slip, slip, energy, None
    )


def test_the_grid_covers_the_ranges_of_friction() -> None:
    cells = grid()
    assert len(set(cells)) == len(cells) == 3 * 3 * 4 * 3
    for terrain, ends in FRICTION.items():
        found = {cell.friction for cell in cells if cell.terrain == terrain}
        assert (min(found), max(found)) == ends
    assert set(grid(quick=True)) < set(cells)


def test_neighbours_differ_in_one_field_by_one_step() -> None:
    results = [result(1.0, slope_deg=s, payload_kg=p) for s in (0.0, 5.0, 10.0) for p in (0.0, 30.0)]
    pairs = neighbours(results, "slope_deg")
    assert len(pairs) == 4
    for low, high in pairs:
        assert high.cell.slope_deg - low.cell.slope_deg == 5.0
        assert high.cell.payload_kg == low.cell.payload_kg


def test_growth_is_the_least_and_leaves_out_what_does_not_get_on() -> None:
    results = [result(10.0), result(15.0, slope_deg=5.0), result(90.0, slope_deg=10.0)]
    assert least_growth(results, "slope_deg") == 1.5
    stuck = [*results[:1], result(1.0, advance=0.1, slope_deg=5.0)]
    assert math.isnan(least_growth(stuck, "slope_deg"))


def test_share_of_pairs() -> None:
    results = [result(1.0, slip=s, friction=f) for f, s in ((0.4, 3.0), (0.5, 2.0), (0.6, 2.5))]
    assert share_of_pairs(results, "friction", lambda a, b: a.slip > b.slip) == 50.0


def test_steepening_is_one_in_proportion_and_more_beyond() -> None:
    slips = (1.0, 10.0, 20.0, 40.0)
    assert steepening([result(5.0 + 2.0 * s, s) for s in slips], "slip") == pytest.approx(1.0)
    assert steepening([result(5.0 + s**2, s) for s in slips], "slip") > 1.5
    assert slip_cost([result(5.0, 1.0), result(20.0, 9.0)]) == 4.0


def test_cells_drive_what_they_say() -> None:
    easy, heavy = run_cell(BatchCell("medium_sand", 0.9)), run_cell(BatchCell("medium_sand", 0.9, 5.0, 60.0))
    assert easy.mobile
    assert heavy.mobile
    assert heavy.energy_per_m_j > 2.0 * easy.energy_per_m_j > 0.0
    slippery, gripping = run_cell(BatchCell("loose_sand", 0.2)), run_cell(BatchCell("loose_sand", 0.6))
    assert slippery.slip > gripping.slip
    stuck = run_cell(BatchCell("mud", 0.1, 10.0))
    assert not stuck.mobile
    assert math.isnan(stuck.energy_per_m_j)
