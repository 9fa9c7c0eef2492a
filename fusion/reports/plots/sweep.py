"""Plots of a sweep: heat maps, the limit of mobility, energy against slip. Each returns its figure."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from terrafusion.fusion.reports.plots import style
from terrafusion.fusion.reports.plots.sweep_cells import (
    CellAxis,
    Columns,
    in_cells,
    levels,
    mobile,
    plane_of,
    select,
    share_mobile,
    varied,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

LABELS = {
    "friction": "effective friction",
    "slope_deg": "slope, deg",
    "payload_kg": "payload, kg",
    "speed_mps": "top speed, m/s",
}
STUCK = "#d9d9d9"
MAX_GROUPS = 6
FEW_LEVELS = 6
Dash = Literal["-", "--", ":", "-."]
DASHES: tuple[Dash, ...] = ("-", "--", ":", "-.")


def plot_maps(columns: Columns, plane: tuple[str, str], title: str = "") -> Figure:
    """Slip, energy a metre and the share of runs that got on over two axes, with the limit of mobility.

    Slip and energy are medians over cells in which every run got on: medians of survivors would
    look better the worse the conditions are. The other cells are grey.
    """
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

    fig = Figure(figsize=(11.0, 3.6), layout="constrained")
    x, y = CellAxis.of(columns[plane[0]]), CellAxis.of(columns[plane[1]])
    share = share_mobile(columns, x, y, plane)
    slip, energy = (
        np.where(share == 1.0, in_cells(columns, name, x, y, plane), np.nan)
        for name in ("mean_slip_ratio", "energy_per_m_j")
    )
    log = LogNorm() if np.nanmax(energy, initial=1.0) > 5.0 * np.nanmin(energy, initial=np.inf) else None
    kinds: list[tuple[str, Array, dict[str, Any]]] = [
        ("mean slip ratio, %", 100.0 * slip, {"cmap": "viridis"}),
        ("energy, J/m", energy, {"cmap": "magma_r", "norm": log}),
        ("share of runs that got on", share, {"cmap": "RdYlBu", "vmin": 0.0, "vmax": 1.0}),
    ]
    for number, (ax, (name, values, options)) in enumerate(zip(fig.subplots(1, 3), kinds, strict=True)):
        ax.set_facecolor(STUCK)
        if np.isfinite(values).any():
            mesh = ax.pcolormesh(x.edges, y.edges, np.ma.masked_invalid(values), rasterized=True, **options)
            bar = fig.colorbar(mesh, ax=ax)
            _plain_numbers(bar.ax.yaxis)
        _limit_line(ax, x, y, share, style.TRUTH)
        style.dress(ax, x=LABELS[plane[0]], y=LABELS[plane[1]] if number == 0 else "", title=name)
        _ticks(ax, x, y)
        ax.grid(False)
    if title:
        fig.suptitle(style.plain(title), fontsize=11)
    return fig


def plot_mobility(columns: Columns, plane: tuple[str, str]) -> Figure:
    """The limit of mobility of each ground and payload: the line on which half of the runs got on."""
    from matplotlib.lines import Line2D

    fig, ax = style.canvas(None, (7.5, 4.5))
    x, y = CellAxis.of(columns[plane[0]]), CellAxis.of(columns[plane[1]])
    handles = []
    for (terrain, payload), rows in _groups(columns, plane):
        dash = DASHES[_rank(columns["payload_kg"], payload) % len(DASHES)]
        colour = style.colour_of(terrain, style.TERRAIN_COLOURS)
        share = share_mobile(select(columns, rows), x, y, plane)
        label = terrain if payload is None else f"{terrain}, {payload:g} kg"
        if not _limit_line(ax, x, y, share, colour, dash):
            label += ": all got on" if np.nanmin(share, initial=1.0) > 0.5 else ": no limit found"
        handles.append(Line2D([], [], color=colour, linestyle=dash, label=style.plain(label)))
    ax.set_xlim(x.edges[0], x.edges[-1])
    ax.set_ylim(y.edges[0], y.edges[-1])
    _ticks(ax, x, y)
    if plane == ("friction", "slope_deg"):
        friction = np.linspace(x.edges[0], x.edges[-1], 200)
        label = "friction = tan(slope)"
        (line,) = ax.plot(friction, np.degrees(np.arctan(friction)), color="#999999", lw=1.0, label=label)
        handles.append(line)
    style.dress(ax, x=LABELS[plane[0]], y=LABELS[plane[1]])
    style.legend_above(ax, columns=4, handles=handles)
    return fig


def plot_energy_slip(columns: Columns) -> Figure:
    """Energy a metre against mean slip of the runs that got on, coloured by slope, else by ground."""
    fig, ax = style.canvas(None, (7.5, 4.5))
    good = select(columns, (columns["status"] == "done") & np.isfinite(columns["energy_per_m_j"]))
    slip = 100.0 * good["mean_slip_ratio"]
    sloped = len(levels(good["slope_deg"])) > 1
    scale = (float(good["slope_deg"].min()), float(good["slope_deg"].max()))
    rows = style.thin(len(slip), 5000)
    terrains = list(dict.fromkeys(good["terrain"]))
    for terrain, marker in zip(terrains, itertools.cycle("osD^v<>")):
        here = rows[good["terrain"][rows] == terrain]
        dots = ax.scatter(
            slip[here],
            good["energy_per_m_j"][here],
            c=good["slope_deg"][here] if sloped else style.colour_of(terrain, style.TERRAIN_COLOURS),
            cmap="viridis" if sloped else None,
            vmin=scale[0] if sloped else None,
            vmax=scale[1] if sloped else None,
            s=12.0,
            marker=marker,
            label=style.plain(terrain),
            rasterized=True,
        )
    if sloped:
        fig.colorbar(dots, ax=ax, label="slope, deg")
    if len(terrains) > 1:
        style.legend_above(ax)
    ax.set_yscale("log")
    _plain_numbers(ax.yaxis)
    style.dress(ax, x="mean slip ratio, %", y="energy, J/m")
    return fig


def plot_profile(columns: Columns, axis: str) -> Figure:
    """Slip, energy a metre and the share of runs that got on along one axis, a line a ground."""
    fig, axes = style.canvases(None, 3, (7.5, 6.0))
    x = CellAxis.of(columns[axis])
    for terrain in dict.fromkeys(columns["terrain"]):
        part = select(columns, columns["terrain"] == terrain)
        good = select(part, part["status"] == "done")
        colour = style.colour_of(terrain, style.TERRAIN_COLOURS)
        lines = (
            100.0 * _along(good[axis], good["mean_slip_ratio"], x, np.median),
            _along(good[axis], good["energy_per_m_j"], x, np.median),
            _along(part[axis], mobile(part), x, np.mean),
        )
        for ax, values in zip(axes, lines, strict=True):
            ax.plot(x.centres, values, "o-", ms=3.5, lw=1.2, color=colour, label=style.plain(terrain))
    for ax, name in zip(axes, ("mean slip ratio, %", "energy, J/m", "share that got on"), strict=True):
        style.dress(ax, y=name, x=LABELS[axis] if ax is axes[-1] else "")
    style.legend_above(axes[0])
    return fig


def figures(columns: Columns) -> dict[str, tuple[Figure, str]]:
    """All plots that fit a sweep, by file name, with their captions."""
    out: dict[str, tuple[Figure, str]] = {}
    plane = plane_of(columns)
    if plane is not None:
        terrains = list(dict.fromkeys(columns["terrain"]))
        for terrain in terrains[:MAX_GROUPS]:
            name = "maps" if len(terrains) == 1 else f"maps_{len(out)}"
            part = select(columns, columns["terrain"] == terrain)
            out[name] = (plot_maps(part, plane, terrain), _maps_caption(columns, plane))
        out["mobility"] = (
            plot_mobility(columns, plane),
            "Limit of mobility: the line on which half of the runs got on.",
        )
    for axis in varied(columns)[:1] if plane is None else []:
        out["profile"] = (
            plot_profile(columns, axis),
            "Slip and energy of the runs that got on (median), and their share.",
        )
    if (columns["status"] == "done").any():
        left_out = int((columns["status"] != "done").sum())
        caption = "Energy a metre against slip, one dot a run that got on."
        out["energy_slip"] = (
            plot_energy_slip(columns),
            caption + (f" {left_out} others are left out." if left_out else ""),
        )
    return out


def _maps_caption(columns: Columns, plane: tuple[str, str]) -> str:
    others = [LABELS[name].split(",")[0] for name in varied(columns) if name not in plane]
    over = f"; medians over {' and '.join(others)}" if others else ""
    return (
        f"Slip and energy where every run got on, and the share that did{over}. "
        "The line is the limit of mobility: half of the runs got on."
    )


def _limit_line(ax: Axes, x: CellAxis, y: CellAxis, share: Array, colour: str, dash: Dash = "-") -> bool:
    """Draw the line on which half of the runs got on; False where there is none."""
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
    """Runs of one ground and payload; payloads are told apart where they are few and no axis of the plane."""
    payloads = levels(columns["payload_kg"])
    apart = 1 < len(payloads) <= 4 and "payload_kg" not in plane
    out: list[tuple[tuple[str, float | None], NDArray[np.bool_]]] = []
    for terrain in list(dict.fromkeys(columns["terrain"]))[:MAX_GROUPS]:
        here = columns["terrain"] == terrain
        if apart:
            out += [((terrain, float(p)), here & (columns["payload_kg"] == p)) for p in payloads]
        else:
            out.append(((terrain, None), here))
    return out


def _rank(values: Array, value: float | None) -> int:
    return 0 if value is None else int(np.searchsorted(levels(values), value))


def _ticks(ax: Axes, x: CellAxis, y: CellAxis) -> None:
    """Ticks at the levels, where they are few."""
    if len(x.centres) <= FEW_LEVELS:
        ax.set_xticks(x.centres)
    if len(y.centres) <= FEW_LEVELS:
        ax.set_yticks(y.centres)


def _plain_numbers(axis: Any) -> None:
    """Ticks such as 200, not 2 x 10^2."""
    from matplotlib.ticker import FuncFormatter, LogLocator

    if axis.get_scale() == "log":
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(FuncFormatter(lambda value, _: ""))
    axis.set_tick_params(which="both", labelsize=8)


def _along(at: Array, values: Array, x: CellAxis, statistic: Any) -> Array:
    cells = x.cells(at)
    out = np.full(len(x.centres), np.nan)
    for cell in range(len(out)):
        here = values[(cells == cell) & np.isfinite(values)]
        if len(here):
            out[cell] = statistic(here)
    return out
