"""Figures of a diagnosis: paths, the gap map, ranked causes, errors before and after the effect is added."""

from pathlib import Path

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.reports.plots import style
from terrafusion.fusion.reports.plots.sheet import Sheet, name_ticks
from terrafusion.twin.gap.answer.cells import BANDS, REGIMES, regimes
from terrafusion.twin.gap.answer.diagnosis import GapDiagnosis
from terrafusion.twin.gap.rollout.nuisance import CHANNEL_NAMES, CHANNEL_UNITS, commanded_twist
from terrafusion.twin.gap.rollout.residuals import WhitenedRun, physical_error

MOST_CAUSES = 8
PLACE_S = 0.5
"""Interval of a path that is drawn as one point."""


def plot_map(sheet: Sheet, d: GapDiagnosis) -> None:
    """Channel by regime (both bands): share of the excess error; a dot where it is significant."""
    from bokeh.palettes import Oranges256

    channels = list(dict.fromkeys(c.channel for c in d.where))
    columns = [(r, b) for r, _ in REGIMES for b in BANDS]
    share = np.full((len(channels), len(columns)), np.nan)
    places = np.array([(columns.index((c.regime, c.band)), channels.index(c.channel)) for c in d.where])
    share[places[:, 1], places[:, 0]] = [100.0 * c.share for c in d.where]
    plot = sheet.add_rows("cells where", "", channels, x_range=(-0.5, len(columns) - 0.5))
    fig = plot.panel.figure
    fig.height += 110
    palette = Oranges256[::-1][20:]
    x, y = (np.arange(-0.5, n) for n in (len(columns), len(channels)))
    plot.cells(x, y, share, palette, limits=(0.0, max(float(np.nanmax(share)), 1.0)))
    sure = places[[c.p_value <= d.significance for c in d.where]].astype(float)
    if len(sure):
        plot.dots(sure[:, 0], sure[:, 1], "significant", "#1a1a1a", size=5.0)
    name_ticks(fig.xaxis, [f"{r}, {b}" for r, b in columns])
    fig.xaxis.major_label_orientation = 0.9


def plot_causes(sheet: Sheet, d: GapDiagnosis) -> None:
    """What each of the first causes explains by itself of what the best do, with its probability."""
    causes = [c for c in d.verdict.causes if c.share is not None][:MOST_CAUSES]
    alike = {name for s in d.verdict.sets if s.named for name in s.effects}
    names = [f"{c.effect} ({100.0 * c.probability:.0f} %)" for c in causes]
    x = "explained by itself, % of what the best effects explain"
    plot = sheet.add_rows("rows causes", x, names, x_range=(0.0, 105.0))
    kinds = ["named" if c.effect in d.verdict.named else "alike" if c.effect in alike else "" for c in causes]
    for kind, label, colour in (
        ("named", "named", style.AFTER),
        ("alike", "looks like a named one", style.MODE_COLOURS["innovation"]),
        ("", "other", style.NEUTRAL),
    ):
        rows = np.flatnonzero(np.array(kinds) == kind).astype(float)
        if len(rows):
            share = [100.0 * float(np.clip(causes[int(i)].share or 0.0, 0.0, 1.0)) for i in rows]
            bars = {"y": rows, "right": np.array(share)}
            plot.glyph("hbar", bars, label, colour, "area", height=0.6, line_width=0)


def plot_paths(sheet: Sheet, d: GapDiagnosis, most: int) -> list[str]:
    """Path of each judged run, coloured by the error of the first place's channel, its regime ringed; gives
    the keys of the figures.
    """
    from bokeh.models import ColorBar, LinearColorMapper
    from bokeh.palettes import Inferno256

    place, runs = next(iter(d.where), None), d.evidence.runs[:most]
    name = place.channel if place is not None else CHANNEL_NAMES[d.evidence.channels[0]]
    drawn = [_place_errors(d, i, name) for i in range(len(runs))]
    top = max((float(np.quantile(e, 0.98)) for _, _, e in drawn if len(e)), default=1.0)
    mapper = LinearColorMapper([*Inferno256[::-1][30:-20]], low=0.0, high=top)
    for i, (run, (at, t_s, error)) in enumerate(zip(runs, drawn, strict=True)):
        plot = sheet.add_map(f"path{i}", "x, m", "y, m", 320)
        plot.line(at[:, 0], at[:, 1], "path", style.NEUTRAL, width=1.0)
        if place is not None:
            index = [r for r, _ in REGIMES].index(place.regime)
            order = np.argsort(run.time_s)
            inside = (regimes(run, d.evidence.model) == index).astype(float)
            known = np.interp(t_s, run.time_s[order], inside[order]) > 0.5
            plot.dots(at[known, 0], at[known, 1], place.regime, style.TRUTH_ON_ANY, "ring", 10.0)
        colour = {"field": "error", "transform": mapper}
        tips = {f"{name}, {CHANNEL_UNITS[name]}": "@error{0.###}", "time, s": "@t{0.#}"}
        data = {"x": at[:, 0], "y": at[:, 1]}
        more = {"error": error, "t": t_s}
        plot.glyph("scatter", data, "", colour, "dot", more=more, tips=tips, size=6.0, line_width=0)
        look = {"background_fill_alpha": 0.0, "major_label_text_color": style.NEUTRAL}
        plot.panel.figure.add_layout(ColorBar(color_mapper=mapper, width=10, padding=2, **look), "right")
        plot.panel.figure.title = f"{Path(run.name).name}: error of {name}, {CHANNEL_UNITS[name]}"
        plot.panel.figure.title.text_color = style.NEUTRAL
    return [f"path{i}" for i in range(len(runs))]


