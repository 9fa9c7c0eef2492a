"""`report.html` of a sweep."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from terrafusion.datasets.core.tables import number
from terrafusion.fusion.reports.page import TWIN_LIBRARIES, Tile, VerdictBox, write_page
from terrafusion.fusion.reports.plots.sheet import Sheet
from terrafusion.fusion.reports.plots.sweep import LABELS, draw
from terrafusion.fusion.reports.plots.sweep_cells import Columns, columns_of, mobile, varied

if TYPE_CHECKING:
    from terrafusion.twin.sweep.plan import Sweep

MOST_FAILURES = 20
MEANINGS = {
    "done": "drove on to the end",
    "spinning": "turned the wheels, but drove less than a tenth of the commanded distance",
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
) -> Path:
    """Write `report.html` of a sweep and the pyarrow `Table` of `run_sweep` into its folder.

    `provenance` are further lines for the last section. A TerrafusionError where the file cannot be written.
    """
    columns = columns_of(table)
    sheet = Sheet()
    groups = draw(sheet, columns)
    about = f"{sweep.description[:1].upper()}{sweep.description[1:]}. " if sweep.description else ""
    made_of = {
        "scenario": sweep.scenario.name, "vehicle": sweep.vehicle.name, "sha256 of the sweep": sweep.sha256(),
    }  # fmt: skip
    return write_page(
        out / "report.html", "sweep.html.j2", f"Sweep {sweep.name}",
        lead=f"{about}{sweep.vehicle.name} drives {sweep.scenario.name}: {sweep.design()}.",
        provenance=made_of | dict(provenance or {}), packages=(*TWIN_LIBRARIES, "pyarrow"),
        verdicts=[_verdict(columns)], tiles=_tiles(columns), statistics=_statistics(columns), groups=groups,
        failures=_failures(columns), **sheet.parts(),
    )  # fmt: skip


def _verdict(columns: Columns) -> VerdictBox:
    """How many runs drove on to the end, how the others ended, and what that depends on."""
    status = columns["status"]
    counts = {word: int((status == word).sum()) for word in MEANINGS}
    value = (
        "not_to_be_used" if counts["failed"] == len(status) else "doubtful" if counts["failed"] else "good"
    )
    others = [word for word in MEANINGS if word != "done" and counts[word]]
    reasons = [f"{counts[word]} {MEANINGS[word]}." for word in others]
    reasons += [_along(columns, name) for name in varied(columns)]
    if len(set(columns["terrain"])) > 1:
        reasons.append(_along(columns, "terrain"))
    title = f"{counts['done']} of {len(status)} runs are mobile: they drove on to the end"
    return VerdictBox(value, title, [reason for reason in reasons if reason])


def _along(columns: Columns, name: str) -> str:
    """The share of mobile runs at the ends of an axis, or on the best and the worst terrain."""
    run = mobile(columns)
    known = np.isfinite(run)
    shares = {
        at: float(run[known & (columns[name] == at)].mean()) for at in dict.fromkeys(columns[name][known])
    }
    if not shares:
        return ""
    if name == "terrain":
        label, order = "Terrain", sorted(shares, key=lambda at: -shares[at])
        ends = [f"on {order[0]}", f"on {order[-1]}"]
    else:
        label, order = LABELS[name].capitalize(), sorted(shares)
        ends = [f"at {order[0]:g}", f"at {order[-1]:g}"]
    best, worst = (f"{100.0 * shares[at]:.0f} %" for at in (order[0], order[-1]))
    return f"{label}: {best} of the runs are mobile {ends[0]}, {worst} {ends[1]}."


def _tiles(columns: Columns) -> list[Tile]:
    """Share of mobile runs, and what a metre costs them."""
    good, known = columns["status"] == "done", columns["status"] != "failed"
    share = f"{100.0 * good.sum() / known.sum():.0f} %" if known.any() else number(None)
    found = [Tile("mobile runs", share, f"{good.sum()} of {known.sum()} that could be computed")]
    for name, label, factor in (
        ("mean_slip_ratio", "slip ratio, %", 100.0),
        ("energy_per_m_j", "energy, J/m", 1.0),
    ):
        values = factor * columns[name][good & np.isfinite(columns[name])]
        if len(values):
            low, high = values.min(), values.max()
            about = f"median of the mobile runs, {number(float(low))} to {number(float(high))}"
            found.append(Tile(label, number(float(np.median(values))), about))
    return found


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
