"""The sentence of the demo on where adaptive weights do not help."""

from __future__ import annotations

import numpy as np
import pytest

from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.reports.demo import DemoRun, table_of, where_it_does_not_help

OUTAGE = Outage(4.0, 4.0)


def run_of(mode: str, seed: int, outside_m: float, inside_m: float, end_m: float) -> DemoRun:
    t_s = np.arange(0.0, 10.5, 0.5)
    error = np.where((t_s >= 4.0) & (t_s <= 8.0), inside_m, outside_m)
    error[t_s == 8.0] = end_m
    path = np.stack([t_s, np.where(t_s > 8.0, end_m, 0.0)], axis=1)
    return DemoRun(seed, mode, t_s, error, path, np.stack([t_s, 0.0 * t_s], axis=1))


@pytest.mark.parametrize(
    ("adaptive_m", "expected"),
    [
        (
            (0.05, 0.3, 1.0),
            "Adaptive weights help in every drive shown here; on firm ground they equal fixed ones.",
        ),
        ((0.1, 0.3, 1.0), "Where adaptive weights do not help: they equal fixed ones with GNSS."),
        (
            (0.05, 0.6, 3.0),
            "Where adaptive weights do not help: they are worse in the outage and at the end of the outage; "
            "2 of 2 drives end the outage with a larger error.",
        ),
    ],
)
def test_losses_are_named(adaptive_m: tuple[float, float, float], expected: str) -> None:
    runs = [run_of("fixed", s, 0.1, 0.5, 2.0) for s in (1, 2)]
    runs += [run_of("adaptive", s, *adaptive_m) for s in (2, 1)]
    assert where_it_does_not_help(table_of(runs, OUTAGE)) == expected


def test_errors_that_the_table_shows_alike_are_equal() -> None:
    runs = [run_of("fixed", 1, 0.020, 0.5, 2.0), run_of("adaptive", 1, 0.024, 0.3, 1.0)]
    assert "they equal fixed ones with GNSS" in where_it_does_not_help(table_of(runs, OUTAGE))


def test_a_jump_shows_in_its_frame_alone() -> None:
    run = run_of("adaptive", 0, 0.1, 0.5, 2.0)
    assert run.largest_step_m("map") == pytest.approx(np.hypot(0.5, 2.0))
    assert run.largest_step_m("odom") == pytest.approx(0.5)
