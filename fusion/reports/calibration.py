"""What a calibration leaves behind: `calibration.json`, the corrected YAML files and `report.html`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from html import escape
from pathlib import Path

from terrafusion.datasets.core.files import write_atomically
from terrafusion.fusion.reports.page import bullets, figure, table, where_from, write_page
from terrafusion.fusion.reports.plots import calibration as plots
from terrafusion.twin.calibrate.files import write_files
from terrafusion.twin.calibrate.result import Calibration

MOST_FIGURES = 6
"""Logs beyond this many have no plots of their own in the report; `calibration.json` has their numbers."""


def write_calibration(
    out: Path,
    calibration: Calibration,
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
    text = json.dumps(calibration.as_dict(), indent=1, allow_nan=False)
    write_atomically(out / "calibration.json", lambda part: part.write_text(text + "\n", encoding="utf-8"))
    write_files(calibration, out, vehicle, soils)
    write_report(out / "report.html", calibration, provenance)


def write_report(path: Path, c: Calibration, provenance: Mapping[str, object] | None = None) -> Path:
    """The report alone."""
    title = f"Calibration of {c.model.vehicle.name} on {', '.join(c.model.soils)}"
    body = [_head(title, c), _numbers(c), _told(c), _fits(c)]
    body.append(f"<h2>What was assumed</h2>\n{bullets(escape(note) for note in c.notes)}")
    body.append(where_from(dict(provenance or {}), ("casadi", "numpy", "scipy")))
    return write_page(path, title, body)


def _head(title: str, c: Calibration) -> str:
    told = len(c.fitted) - len(c.unidentified())
    lead = (
        f"{told} of {len(c.fitted)} numbers are told by {len(c.sensor_errors)} log(s), "
        f"{c.seconds_of_data:.0f} s in all. The search {c.sentence}."
    )
    return f'<h1>{escape(title)}</h1>\n<p class="lead">{escape(lead)}</p>'


def _numbers(c: Calibration) -> str:
    doubt = "" if c.converged() else " (not valid)"
    rows = [
        (
            escape(f.name), f"{f.start:.5g}", f"{f.value:.5g}", f"{f.sigma:.2g}{doubt}", escape(f.unit),
            f"{f.ratio:.3f}", f"{escape(f.status)}{' (at the end of its range)' if f.at_bound else ''}",
        )
        for f in c.fitted
    ]  # fmt: skip
    heads = ("", "before", "after", "1 sigma", "unit", "sigma after / before", "told?")
    fig, _ = plots.plot_numbers(c)
    caption = "Each number over its prior value, with two sigma; the grey bar is two sigma of the prior."
    return f"<h2>Numbers</h2>\n{table(heads, rows, (1, 2, 3, 5))}\n{figure(fig, caption)}"


def _told(c: Calibration) -> str:
    weak = [escape(d.sentence) for d in c.identifiability.weak]
    said = bullets(weak) if weak else "<p>Every combination of the numbers is told by the data.</p>"
    fig, _ = plots.plot_correlation(c)
    caption = "Correlation of the errors: numbers near one or minus one can trade against each other."
    return f"<h2>What the data can tell</h2>\n{said}\n{figure(fig, caption)}"


def _fits(c: Calibration) -> str:
    rows = [
        (
            escape(f.log), escape(f.channel), str(len(f.measured)), f"{f.rms(f.before):.3g}",
            f"{f.rms(f.after):.3g}", f"{f.sigma:.3g}", f"{f.correlation:.2f}", f"{f.left:.2f}",
            f"{100.0 * f.outliers:.1f} %",
        )
        for f in c.channels
    ]  # fmt: skip
    heads = ("log", "channel", "rows", "before", "after", "noise", "neighbours", "whitened", "outliers")
    parts = [
        f"<h2>Twin against log</h2>\n{table(heads, rows, range(2, 9))}",
        '<p class="dim">Before, after: root-mean-square residual. Noise: 1 sigma of a row, estimated. '
        "Neighbours: correlation of residuals one row apart, and what whitening leaves of it. "
        "Outliers: beyond four sigma.</p>",
    ]
    for log in list(c.sensor_errors)[:MOST_FIGURES]:
        fig, _ = plots.plot_channels(c, log)
        parts.append(figure(fig, f"{log}: measured, and the twin before and after."))
    return "\n".join(parts)
