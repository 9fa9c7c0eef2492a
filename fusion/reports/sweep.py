"""`report.html` of a sweep, and its plots as PNG files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from terrafusion.fusion.reports.page import TWIN_LIBRARIES, write_page, write_png
from terrafusion.fusion.reports.plots.sweep import figures
from terrafusion.fusion.reports.plots.sweep_cells import Columns, columns_of

if TYPE_CHECKING:
    from terrafusion.twin.sweep.plan import Sweep

MOST_FAILURES = 20
MEANINGS = {
    "done": "mobile: drove on to the end",
    "spinning": "wheels turned, less than a tenth of the commanded distance was driven",
    "immobilised": "stopped for good",
    "slid": "ended behind the start",
    "failed": "could not be computed",
}
_STATISTICS = (
    ("mean_abs_slip", "mean |slip| (1 - odometry / truth), %", 100.0),
    ("mean_slip_ratio", "mean slip ratio, %", 100.0),
    ("distance_m", "distance, m", 1.0),
    ("energy_per_m_j", "energy per metre, J/m", 1.0),
    ("mean_power_w", "mean power, W", 1.0),
    ("immobilised_at_s", "immobilised at, s", 1.0),
    ("odometry_error_pct", "speed error of the odometry, %", 1.0),
    ("imu_error_pct", "speed error of the IMU, %", 1.0),
    ("gnss_error_pct", "speed error of the GNSS, %", 1.0),
)


def write_sweep_report(
    out: Path, sweep: Sweep, table: Any, provenance: Mapping[str, object] | None = None
) -> list[Path]:
    """Write `report.html` and its plots (`*.png`) into the folder of a finished sweep.

    Args:
        table: pyarrow `Table` of `run_sweep`.
        provenance: further lines for the last section, such as the command line.

    Raises:
        TerrafusionError: a file cannot be written.
    """
    columns = columns_of(table)
    drawn = figures(columns)
    written = [write_png(out / f"{name}.png", fig) for name, (fig, _) in drawn.items()]
    about = f"{sweep.description[:1].upper()}{sweep.description[1:]}. " if sweep.description else ""
    made_of = {
        "scenario": sweep.scenario.name, "vehicle": sweep.vehicle.name, "sha256 of the sweep": sweep.sha256(),
    }  # fmt: skip
    page = write_page(
        out / "report.html", "sweep.html.j2", f"Sweep {sweep.name}",
        lead=f"{about}{sweep.vehicle.name} drives {sweep.scenario.name}: {sweep.design()}.",
        provenance=made_of | dict(provenance or {}), packages=(*TWIN_LIBRARIES, "pyarrow"),
        outcome=_outcome(columns), statistics=_statistics(columns), figures=drawn.values(),
        failures=_failures(columns),
    )  # fmt: skip
    return [*written, page]


def _outcome(columns: Columns) -> list[tuple[tuple[str, str], str, str]]:
    status = columns["status"]
    return [
        ((word, meaning), str(count), f"{100.0 * count / len(status):.1f} %")
        for word, meaning in MEANINGS.items()
        if (count := int((status == word).sum()))
    ]


def _statistics(columns: Columns) -> list[list[str]]:
    rows = []
    for name, label, factor in _STATISTICS:
        values = factor * columns[name][np.isfinite(columns[name])] if name in columns else np.empty(0)
        if len(values):
            cells = [*np.percentile(values, [0.0, 25.0, 50.0, 75.0, 100.0]), len(values)]
            rows.append([label, *(f"{value:.4g}" for value in cells)])
    return rows


def _failures(columns: Columns) -> list[str]:
    failed = np.flatnonzero(columns["status"] == "failed")
    more = len(failed) - MOST_FAILURES
    shown = [f"run {row}: {columns['error'][row]}" for row in failed[:MOST_FAILURES]]
    return [*shown, f"and {more} more"] if more > 0 else shown
