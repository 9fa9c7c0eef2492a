"""Plots of a sweep: heat maps, the limit of mobility, energy against slip.

A run is mobile when it drives to the end (status `done`).
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.reports.plots import style
from terrafusion.fusion.reports.plots.sweep_cells import (
    CellAxis,
    Columns,
    in_cells,
    levels,
    mobile,
    per_cell,
    plane_of,
    select,
    share_mobile,
    varied,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


LABELS = {
    "friction": "effective friction",
    "slope_deg": "slope, deg",
    "payload_kg": "payload, kg",
    "speed_mps": "top speed, m/s",
}
NO_VALUE = "#d9d9d9"
MAX_GROUPS = 6
FEW_LEVELS = 6
Dash = Literal["-", "--", ":", "-."]
DASHES: tuple[Dash, ...] = ("-", "--", ":", "-.")


def plot_maps(columns: Columns, plane: tuple[str, str], title: str = "") -> Figure:
    """Slip, energy per metre and the share of mobile runs over two axes, with the limit of mobility.

    Slip and energy are medians over cells in which every run is mobile: medians of survivors would look
    better the worse the conditions are. The other cells are grey.
    """
    from matplotlib.colors import LogNorm

    fig, axes = style.canvases(1, (11.0, 3.6), 3, sharex=False)
    x, y = CellAxis.of(columns[plane[0]]), CellAxis.of(columns[plane[1]])
    share = share_mobile(columns, x, y, plane)
    slip, energy = (
        np.where(share == 1.0, in_cells(columns, columns[name], x, y, plane), np.nan)
        for name in ("mean_slip_ratio", "energy_per_m_j")
    )
    log = LogNorm() if np.nanmax(energy, initial=1.0) > 5.0 * np.nanmin(energy, initial=np.inf) else None
    kinds: list[tuple[str, Array, dict[str, Any]]] = [
        ("mean slip ratio, %", 100.0 * slip, {"cmap": "viridis"}),
        ("energy, J/m", energy, {"cmap": "magma_r", "norm": log}),
        ("share of mobile runs", share, {"cmap": "RdYlBu", "vmin": 0.0, "vmax": 1.0}),
    ]
    for k, (ax, (name, values, options)) in enumerate(zip(axes, kinds, strict=True)):
        ax.set_facecolor(NO_VALUE)
        if np.isfinite(values).any():
            mesh = ax.pcolormesh(x.edges, y.edges, np.ma.masked_invalid(values), rasterized=True, **options)
            bar = fig.colorbar(mesh, ax=ax)
            _plain_ticks(bar.ax.yaxis)
        _limit_line(ax, x, y, share, style.TRUTH)
        style.format_axes(ax, x=LABELS[plane[0]], y=LABELS[plane[1]] if k == 0 else "", title=name)
        _level_ticks(ax, x, y)
        ax.grid(False)
    if title:
        fig.suptitle(style.label_text(title), fontsize=11)
    return fig


def plot_mobility(columns: Columns, plane: tuple[str, str]) -> Figure:
    """The limit of mobility of each terrain and payload: the line on which half of the runs are mobile."""
    from matplotlib.lines import Line2D

    fig, ax = style.canvas((7.5, 4.5))
    x, y = CellAxis.of(columns[plane[0]]), CellAxis.of(columns[plane[1]])
    handles = []
    for (terrain, payload), rows in _groups(columns, plane):
        rank = 0 if payload is None else int(np.searchsorted(levels(columns["payload_kg"]), payload))
        dash, colour = DASHES[rank % len(DASHES)], style.terrain_colour(terrain)
        share = share_mobile(select(columns, rows), x, y, plane)
        label = terrain if payload is None else f"{terrain}, {payload:g} kg"
        if not _limit_line(ax, x, y, share, colour, dash):
            label += ": all mobile" if np.nanmin(share, initial=1.0) > 0.5 else ": no limit found"
        handles.append(Line2D([], [], color=colour, linestyle=dash, label=style.label_text(label)))
    ax.set_xlim(x.edges[0], x.edges[-1])
    ax.set_ylim(y.edges[0], y.edges[-1])
    _level_ticks(ax, x, y)
    if plane == ("friction", "slope_deg"):
        friction = np.linspace(x.edges[0], x.edges[-1], 200)
        slope, label = np.degrees(np.arctan(friction)), "friction = tan(slope)"
        handles += ax.plot(friction, slope, color="#999999", linewidth=1.0, label=label)
    style.format_axes(ax, x=LABELS[plane[0]], y=LABELS[plane[1]])
    style.legend_above(ax, columns=4, handles=handles)
    return fig


def plot_energy_slip(columns: Columns) -> Figure:
    """Energy per metre against mean slip of the mobile runs, coloured by slope, else by terrain."""
    fig, ax = style.canvas((7.5, 4.5))
    good = select(columns, (columns["status"] == "done") & np.isfinite(columns["energy_per_m_j"]))
    slip, slope = 100.0 * good["mean_slip_ratio"], good["slope_deg"]
    sloped = len(levels(slope)) > 1
    options: dict[str, Any] = {"s": 12.0, "rasterized": True}
    if sloped:
        options |= {"cmap": "viridis", "vmin": float(slope.min()), "vmax": float(slope.max())}
    rows = style.thin(len(slip), 5000)
    terrains = list(dict.fromkeys(good["terrain"]))
    for terrain, marker in zip(terrains, itertools.cycle("osD^v<>")):
        here = rows[good["terrain"][rows] == terrain]
        colour = slope[here] if sloped else style.terrain_colour(terrain)
        label = style.label_text(terrain)
        energy = good["energy_per_m_j"][here]
        dots = ax.scatter(slip[here], energy, c=colour, marker=marker, label=label, **options)
    if sloped:
        fig.colorbar(dots, ax=ax, label="slope, deg")
    if len(terrains) > 1:
        style.legend_above(ax)
    ax.set_yscale("log")
    _plain_ticks(ax.yaxis)
    style.format_axes(ax, x="mean slip ratio, %", y="energy, J/m")
    return fig


def plot_profile(columns: Columns, axis: str) -> Figure:
    """Slip, energy per metre and the share of mobile runs along one axis, a line a terrain."""
    fig, axes = style.canvases(3, (7.5, 6.0))
    x = CellAxis.of(columns[axis])
    n = len(x.centres)
    for terrain in dict.fromkeys(columns["terrain"]):
        part = select(columns, columns["terrain"] == terrain)
        good = select(part, part["status"] == "done")
        lines = (
            100.0 * per_cell(x.cells(good[axis]), good["mean_slip_ratio"], n, "median"),
            per_cell(x.cells(good[axis]), good["energy_per_m_j"], n, "median"),
            per_cell(x.cells(part[axis]), mobile(part), n, "mean"),
        )
        look: dict[str, Any] = {"color": style.terrain_colour(terrain), "label": style.label_text(terrain)}
        for ax, values in zip(axes, lines, strict=True):
            ax.plot(x.centres, values, "o-", markersize=3.5, linewidth=1.2, **look)
    for ax, name in zip(axes, ("mean slip ratio, %", "energy, J/m", "share of mobile runs"), strict=True):
        style.format_axes(ax, y=name, x=LABELS[axis] if ax is axes[-1] else "")
    style.legend_above(axes[0])
    return fig


def figures(columns: Columns) -> dict[str, tuple[Figure, str]]:
    """All plots that fit a sweep, by file name, with their captions."""
    out: dict[str, tuple[Figure, str]] = {}
    plane, axes = plane_of(columns), varied(columns)
    if plane is not None:
        others = [LABELS[name].split(",")[0] for name in axes if name not in plane]
        over = f"; medians over {' and '.join(others)}" if others else ""
        caption = (
            f"Slip and energy where every run is mobile, and the share of mobile runs{over}. "
            "The line is the limit of mobility: half of the runs are mobile."
        )
        terrains = list(dict.fromkeys(columns["terrain"]))
        for terrain in terrains[:MAX_GROUPS]:
            name = "maps" if len(terrains) == 1 else f"maps_{len(out)}"
            part = select(columns, columns["terrain"] == terrain)
            out[name] = plot_maps(part, plane, terrain), caption
        caption = "Limit of mobility: the line on which half of the runs are mobile."
        out["mobility"] = plot_mobility(columns, plane), caption
    elif axes:
        caption = "Slip and energy of the mobile runs (median), and their share."
        out["profile"] = plot_profile(columns, axes[0]), caption
    if (columns["status"] == "done").any():
        left_out = int((columns["status"] != "done").sum())
        caption = "Energy per metre against slip, one dot a mobile run."
        caption += f" {left_out} others are left out." if left_out else ""
        out["energy_slip"] = plot_energy_slip(columns), caption
    return out


def _limit_line(ax: Axes, x: CellAxis, y: CellAxis, share: Array, colour: str, dash: Dash = "-") -> bool:
    """Draw the line on which half of the runs are mobile; False where there is none."""
    known = np.isfinite(share)
    if min(share.shape) < 2 or not known.any() or share[known].min() >= 0.5 or share[known].max() <= 0.5:
        return False
    ax.contour(
        x.centres, y.centres, np.ma.masked_invalid(share), levels=[0.5], colors=[colour], linewidths=[1.6],
        linestyles=[dash],
    )  # fmt: skip
    return True


def _groups(
    columns: Columns, plane: tuple[str, str]
) -> list[tuple[tuple[str, float | None], NDArray[np.bool_]]]:
    """Runs of one terrain, split by payload where payloads are few and no axis of the plane."""
    payloads = levels(columns["payload_kg"])
    split = 1 < len(payloads) <= 4 and "payload_kg" not in plane
    out: list[tuple[tuple[str, float | None], NDArray[np.bool_]]] = []
    for terrain in list(dict.fromkeys(columns["terrain"]))[:MAX_GROUPS]:
        here = columns["terrain"] == terrain
        if split:
            out += [((terrain, float(p)), here & (columns["payload_kg"] == p)) for p in payloads]
        else:
            out.append(((terrain, None), here))
    return out


def _level_ticks(ax: Axes, x: CellAxis, y: CellAxis) -> None:
    """Ticks at the levels, where they are few."""
    if len(x.centres) <= FEW_LEVELS:
        ax.set_xticks(x.centres)
    if len(y.centres) <= FEW_LEVELS:
        ax.set_yticks(y.centres)


def _plain_ticks(axis: Any) -> None:
    if axis.get_scale() == "log":
        style.plain_log_ticks(axis)
    axis.set_tick_params(which="both", labelsize=8)
