"""The files of a calibration: `calibration.json`, the corrected YAML files and `report.html`."""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from terrafusion.datasets.core.tables import number
from terrafusion.fusion.reports.page import TWIN_LIBRARIES, Tile, VerdictBox, write_page, write_text
from terrafusion.fusion.reports.plots import style
from terrafusion.fusion.reports.plots.sheet import Sheet, name_ticks
from terrafusion.twin.calibrate.files import write_files
from terrafusion.twin.calibrate.identifiability import COMBINED, IDENTIFIED, NOT_IDENTIFIED
from terrafusion.twin.calibrate.result import Calibration

MOST_FIGURES = 3
"""Logs beyond this many have no plots of their own in the report; `calibration.json` has their numbers."""
STATUS = {IDENTIFIED: "yes", COMBINED: "only in combination", NOT_IDENTIFIED: "no"}


def write_calibration(
    out: Path,
    c: Calibration,
    vehicle: str | Path,
    soils: Mapping[str, str | Path] | None = None,
    provenance: Mapping[str, object] | None = None,
) -> None:
    """All files of one calibration in the folder `out`, numbers first.

    Args:
        vehicle, soils: names or files that it started from.
        provenance: further lines for the report's last section.

    Raises:
        TerrafusionError: the folder cannot be written.
    """
    text = json.dumps(c.as_dict(), indent=1, allow_nan=False)
    write_text(out / "calibration.json", text + "\n")
    write_files(c, out, vehicle, soils)
    sheet = Sheet()
    plot_parameters(sheet, c)
    plot_correlation(sheet, c)
    fits = {log: plot_channels(sheet, c, log) for log in list(c.sensor_errors)[:MOST_FIGURES]}
    name, grounds = c.model.vehicle.name, ", ".join(c.model.soils)
    write_page(
        out / "report.html", "calibration.html.j2", f"Calibration of {name} on {grounds}",
        verdicts=[_verdict(c)], tiles=_tiles(c), provenance=provenance, packages=TWIN_LIBRARIES,
        parameters=_parameters(c), channels=_channels(c), notes=c.notes, fits=fits, **sheet.parts(),
    )  # fmt: skip


def _verdict(c: Calibration) -> VerdictBox:
    """Whether the numbers can be used, and a sentence for each that cannot, or only together with others."""
    edges = [f.name for f in c.fitted if f.at_bound]
    reasons = [f"The search {c.sentence}."]
    reasons += [f"{name} ended at the end of its range: its sigma says little." for name in edges]
    reasons += [f"{d.sentence}." for d in c.identifiability.weak]
    if not c.converged():
        return VerdictBox("not_to_be_used", "Not to be used: the search did not converge", reasons)
    misfits = [sentence for channel in c.channels if (sentence := channel.misfit()) is not None]
    reasons += misfits
    known = len(c.fitted) - len(c.unidentified())
    value = "doubtful" if edges or c.unidentified() or misfits else "good"
    return VerdictBox(value, f"{known} of {len(c.fitted)} parameters are identified", reasons)


def _tiles(c: Calibration) -> list[Tile]:
    """How far the fit helps, what has changed most, and how much data there is."""
    ratios = [f.rms(f.after) / f.rms(f.before) for f in c.channels if f.rms(f.before) > 0.0]
    moved = max(c.fitted, key=lambda f: abs(f.value - f.prior) / f.prior_sigma)
    count = len(c.sensor_errors)
    return [
        Tile(
            "error of the twin, after / before", number(float(np.median(ratios)) if ratios else None),
            f"median of {len(ratios)} channels, root mean square",
        ),
        Tile(
            "largest change, prior sigmas",
            f"{round((moved.value - moved.prior) / moved.prior_sigma, 1) + 0.0:+.1f}",
            moved.name,
        ),
        Tile("data, s", f"{c.seconds_of_data:.0f}", f"of {count} log{'s' if count > 1 else ''}"),
    ]  # fmt: skip


