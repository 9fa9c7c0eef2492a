"""Frames of the paths that a gap report draws."""

from __future__ import annotations

import numpy as np
import pytest

from terrafusion.fusion.reports.plots.gap import LEAST_SIDE, _limits


@pytest.mark.parametrize("end", [(200.0, 0.0), (0.0, 200.0), (0.0, 0.0), (30.0, -40.0)])
def test_a_path_lies_within_a_frame_that_is_no_line(end: tuple[float, float]) -> None:
    at = np.linspace((0.0, 0.0), end, 50)
    (x0, x1), (y0, y1) = _limits(at)
    assert x0 < at[:, 0].min() <= at[:, 0].max() < x1
    assert y0 < at[:, 1].min() <= at[:, 1].max() < y1
    sides = sorted((x1 - x0, y1 - y0))
    assert sides[0] >= 0.999 * LEAST_SIDE * sides[1] > 0.0
