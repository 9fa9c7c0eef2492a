"""The files of a calibration: `calibration.json`, the corrected YAML files and `report.html`."""

import json
from collections.abc import Mapping
from pathlib import Path

from terrafusion.fusion.reports.page import TWIN_LIBRARIES, write_page, write_text
from terrafusion.fusion.reports.plots import calibration as plots
from terrafusion.twin.calibrate.files import write_files
from terrafusion.twin.calibrate.identifiability import COMBINED, IDENTIFIED, NOT_IDENTIFIED
from terrafusion.twin.calibrate.result import Calibration

MOST_FIGURES = 6
"""Logs beyond this many have no plots of their own in the report; `calibration.json` has their numbers."""
STATUS = {IDENTIFIED: "yes", COMBINED: "only in combination", NOT_IDENTIFIED: "no"}


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
    write_text(out / "calibration.json", text + "\n")
    write_files(calibration, out, vehicle, soils)
    write_report(out / "report.html", calibration, provenance)


def write_report(path: Path, c: Calibration, provenance: Mapping[str, object] | None = None) -> Path:
    """The report alone."""
    lead = (
        f"{len(c.fitted) - len(c.unidentified())} of {len(c.fitted)} parameters are identified by "
        f"{len(c.sensor_errors)} log(s), {c.seconds_of_data:.0f} s in all. The search {c.sentence}."
    )
    return write_page(
        path, "calibration.html.j2", f"Calibration of {c.model.vehicle.name} on {', '.join(c.model.soils)}",
        lead=lead, provenance=provenance, packages=TWIN_LIBRARIES, parameters=_parameters(c),
        channels=_channels(c), weak=[d.sentence for d in c.identifiability.weak], notes=c.notes,
        figures={"parameters": plots.plot_parameters(c), "correlation": plots.plot_correlation(c)},
        fits={log: plots.plot_channels(c, log) for log in list(c.sensor_errors)[:MOST_FIGURES]},
    )  # fmt: skip


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
