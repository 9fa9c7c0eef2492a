"""`report.html` of a sweep, and its plots as PNG files."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from terrafusion.datasets.core.files import write_atomically
from terrafusion.fusion.reports.page import bullets, figure, where_from, write_page
from terrafusion.fusion.reports.page import table as page_table
from terrafusion.fusion.reports.plots.sweep import figures
from terrafusion.fusion.reports.plots.sweep_cells import Columns, columns_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from terrafusion.twin.sweep.plan import Sweep

MOST_FAILURES = 20
MEANINGS = {
    "done": "drove on to the end",
    "spinning": "wheels turned, less than a tenth of the way was made",
    "immobilised": "came to rest for good",
    "slid": "ended behind the start",
    "failed": "could not be computed",
}
_NUMBERS = (
    ("mean_abs_slip", "mean |slip| (1 - odometry / truth)", 100.0, "%"),
    ("mean_slip_ratio", "mean slip ratio", 100.0, "%"),
    ("distance_m", "distance", 1.0, "m"),
    ("energy_per_m_j", "energy a metre", 1.0, "J/m"),
    ("mean_power_w", "mean power", 1.0, "W"),
    ("immobilised_at_s", "immobilised at", 1.0, "s"),
    ("odometry_error_pct", "speed error of the odometry", 1.0, "%"),
    ("imu_error_pct", "speed error of the IMU", 1.0, "%"),
    ("gnss_error_pct", "speed error of the GNSS", 1.0, "%"),
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
    written = [_write_png(out / f"{name}.png", fig) for name, (fig, _) in drawn.items()]
    body = [
        f'<h1>Sweep {escape(sweep.name)}</h1>\n<p class="lead">{escape(_lead(sweep))}</p>',
        _outcome(columns),
        _numbers(columns),
        *(figure(fig, caption) for fig, caption in drawn.values()),
        _failures(columns),
        where_from(
            {
                "scenario": sweep.scenario.name,
                "vehicle": sweep.vehicle.name,
                "sha256 of the sweep": sweep.sha256(),
                **dict(provenance or {}),
            },
            ("casadi", "numpy", "scipy", "pyarrow"),
        ),
    ]
    return [*written, write_page(out / "report.html", f"Sweep {sweep.name}", body)]


def _write_png(path: Path, fig: Figure) -> Path:
    return write_atomically(path, lambda part: fig.savefig(part, format="png", dpi=150))


def _lead(sweep: Sweep) -> str:
    what = f"{sweep.description[:1].upper()}{sweep.description[1:]}. " if sweep.description else ""
    return f"{what}{sweep.vehicle.name} drives {sweep.scenario.name}: {sweep.design()}."


def _outcome(columns: Columns) -> str:
    status = columns["status"]
    rows = [
        (f'{word}<span class="about">{meaning}</span>', str(count), f"{100.0 * count / len(status):.1f} %")
        for word, meaning in MEANINGS.items()
        if (count := int((status == word).sum()))
    ]
    return f"<h2>How the runs ended</h2>\n{page_table(('', 'runs', 'share'), rows, (1, 2))}"


def _numbers(columns: Columns) -> str:
    rows = []
    for name, label, factor, unit in _NUMBERS:
        values = factor * columns[name][np.isfinite(columns[name])] if name in columns else np.empty(0)
        if len(values):
            cells = [*np.percentile(values, [0.0, 25.0, 50.0, 75.0, 100.0]), len(values)]
            rows.append([f"{escape(label)}, {unit}", *(f"{value:.4g}" for value in cells)])
    heads = ("", "least", "25 %", "median", "75 %", "most", "runs")
    return f"<h2>The runs in numbers</h2>\n{page_table(heads, rows, range(1, 7))}\n<h2>Plots</h2>"


def _failures(columns: Columns) -> str:
    failed = np.flatnonzero(columns["status"] == "failed")
    if not len(failed):
        return ""
    shown = [f"run {row}: {escape(str(columns['error'][row]))}" for row in failed[:MOST_FAILURES]]
    more = len(failed) - len(shown)
    return f"<h2>Runs that failed</h2>\n{bullets([*shown, *([f'and {more} more'] if more else [])])}"
