"""Figures of a sweep: heat maps, the limit of mobility, energy against slip.

A run is mobile when it drives to the end (status `done`).
"""

from typing import Any

import numpy as np
import pandas as pd

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.reports.plots import style
from terrafusion.fusion.reports.plots.sheet import Plot, Sheet
from terrafusion.fusion.reports.plots.sweep_cells import CellAxis, in_cells, plane_of, varied

LABELS = {
    "friction": "effective friction",
    "slope_deg": "slope, deg",
    "payload_kg": "payload, kg",
    "speed_mps": "top speed, m/s",
}
SLIP, ENERGY, SHARE = "slip ratio, %", "energy, J/m", "share of mobile runs"
MAX_GROUPS = 6
FEW_LEVELS = 6
MOST_DOTS = 5000
DASHES = ("solid", "dashed", "dotted", "dotdash")

Group = tuple[str, list[str], str]
"""Title, keys of the figures that stand side by side, and their caption."""


def draw(sheet: Sheet, runs: pd.DataFrame) -> list[Group]:
    """All figures that fit a sweep."""
    groups: list[Group] = []
    plane, axes = plane_of(runs), varied(runs)
    if plane is not None:
        others = [LABELS[name].split(",")[0] for name in axes if name not in plane]
        over = f", medians over {' and '.join(others)}" if others else ""
        caption = (
            f"Slip and energy where every run is mobile, and the share of mobile runs{over}. "
            "On the line half of the runs are mobile. Grey: no value."
        )
        for i, (terrain, part) in enumerate(_by_terrain(runs)[:MAX_GROUPS]):
            maps = plot_maps(sheet, f"map{i}", part, plane)
            groups.append((style.label_text(terrain), maps, "" if i else caption))
        plot_mobility(sheet, runs, plane)
        groups.append(("Limit of mobility", ["mobility"], "Lines on which half of the runs are mobile."))
    elif axes:
        plot_profile(sheet, runs, axes[0])
        keys = ["profile_slip", "profile_energy", "profile_share"]
        groups.append(("Profile", keys, "Medians of the mobile runs, and their share."))
    left_out = int((runs["status"] != "done").sum())
    if left_out < len(runs):
        plot_energy_slip(sheet, runs)
        caption = "One dot a mobile run." + (f" {left_out} others are left out." if left_out else "")
        groups.append(("Energy against slip", ["energy_slip"], caption))
    return groups


