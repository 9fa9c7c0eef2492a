"""`report.html` of a sweep."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from terrafusion.datasets.core.tables import number
from terrafusion.fusion.reports.page import TWIN_LIBRARIES, Tile, VerdictBox, write_page
from terrafusion.fusion.reports.plots.sheet import Sheet
from terrafusion.fusion.reports.plots.sweep import LABELS, draw
from terrafusion.fusion.reports.plots.sweep_cells import varied, with_mobile
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
    runs = with_mobile(table.to_pandas())
    sheet = Sheet()
    groups = draw(sheet, runs)
    about = f"{sweep.description[:1].upper()}{sweep.description[1:]}. " if sweep.description else ""
    made_of = {
        "scenario": sweep.scenario.name, "vehicle": sweep.vehicle.name, "sha256 of the sweep": sweep.sha256(),
    }  # fmt: skip
    return write_page(
        out / "report.html", "sweep.html.j2", f"Sweep {sweep.name}",
        lead=f"{about}{sweep.vehicle.name} drives {sweep.scenario.name}: {sweep.design()}.",
        provenance=made_of | dict(provenance or {}), packages=(*TWIN_LIBRARIES, "pyarrow"),
        verdicts=[_verdict(runs)], tiles=_tiles(runs), statistics=_statistics(runs), groups=groups,
        failures=_failures(runs), **sheet.parts(),
    )  # fmt: skip


def _verdict(runs: pd.DataFrame) -> VerdictBox:
    """How many runs drove on to the end, how the others ended, and what that depends on."""
    counts = {word: int((runs["status"] == word).sum()) for word in MEANINGS}
    value = "not_to_be_used" if counts["failed"] == len(runs) else "doubtful" if counts["failed"] else "good"
    others = [word for word in MEANINGS if word != "done" and counts[word]]
    reasons = [f"{counts[word]} {MEANINGS[word]}." for word in others]
    reasons += [_along(runs, name) for name in varied(runs)]
    if runs["terrain"].nunique() > 1:
        reasons.append(_along(runs, "terrain"))
    title = f"{counts['done']} of {len(runs)} runs are mobile: they drove on to the end"
    return VerdictBox(value, title, [reason for reason in reasons if reason])


def _along(runs: pd.DataFrame, name: str) -> str:
    """The share of mobile runs at the ends of an axis, or on the best and the worst terrain."""
    shares = runs.groupby(name, sort=name != "terrain")["mobile"].mean().dropna()
    if not len(shares):
        return ""
    if name == "terrain":
        shares = shares.sort_values(ascending=False, kind="stable")
        label, ends = "Terrain", [f"on {at}" for at in shares.index[[0, -1]]]
    else:
        label, ends = LABELS[name].capitalize(), [f"at {at:g}" for at in shares.index[[0, -1]]]
    best, worst = (f"{100.0 * share:.0f} %" for share in shares.iloc[[0, -1]])
    return f"{label}: {best} of the runs are mobile {ends[0]}, {worst} {ends[1]}."


def _tiles(runs: pd.DataFrame) -> list[Tile]:
    """Share of mobile runs, and what a metre costs them."""
    good, known = runs[runs["status"] == "done"], runs["mobile"].count()
    share = f"{100.0 * len(good) / known:.0f} %" if known else number(None)
    found = [Tile("mobile runs", share, f"{len(good)} of {known} that could be computed")]
    for name, label, factor in (
        ("mean_slip_ratio", "slip ratio, %", 100.0),
        ("energy_per_m_j", "energy, J/m", 1.0),
    ):
        values = factor * good[name].dropna()
        if len(values):
            about = f"median of the mobile runs, {number(values.min())} to {number(values.max())}"
            found.append(Tile(label, number(values.median()), about))
    return found


def _statistics(runs: pd.DataFrame) -> list[list[str]]:
    rows = []
    for name, label, factor in _STATISTICS:
        values = factor * runs.get(name, pd.Series(dtype=float)).dropna()
        if len(values):
            cells = [*values.quantile([0.0, 0.25, 0.5, 0.75, 1.0]), len(values)]
            rows.append([label, *(f"{value:.4g}" for value in cells)])
    return rows


def _failures(runs: pd.DataFrame) -> list[str]:
    failed = runs[runs["status"] == "failed"]["error"]
    more = len(failed) - MOST_FAILURES
    shown = [f"run {row}: {error}" for row, error in failed.head(MOST_FAILURES).items()]
    return [*shown, f"and {more} more"] if more > 0 else shown
