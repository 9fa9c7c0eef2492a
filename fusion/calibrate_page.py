"""What a calibration leaves behind: `calibration.json`, the corrected YAML files and `report.html`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from html import escape
from pathlib import Path

from terrafusion.datasets.atomic import write_atomically
from terrafusion.fusion import calibrate_plots as plots
from terrafusion.fusion.report_page import bullets, figure, where_from, write_page
from terrafusion.twin.identify.files import write_files
from terrafusion.twin.identify.result import Calibration

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
    told = len(c.fitted) - len(c.untold())
    lead = (
        f"{told} of {len(c.fitted)} numbers are told by {len(c.sensor_errors)} log(s), "
        f"{c.seconds_of_data:.0f} s in all. The search {c.sentence}."
    )
    return f'<h1>{escape(title)}</h1>\n<p class="lead">{escape(lead)}</p>'


def _numbers(c: Calibration) -> str:
    rows = "".join(
        f'<tr><th>{escape(f.name)}</th><td class="n">{f.start:.5g}</td><td class="n">{f.value:.5g}</td>'
        f'<td class="n">{f.sigma:.2g}</td><td>{escape(f.unit)}</td><td class="n">{f.ratio:.3f}</td>'
        f"<td>{escape(f.status)}{' (at the end of its range)' if f.at_bound else ''}</td></tr>"
        for f in c.fitted
    )
    head = (
        '<th></th><th class="n">before</th><th class="n">after</th><th class="n">1 sigma</th><th>unit</th>'
        '<th class="n">sigma after / before</th><th>told?</th>'
    )
    fig, _ = plots.plot_numbers(c)
    caption = "Each number over its prior value, with two sigma; the grey bar is two sigma of the prior."
    return (
        f'<h2>Numbers</h2>\n<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody>'
        f"</table></div>\n{figure(fig, caption)}"
    )


def _told(c: Calibration) -> str:
    weak = [escape(d.sentence) for d in c.identifiability.weak]
    said = bullets(weak) if weak else "<p>Every combination of the numbers is told by the data.</p>"
    fig, _ = plots.plot_correlation(c)
    caption = "Correlation of the errors: numbers near one or minus one can trade against each other."
    return f"<h2>What the data can tell</h2>\n{said}\n{figure(fig, caption)}"


def _fits(c: Calibration) -> str:
    rows = "".join(
        f'<tr><th>{escape(f.log)}</th><td>{escape(f.channel)}</td><td class="n">{len(f.measured)}</td>'
        f'<td class="n">{f.rms(f.before):.3g}</td><td class="n">{f.rms(f.after):.3g}</td>'
        f'<td class="n">{f.sigma:.3g}</td><td class="n">{f.correlation:.2f}</td>'
        f'<td class="n">{f.left:.2f}</td><td class="n">{100.0 * f.outliers:.1f} %</td></tr>'
        for f in c.channels
    )
    head = "".join(
        f'<th class="n">{word}</th>'
        for word in ("rows", "rms before", "rms after", "noise", "neighbours", "whitened", "outliers")
    )
    parts = [
        '<h2>Twin against log</h2>\n<div class="scroll"><table><thead><tr><th>log</th><th>channel</th>'
        f"{head}</tr></thead><tbody>{rows}</tbody></table></div>",
        '<p class="dim">Noise: 1 sigma of a row, estimated. Neighbours: correlation of residuals one row '
        "apart, and what whitening leaves of it. Outliers: beyond four sigma.</p>",
    ]
    for log in list(c.sensor_errors)[:MOST_FIGURES]:
        fig, _ = plots.plot_channels(c, log)
        parts.append(figure(fig, f"{log}: measured, and the twin before and after."))
    return "\n".join(parts)
