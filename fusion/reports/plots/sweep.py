"""Figures of a sweep: heat maps, the limit of mobility, energy against slip.

A run is mobile when it drives to the end (status `done`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.reports.plots import style
from terrafusion.fusion.reports.plots.sheet import Plot, Sheet
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


def draw(sheet: Sheet, columns: Columns) -> list[Group]:
    """All figures that fit a sweep."""
    groups: list[Group] = []
    plane, axes = plane_of(columns), varied(columns)
    if plane is not None:
        others = [LABELS[name].split(",")[0] for name in axes if name not in plane]
        over = f", medians over {' and '.join(others)}" if others else ""
        caption = (
            f"Slip and energy where every run is mobile, and the share of mobile runs{over}. "
            "On the line half of the runs are mobile. Grey: no value."
        )
        for i, terrain in enumerate(list(dict.fromkeys(columns["terrain"]))[:MAX_GROUPS]):
            part = select(columns, columns["terrain"] == terrain)
            maps = plot_maps(sheet, f"map{i}", part, plane)
            groups.append((style.label_text(terrain), maps, "" if i else caption))
        plot_mobility(sheet, columns, plane)
        groups.append(("Limit of mobility", ["mobility"], "Lines on which half of the runs are mobile."))
    elif axes:
        plot_profile(sheet, columns, axes[0])
        keys = ["profile_slip", "profile_energy", "profile_share"]
        groups.append(("Profile", keys, "Medians of the mobile runs, and their share."))
    left_out = int((columns["status"] != "done").sum())
    if left_out < len(columns["status"]):
        plot_energy_slip(sheet, columns)
        caption = "One dot a mobile run." + (f" {left_out} others are left out." if left_out else "")
        groups.append(("Energy against slip", ["energy_slip"], caption))
    return groups


def plot_maps(sheet: Sheet, key: str, columns: Columns, plane: tuple[str, str]) -> list[str]:
    """Slip, energy per metre, share of mobile runs over two axes, with the limit of mobility; their keys.

    Slip and energy are medians over cells in which every run is mobile: medians of survivors would look
    better the worse the conditions are.
    """
    from bokeh.palettes import Cividis256, Magma256, Viridis256

    x, y = CellAxis.of(columns[plane[0]]), CellAxis.of(columns[plane[1]])
    share = share_mobile(columns, x, y, plane)
    slip, energy = (
        np.where(share == 1.0, in_cells(columns, columns[name], x, y, plane), np.nan)
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


def plot_mobility(sheet: Sheet, columns: Columns, plane: tuple[str, str]) -> None:
    """The limit of mobility of each terrain and payload: the line on which half of the runs are mobile."""
    x, y = CellAxis.of(columns[plane[0]]), CellAxis.of(columns[plane[1]])
    limits: dict[str, Any] = {"x_range": (x.edges[0], x.edges[-1]), "y_range": (y.edges[0], y.edges[-1])}
    plot = sheet.add("limits mobility", LABELS[plane[0]], LABELS[plane[1]], **limits)
    for terrain, payload, rows in _groups(columns, plane):
        rank = 0 if payload is None else int(np.searchsorted(levels(columns["payload_kg"]), payload))
        colour = style.line_colour(style.terrain_colour(terrain))
        share = share_mobile(select(columns, rows), x, y, plane)
        label = style.label_text(terrain if payload is None else f"{terrain}, {payload:g} kg")
        if not _limit_line(plot, x, y, share, label, colour, DASHES[rank % len(DASHES)]):
            none = "all mobile" if np.nanmin(share, initial=1.0) > 0.5 else "no limit found"
            plot.note(f"{label}: {none}", colour, "line")
    if plane == ("friction", "slope_deg"):
        friction = np.linspace(x.edges[0], x.edges[-1], 200)
        slope = np.degrees(np.arctan(friction))
        plot.line(friction, slope, "friction = tan(slope)", style.NEUTRAL, dash="dotted")
    _level_ticks(plot, x, y)


def plot_energy_slip(sheet: Sheet, columns: Columns) -> None:
    """Energy per metre against mean slip of the mobile runs, coloured by terrain."""
    from bokeh.models import BasicTickFormatter

    good = select(columns, (columns["status"] == "done") & np.isfinite(columns["energy_per_m_j"]))
    plot = sheet.add("runs energy_slip", SLIP, ENERGY, 360, y_axis_type="log")
    plot.panel.figure.yaxis.formatter = BasicTickFormatter()
    rows = style.thin(len(good["terrain"]), MOST_DOTS)
    names = [name for name in LABELS if len(levels(good[name])) > 1]
    tips = {"slip, energy": "@x{0.#} %, @y{0.#} J/m"} | {LABELS[name]: f"@{name}{{0.###}}" for name in names}
    for terrain in dict.fromkeys(good["terrain"]):
        here = rows[good["terrain"][rows] == terrain]
        data = {"x": 100.0 * good["mean_slip_ratio"][here], "y": good["energy_per_m_j"][here]}
        colour, label = style.line_colour(style.terrain_colour(terrain)), style.label_text(terrain)
        more = {name: good[name][here] for name in names}
        plot.glyph("scatter", data, label, colour, "dot", more=more, tips=tips, size=6.0, fill_alpha=0.6)


def plot_profile(sheet: Sheet, columns: Columns, axis: str) -> None:
    """Slip, energy per metre and the share of mobile runs along one axis, a line a terrain."""
    x = CellAxis.of(columns[axis])
    n = len(x.centres)
    titles = {"slip": SLIP, "energy": ENERGY, "share": SHARE}
    plots = {key: sheet.add(f"p profile_{key}", LABELS[axis], label, 260) for key, label in titles.items()}
    for terrain in dict.fromkeys(columns["terrain"]):
        part = select(columns, columns["terrain"] == terrain)
        good = select(part, part["status"] == "done")
        colour, label = style.line_colour(style.terrain_colour(terrain)), style.label_text(terrain)
        for key, values in (
            ("slip", 100.0 * per_cell(x.cells(good[axis]), good["mean_slip_ratio"], n, "median")),
            ("energy", per_cell(x.cells(good[axis]), good["energy_per_m_j"], n, "median")),
            ("share", per_cell(x.cells(part[axis]), mobile(part), n, "mean")),
        ):
            plots[key].line(x.centres, values, label, colour)
            plots[key].dots(x.centres, values, label, colour, size=6.0)


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


def _groups(columns: Columns, plane: tuple[str, str]) -> list[tuple[str, float | None, NDArray[np.bool_]]]:
    """Runs of one terrain, split by payload where payloads are few and no axis of the plane."""
    payloads = levels(columns["payload_kg"])
    split = 1 < len(payloads) <= 4 and "payload_kg" not in plane
    out: list[tuple[str, float | None, NDArray[np.bool_]]] = []
    for terrain in list(dict.fromkeys(columns["terrain"]))[:MAX_GROUPS]:
        here = columns["terrain"] == terrain
        if split:
            out += [(terrain, float(p), here & (columns["payload_kg"] == p)) for p in payloads]
        else:
            out.append((terrain, None, here))
    return out


def _level_ticks(plot: Plot, x: CellAxis, y: CellAxis) -> None:
    """Ticks at the levels, where they are few."""
    for axis, cells in ((plot.panel.figure.xaxis, x), (plot.panel.figure.yaxis, y)):
        if len(cells.centres) <= FEW_LEVELS:
            axis.ticker = [float(at) for at in cells.centres]