def _by_terrain(runs: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    """The runs on each terrain, in order of appearance."""
    return [(str(terrain), part) for terrain, part in runs.groupby("terrain", sort=False)]


def _cell_axes(runs: pd.DataFrame, plane: tuple[str, str]) -> dict[str, CellAxis]:
    return {name: CellAxis.of(runs[name]) for name in plane}


def plot_maps(sheet: Sheet, key: str, runs: pd.DataFrame, plane: tuple[str, str]) -> list[str]:
    """Slip, energy per metre, share of mobile runs over two axes, with the limit of mobility; their keys.

    Slip and energy are medians over cells in which every run is mobile: medians of survivors would look
    better the worse the conditions are.
    """
    from bokeh.palettes import Cividis256, Magma256, Viridis256

    axes = _cell_axes(runs, plane)
    x, y = axes.values()
    share = in_cells(runs, "mobile", "mean", axes)
    slip, energy = (
        np.where(share == 1.0, in_cells(runs, name, "median", axes), np.nan)
        for name in ("mean_slip_ratio", "energy_per_m_j")
    )
    log = bool(np.nanmax(energy, initial=1.0) > 5.0 * np.nanmin(energy, initial=np.inf))
    for name, title, values, palette, is_log, limits in (
        (f"{key}_slip", SLIP, 100.0 * slip, Viridis256, False, None),
        (f"{key}_energy", ENERGY, energy, Magma256[::-1], log, None),
        (f"{key}_share", SHARE, share, Cividis256, False, (0.0, 1.0)),
    ):
        plot = sheet.add(f"cells {name}", LABELS[plane[0]], LABELS[plane[1]], 260, title=title)
        plot.cells(x.edges, y.edges, values, palette, log=is_log, limits=limits)
        _limit_line(plot, x, y, share, "half are mobile", style.TRUTH_ON_ANY)
        _level_ticks(plot, x, y)
    return [f"{key}_slip", f"{key}_energy", f"{key}_share"]


def plot_mobility(sheet: Sheet, runs: pd.DataFrame, plane: tuple[str, str]) -> None:
    """The limit of mobility of each terrain and payload: the line on which half of the runs are mobile."""
    axes = _cell_axes(runs, plane)
    x, y = axes.values()
    limits: dict[str, Any] = {"x_range": (x.edges[0], x.edges[-1]), "y_range": (y.edges[0], y.edges[-1])}
    plot = sheet.add("limits mobility", LABELS[plane[0]], LABELS[plane[1]], **limits)
    payloads = sorted(runs["payload_kg"].dropna().unique())
    split = 1 < len(payloads) <= 4 and "payload_kg" not in plane
    for terrain, part in _by_terrain(runs)[:MAX_GROUPS]:
        colour = style.line_colour(style.terrain_colour(terrain))
        for rank, payload in enumerate(payloads if split else [None]):
            mine = part if payload is None else part[part["payload_kg"] == payload]
            share = in_cells(mine, "mobile", "mean", axes)
            label = style.label_text(terrain if payload is None else f"{terrain}, {payload:g} kg")
            if not _limit_line(plot, x, y, share, label, colour, DASHES[rank]):
                none = "all mobile" if np.nanmin(share, initial=1.0) > 0.5 else "no limit found"
                plot.note(f"{label}: {none}", colour, "line")
    if plane == ("friction", "slope_deg"):
        friction = np.linspace(x.edges[0], x.edges[-1], 200)
        slope = np.degrees(np.arctan(friction))
        plot.line(friction, slope, "friction = tan(slope)", style.NEUTRAL, dash="dotted")
    _level_ticks(plot, x, y)


def plot_energy_slip(sheet: Sheet, runs: pd.DataFrame) -> None:
    """Energy per metre against mean slip of the mobile runs, coloured by terrain."""
    from bokeh.models import BasicTickFormatter

    good = runs[(runs["status"] == "done") & runs["energy_per_m_j"].notna()]
    plot = sheet.add("runs energy_slip", SLIP, ENERGY, 360, y_axis_type="log")
    plot.panel.figure.yaxis.formatter = BasicTickFormatter()
    names = [name for name in LABELS if good[name].nunique() > 1]
    tips = {"slip, energy": "@x{0.#} %, @y{0.#} J/m"} | {LABELS[name]: f"@{name}{{0.###}}" for name in names}
    shown = good.iloc[style.thin(len(good), MOST_DOTS)]
    for terrain in good["terrain"].unique():
        part = shown[shown["terrain"] == terrain]
        data = {"x": 100.0 * part["mean_slip_ratio"].to_numpy(), "y": part["energy_per_m_j"].to_numpy()}
        colour, label = style.line_colour(style.terrain_colour(terrain)), style.label_text(terrain)
        more = {name: part[name].to_numpy() for name in names}
        plot.glyph("scatter", data, label, colour, "dot", more=more, tips=tips, size=6.0, fill_alpha=0.6)


def plot_profile(sheet: Sheet, runs: pd.DataFrame, axis: str) -> None:
    """Slip, energy per metre and the share of mobile runs along one axis, a line a terrain."""
    axes = {axis: CellAxis.of(runs[axis])}
    x = axes[axis].centres
    titles = {"slip": SLIP, "energy": ENERGY, "share": SHARE}
    plots = {key: sheet.add(f"p profile_{key}", LABELS[axis], label, 260) for key, label in titles.items()}
    for terrain, part in _by_terrain(runs):
        good = part[part["status"] == "done"]
        colour, label = style.line_colour(style.terrain_colour(terrain)), style.label_text(terrain)
        for key, values in (
            ("slip", 100.0 * in_cells(good, "mean_slip_ratio", "median", axes)),
            ("energy", in_cells(good, "energy_per_m_j", "median", axes)),
            ("share", in_cells(part, "mobile", "mean", axes)),
        ):
            plots[key].line(x, values, label, colour)
            plots[key].dots(x, values, label, colour, size=6.0)


def _limit_line(
    plot: Plot, x: CellAxis, y: CellAxis, share: Array, label: str, colour: str, dash: str = "solid"
) -> bool:
    """Draw the line on which half of the runs are mobile; False where there is none."""
    from bokeh.plotting.contour import contour_data

    known = np.isfinite(share)
    if min(share.shape) < 2 or not known.any() or share[known].min() >= 0.5 or share[known].max() <= 0.5:
        return False
    found = contour_data(x.centres, y.centres, np.ma.masked_invalid(share), [0.5], want_fill=False).line_data
    if found is None:
        return False
    plot.line(np.asarray(found.xs[0]), np.asarray(found.ys[0]), label, colour, dash=dash, width=2.5)
    return True


def _level_ticks(plot: Plot, x: CellAxis, y: CellAxis) -> None:
    """Ticks at the levels, where they are few."""
    for axis, cells in ((plot.panel.figure.xaxis, x), (plot.panel.figure.yaxis, y)):
        if len(cells.centres) <= FEW_LEVELS:
            axis.ticker = [float(at) for at in cells.centres]
