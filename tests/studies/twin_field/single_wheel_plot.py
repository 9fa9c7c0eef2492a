"""Measured against predicted, and both over slip: the picture of the single-wheel trials."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.studies.twin_field.single_wheel_fit import conditions, measured
from tests.studies.twin_field.wheel_trials import WheelTrials

Array = NDArray[np.float64]

_LABELS = ("tractive force, N", "side force, N", "sinkage, mm")
_SCALE = np.array([1.0, 1.0, 1e3])


def plot(trials: WheelTrials, predicted: Array, fitted_rows: NDArray[np.bool_]) -> Any:
    """A figure: above, outputs over slip by side-slip; below, predicted against measured.

    Args:
        trials: as measured (dots).
        predicted: (N, 3) outputs of the model (lines join the conditions of a side-slip).
        fitted_rows: (N,) trials the model was fitted on (small and grey below).
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 7.0), layout="constrained")
    axes = figure.subplots(2, 3)
    target, model = measured(trials) * _SCALE, predicted * _SCALE
    degrees, group = np.degrees(trials.commanded_side_slip_rad), conditions(trials)
    colour = ScalarMappable(Normalize(0.0, 90.0), "viridis")
    for k, label in enumerate(_LABELS):
        above, below = axes[0, k], axes[1, k]
        for angle in np.unique(degrees.round(3)):
            here = np.abs(degrees - angle) < 0.1
            above.plot(trials.slip[here], target[here, k], "o", ms=3, color=colour.to_rgba(angle))
            rows = [here & (group == g) for g in np.unique(group[here])]
            line = np.array(sorted((trials.slip[at].mean(), model[at, k].mean()) for at in rows))
            above.plot(line[:, 0], line[:, 1], "-", lw=1.2, color=colour.to_rgba(angle))
        above.set(xlabel="slip", ylabel=label)
        span = [min(target[:, k].min(), model[:, k].min()), max(target[:, k].max(), model[:, k].max())]
        below.plot(span, span, "-", lw=0.8, color="0.5")
        below.plot(target[fitted_rows, k], model[fitted_rows, k], ".", ms=4, color="0.7", label="fitted on")
        colours = colour.to_rgba(degrees[~fitted_rows])
        below.scatter(target[~fitted_rows, k], model[~fitted_rows, k], s=16, c=colours, label="predicted")
        below.set(xlabel=f"measured {label}", ylabel=f"predicted {label}")
    axes[1, 0].legend(loc="upper left", frameon=False)
    axes[0, 0].set_title("dots measured, lines the model", fontsize=10)
    figure.colorbar(colour, ax=axes, label="side-slip, deg", shrink=0.6)
    return figure
