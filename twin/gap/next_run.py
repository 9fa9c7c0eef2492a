"""Which drive would tell two look-alikes apart: the twin drives each, and their signatures are compared."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.errors import TerrafusionError
from terrafusion.twin.drive import open_loop
from terrafusion.twin.gap.evidence import WINDOW_S, Bench
from terrafusion.twin.gap.residuals import SOIL_STATE, Evidence, raw_of, whitened
from terrafusion.twin.gap.score import score
from terrafusion.twin.gap.signatures import drive
from terrafusion.twin.identify.inputs import DT_S
from terrafusion.twin.identify.log import Log
from terrafusion.twin.identify.observations import Observed
from terrafusion.twin.scenario import Scenario, load_scenario

Array = NDArray[np.float64]

SECONDS = 40.0
SCENARIOS = ("spin", "figure_eight", "staircase", "chirp", "straight", "circle")
"""Drives that are tried, by name."""
ENOUGH = 0.95
"""A correlation below this separates."""


@dataclass(frozen=True)
class NextRun:
    """A drive and the two effects that it separates."""

    scenario: str
    separates: tuple[str, str]
    why: str


def propose(bench: Bench, sigma: Array, one: str, other: str) -> NextRun | None:
    """The drive on which two effects look least alike for their signal; None where no drive separates
    them."""
    best: tuple[float, float, str] | None = None
    for name in SCENARIOS:
        try:
            alike, signal = _likeness(bench, sigma, load_scenario(name), one, other)
        except TerrafusionError:
            continue
        told = signal * (1.0 - alike**2)
        if best is None or told > best[0]:
            best = (told, alike, name)
    if best is None or best[1] > ENOUGH:
        return None
    why = (
        f"in the twin, {SECONDS:.0f} s of '{best[2]}' make {one} and {other} look alike to {best[1]:.2f} "
        "only (1 = the same), the clearest of the drives tried"
    )
    return NextRun(best[2], (one, other), why)


def _likeness(bench: Bench, sigma: Array, scenario: Scenario, one: str, other: str) -> tuple[float, float]:
    """Canonical correlation of two effects' projected signatures in a drive, and the lesser signal."""
    run = _forecast(bench, scenario, one, other)
    A = score(run, sigma).A
    first, second = (list(bench.candidates.columns(e)) for e in (one, other))
    parts = [A[np.ix_(c, c)] + 1e-9 * np.eye(len(c)) for c in (first, second)]
    roots = [np.linalg.cholesky(part) for part in parts]
    cross = np.linalg.solve(roots[0], A[np.ix_(first, second)])
    cross = np.linalg.solve(roots[1], cross.T)
    alike = float(np.clip(np.linalg.svd(cross, compute_uv=False)[0], 0.0, 1.0))
    return alike, min(float(np.diag(part).max()) for part in parts)


def _forecast(bench: Bench, scenario: Scenario, one: str, other: str) -> Evidence:
    """Evidence of a drive that has not been driven: its errors are zero."""
    template, model = bench.runs[0].log, bench.model
    t_s = DT_S * np.arange(round(min(SECONDS, scenario.duration_s) / DT_S) + 1.0)
    if scenario.waypoints:
        raise TerrafusionError("a drive by waypoints is not open loop")
    _, inputs = open_loop(scenario, t_s, dataclasses.replace(model.vehicle, drive=dataclasses.replace(
        model.vehicle.drive, dead_time_s=0.0)))  # fmt: skip
    size = round(WINDOW_S / DT_S)
    edges = np.append(np.arange(0, len(t_s) - 1, size), len(t_s) - 1)
    windows = np.stack([edges[:-1], edges[1:]], axis=1)
    windows = windows[windows[:, 1] - windows[:, 0] >= size // 2]
    end = float(windows[-1, 1]) * DT_S
    log = Log(
        scenario.name, inputs[:, :2], template.follows, template.labels[:1], np.zeros(0), windows,
        np.zeros((len(windows), 3)), tuple(_rows(o, end) for o in template.observed), True, (),
    )  # fmt: skip
    keys = {k for k in bench.candidates.keys if k.split("/")[0] in (one, other) or k in SOIL_STATE}
    found = drive(log, model, bench.candidates, log.start, keys)
    return whitened(raw_of(log, found, model, bench.candidates, bench.channels), bench.noise)


def _rows(observed: Observed, end_s: float) -> Observed:
    """Regular rows of a channel up to a time, as noisy as those of a log."""
    slot = np.arange(1, max(2, int(end_s / observed.slot_s)))
    end: Array = slot.astype(float) * observed.slot_s
    length = float(np.median(observed.end_s - observed.begin_s))
    return Observed(
        observed.channel, end - length, end, np.zeros(len(slot)), np.full(len(slot),
        np.median(observed.sigma)), slot, observed.slot_s, observed.least, observed.correlation,
    )  # fmt: skip
