"""Slippery ground is judged where the robot turns or accelerates: elsewhere wheels and IMU show no slip."""

from __future__ import annotations

import numpy as np

from tests.studies.slip_model import slippery, study
from tests.studies.slip_model.features import NAMES, SlipWindows
from tests.studies.slip_model.model import quadratic_basis

COLUMNS = len(NAMES) + 20


def run_on(soil: str, shown: float, column: int) -> study.Run:
    """Ten windows that say what the ground is, then ten that say the contrary where nothing shows slip."""
    x = np.zeros((20, COLUMNS))
    says = 1.0 if soil in study.SLIPPERY else -1.0
    x[:10, 0], x[10:, 0] = says, -2.0 * says
    x[:10, column] = shown
    windows = SlipWindows(np.arange(20.0), x, np.full(20, np.nan), np.ones(20))
    return study.Run("borealtc", "husky", soil, soil, windows)


def test_windows_that_show_nothing_are_left_out() -> None:
    weights = np.zeros(quadratic_basis(np.zeros((1, COLUMNS))).shape[1])
    weights[1] = 1.0
    classifier = slippery.Classifier(np.zeros(COLUMNS), np.ones(COLUMNS), weights)
    for column in (*slippery.YAW_KNOWN, slippery.SURGE_KNOWN):
        judged = [run_on("asphalt", 0.9, column), run_on("ice", 0.9, column)]
        text = slippery.line("x", classifier, [*judged, run_on("snow", 0.1, column)])
        assert "2 runs: balanced accuracy 1.00 by window, 1.00 by run, 33 % of the windows judged" in text