def _place_errors(d: GapDiagnosis, i: int, name: str) -> tuple[Array, Array, Array]:
    """Positions (n, 2), times (n,) and root mean squares (n,) of a channel's error by interval of a run."""
    run = d.evidence.runs[i]
    error = physical_error(run, d.evidence.noise, d.shrinkage.errors_before[i])
    mine = np.isin(run.channel, [k for k, c in enumerate(d.evidence.channels) if CHANNEL_NAMES[c] == name])
    _, group = np.unique(np.floor(run.time_s[mine] / PLACE_S), return_inverse=True)
    count = np.maximum(np.bincount(group), 1)
    t_s = np.bincount(group, run.time_s[mine]) / count
    return _positions(d, run, t_s), t_s, np.sqrt(np.bincount(group, error[mine] ** 2) / count)


def _positions(d: GapDiagnosis, run: WhitenedRun, t_s: Array) -> Array:
    """Positions (n, 2) at times: fixes; without any, the commands integrated."""
    fixes = {o.channel: o for o in run.log.observed if o.channel in ("gnss_east_m", "gnss_north_m")}
    if len(fixes) == 2:
        return np.stack([np.interp(t_s, o.end_s, o.value - o.value[0]) for o in fixes.values()], axis=1)
    grid, twist = commanded_twist(run.log, d.evidence.model)
    step = float(grid[1] - grid[0])
    yaw = np.cumsum(twist[:, 1]) * step
    path = [np.cumsum(twist[:, 0] * f(yaw)) * step for f in (np.cos, np.sin)]
    return np.stack([np.interp(t_s, grid, x) for x in path], axis=1)


def plot_shrink(sheet: Sheet, d: GapDiagnosis) -> None:
    """Error of every channel before, after and in the references, in sigmas; its unit beside the name."""
    names, rows = list(d.shrinkage.channels), list(d.shrinkage.channels.values())
    texts = []
    for name in names:
        before, after, _ = d.shrinkage.physical[name]
        texts.append(f"{name}: {before:.2g} \u2192 {after:.2g} {CHANNEL_UNITS[name]}")
    plot = sheet.add_rows("rows shrink", "root mean square error, in sigmas of its noise", texts)
    arms = [("before", style.BEFORE, "circle", 0), ("after", style.AFTER, "circle", 1)]
    if d.references:
        arms.append(("references", style.TRUTH_ON_ANY, "ring", 2))
    at = np.arange(len(names), dtype=float)
    ends = {"y0": at, "y1": at} | {f"x{k}": np.array([row[k] or 0.0 for row in rows]) for k in (0, 1)}
    plot.glyph("segment", ends, "", style.NEUTRAL, "line", line_width=2)
    for label, colour, marker, k in arms:
        values = np.array([np.nan if row[k] is None else row[k] for row in rows], dtype=float)
        plot.dots(values, at, label, colour, marker, 14.0 if marker == "ring" else 9.0)


def plot_errors(sheet: Sheet, d: GapDiagnosis, run: int) -> list[str]:
    """Errors of one run over time in the units of the channels, before and after; the keys of the figures."""
    evidence, channels = d.evidence.runs[run], d.evidence.channels
    sheet.begin_axis(float(evidence.time_s.max(initial=1.0)))
    arms = [
        (label, colour, physical_error(evidence, d.evidence.noise, errors[run]))
        for label, colour, errors in (
            ("before", style.BEFORE, d.shrinkage.errors_before),
            ("after", style.AFTER, d.shrinkage.errors_after),
        )
    ]
    keys = [f"error{run}_{i}" for i in range(len(channels))]
    for i, (key, channel) in enumerate(zip(keys, channels, strict=True)):
        unit = CHANNEL_UNITS[CHANNEL_NAMES[channel]]
        plot = sheet.add_time(key, f"{channel.rsplit('_', 1)[0]}, {unit}", 170)
        mine = np.flatnonzero(evidence.channel == i)
        mine = mine[style.thin(len(mine))]
        for label, colour, error in arms:
            plot.dots(evidence.time_s[mine], error[mine], label, colour, size=2.5)
    return keys
