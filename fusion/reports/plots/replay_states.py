"""Plots of the states that tell how a skid-steered robot turns and drifts sideways."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.fusion.estimate.estimate import Estimate
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.outputs.linear_states import series
from terrafusion.fusion.reports.plots import style
from terrafusion.fusion.reports.plots.replay import TIME, shade_outages

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SHOWN = (
    ("yaw_scale", "yaw scale", "#0072b2"),
    ("side_slip", "side-slip", "#d55e00"),
    ("icr_x_m", "centre of\nrotation, m", "#009e73"),
)


def drawn(estimate: Estimate) -> list[str]:
    """The states that `plot_skid_steering` has something to draw of."""
    return [name for name, _, _ in SHOWN if len(estimate.trajectory) and series(estimate, name) is not None]


def plot_skid_steering(
    estimate: Estimate,
    start_ns: int,
    *,
    outages: Sequence[Outage] = (),
    axes: Sequence[Axes] | None = None,
) -> tuple[Figure, NDArray[Any]]:
    """Yaw scale, side-slip and centre of rotation over time, with bands of two sigma."""
    fig, panels = style.canvases(axes, len(SHOWN), (9.0, 1.5 * len(SHOWN) + 0.6))
    t = style.seconds(estimate.trajectory.t_ns, start_ns)
    keep = style.thin(len(t))
    for ax, (name, label, colour) in zip(panels, SHOWN, strict=True):
        found = series(estimate, name)
        if found is not None:
            value, sigma = (column[keep] for column in found)
            low, high = value - 2 * sigma, value + 2 * sigma
            ax.fill_between(t[keep], low, high, color=colour, alpha=0.2, linewidth=0, label="±2 sigma")
            ax.plot(t[keep], value, color=colour, linewidth=1.2, label="estimate")
            ax.set_ylim(*style.robust_limits(np.concatenate([low, high]), include=(0.0,)))
        shade_outages(ax, outages)
        style.dress(ax, y=label)
    style.legend_above(panels[0])
    panels[-1].set_xlabel(TIME, fontsize=9)
    return fig, panels