def _parameters(c: Calibration) -> list[list[str]]:
    doubt = "" if c.converged() else " (not valid)"
    return [
        [
            f.name, f"{f.start:.5g}", f"{f.value:.5g}", f"{f.sigma:.2g}{doubt}", f.unit, f"{f.ratio:.3f}",
            f"{STATUS[f.status]}{' (at the end of its range)' if f.at_bound else ''}",
        ]
        for f in c.fitted
    ]  # fmt: skip


def _channels(c: Calibration) -> list[list[str]]:
    return [
        [
            f.log, f.channel, str(len(f.measured)), f"{f.rms(f.before):.3g}", f"{f.rms(f.after):.3g}",
            f"{f.sigma:.3g}", f"{f.correlation:.2f}", f"{f.left:.2f}", f"{100.0 * f.outliers:.1f} %",
        ]
        for f in c.channels
    ]  # fmt: skip


def plot_parameters(sheet: Sheet, calibration: Calibration) -> None:
    """Each parameter in prior sigmas about its prior, with two sigma; hollow where not identified."""
    fitted = calibration.fitted
    plot = sheet.add_rows(
        "rows parameters", "prior sigmas from the prior value", _short([f.name for f in fitted])
    )
    rows = np.arange(len(fitted), dtype=float)
    prior = {"left": np.array([-2.0]), "right": np.array([2.0])}
    prior |= {"top": np.array([-0.5]), "bottom": np.array([len(fitted) - 0.5])}
    label = "two sigma of the prior"
    plot.glyph("quad", prior, label, style.EXPECTED_ON_ANY, "area", alpha=0.25, line_width=0)
    value, sigma, start = (
        np.array([(f.value - f.prior, f.sigma, f.start - f.prior) for f in fitted])
        / np.array([[f.prior_sigma] for f in fitted])
    ).T
    known = np.array([f.status == IDENTIFIED for f in fitted])
    for chosen, label in ((known, "fitted"), (~known, "not identified")):
        if chosen.any():
            mine = value[chosen], (value - 2 * sigma)[chosen], (value + 2 * sigma)[chosen]
            plot.intervals(rows[chosen], *mine, label, style.AFTER, hollow=label != "fitted")
    plot.glyph(
        "scatter", {"x": start, "y": rows}, "start", style.BEFORE, "dot", marker="dash", angle=1.571, size=16
    )


def plot_correlation(sheet: Sheet, calibration: Calibration) -> None:
    """Correlation matrix; nothing for one parameter."""
    from bokeh.palettes import RdBu11, interp_palette

    names = _short([f.name for f in calibration.fitted])
    if len(names) < 2:
        return
    edges = np.arange(-0.5, len(names))
    size = (len(names) - 0.5, -0.5)
    plot = sheet.add("cells correlation", "", "", 190 + 34 * len(names), y_range=size)
    plot.cells(edges, edges, calibration.correlation, interp_palette(RdBu11, 256), limits=(-1.0, 1.0))
    for axis in (plot.panel.figure.xaxis, plot.panel.figure.yaxis):
        name_ticks(axis, names)
    plot.panel.figure.xaxis.major_label_orientation = 0.8


def plot_channels(sheet: Sheet, calibration: Calibration, log: str) -> list[str]:
    """Every channel of one log over time: measured, the twin before and after; the keys of the figures."""
    fits = [c for c in calibration.channels if c.log == log]
    sheet.begin_axis(max((float(c.t_s[-1]) for c in fits), default=1.0))
    keys = [f"channel{len(sheet.panels) + i}" for i in range(len(fits))]
    for key, fit in zip(keys, fits, strict=True):
        plot = sheet.add_time(key, fit.channel, 170)
        rows = style.thin(len(fit.t_s))
        plot.dots(fit.t_s[rows], fit.measured[rows], "measured", style.TRUTH_ON_ANY, size=2.0)
        plot.line(fit.t_s, fit.before, "twin before", style.BEFORE, width=1.2)
        plot.line(fit.t_s, fit.after, "twin after", style.AFTER, width=1.2)
    return keys


def _short(names: list[str]) -> list[str]:
    """The last two parts of each name, or all of it where others end alike."""
    short = [".".join(name.split(".")[-2:]) for name in names]
    return [one if short.count(one) == 1 else name for one, name in zip(short, names, strict=True)]
