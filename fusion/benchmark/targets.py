"""The project's targets that a benchmark can decide, and their verdicts."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

from terrafusion.fusion.benchmark import compare
from terrafusion.fusion.benchmark.methods import ADAPTIVE, BASELINE
from terrafusion.fusion.benchmark.run_score import RunScore
from terrafusion.fusion.benchmark.twin_runs import FIELD
from terrafusion.fusion.metrics.consistency import Consistency
from terrafusion.fusion.metrics.pooled_consistency import PooledConsistency, pool

REACHED, OPEN, MISSED = "reached", "open", "missed"
"""The whole interval meets the limit; the interval contains it; the whole interval misses it."""
LONG_S = 120.0
INSIDE, IN_OUTAGE = "whole drive", "in outage"


@dataclass(frozen=True)
class Target:
    """One target: `found` compared with `limit`, which is an upper limit if `most`.

    `broken` is the number of replays that failed or diverged, for targets that allow none.
    """

    name: str
    what: str
    limit: float
    most: bool
    found: float | None
    interval: compare.Interval | None
    unit: str = ""
    broken: int = 0

    def verdict(self) -> str:
        """`REACHED`, `OPEN` (also without an interval) or `MISSED`; "not measured" without a number."""
        if self.broken:
            return MISSED
        if self.found is None:
            return "not measured"
        if self.interval is None:
            return OPEN
        low, high = self.interval
        if self.most:
            return REACHED if high <= self.limit else MISSED if low > self.limit else OPEN
        return REACHED if low >= self.limit else MISSED if high < self.limit else OPEN


def targets(rows: Sequence[RunScore]) -> list[Target]:
    """The criteria that there are runs for.

    - G1: `adaptive` over `fixed` and over `innovation` on mixed ground, and its share of the oracle's gain.
    - G2: what wrong labels cost on mixed ground, and `adaptive` over `fixed` on firm ground.
    - G5: drift of `adaptive` in outages of `LONG_S`.
    - G9: `adaptive` over `fixed` on field logs, with no replay that fails or diverges.
    """
    out: list[Target] = []
    against_fixed, against_innovation = compare.contrasts(rows), compare.contrasts(rows, "innovation")
    for plant in dict.fromkeys(row.plant for row in rows if row.family == "mixed"):
        at = ("mixed", plant)
        out += [
            _ratio("G1", 0.60, against_fixed, *at, ADAPTIVE),
            _ratio("G1", 0.75, against_innovation, *at, ADAPTIVE),
            *(
                Target("G1", f"mixed, {plant}: share of the oracle's gain", 0.70, False, s.share, s.interval)
                for s in compare.shares(rows)
                if (s.family, s.plant) == at
            ),
            _ratio("G2", 1.10, against_fixed, *at, "shuffled"),
        ]
    for plant in dict.fromkeys(row.plant for row in rows if row.family == "firm"):
        out.append(_ratio("G2", 1.03, against_fixed, "firm", plant, ADAPTIVE))
    for family, limit in (("outages", 1.0), ("firm", 0.5)):
        for plant in dict.fromkeys(row.plant for row in rows if row.family == family):
            out.append(_drift(rows, family, plant, limit))
    for ground in dict.fromkeys(row.plant for row in rows if row.family == FIELD):
        own = [r for r in rows if (r.family, r.plant, r.method) == (FIELD, ground, ADAPTIVE)]
        broken = sum(bool(r.failed or r.diverged) for r in own)
        found = _ratio("G9", 1.0, against_fixed, FIELD, ground, ADAPTIVE)
        out.append(dataclasses.replace(found, broken=broken))
    return [target for target in out if target.found is not None or target.broken]


def pooled_nees(rows: Sequence[RunScore]) -> list[PooledConsistency]:
    """NEES of the position by method and ground over all simulated runs: whole runs, and outages only."""
    cells = []
    for method in (ADAPTIVE, BASELINE):
        own = [row for row in rows if row.method == method and row.family != FIELD]
        for plant in dict.fromkeys(row.plant for row in own):
            mine = [row for row in own if row.plant == plant]
            for ground in dict.fromkeys(g.ground for row in mine for g in row.grounds):
                found = [_consistencies(row, ground) for row in mine]
                cells += pool(ground, f"{plant}, {method}", [one for one in found if one])
    return cells


def _consistencies(row: RunScore, ground: str) -> tuple[Consistency, ...]:
    out = []
    for g in row.grounds:
        pairs = ((INSIDE, g.nees, g.effective), (IN_OUTAGE, g.nees_outage, g.effective_outage))
        for quantity, mean, effective in pairs:
            if g.ground == ground and mean is not None and effective is not None:
                out.append(Consistency(quantity, ground, 0.0, 0.0, 0, effective, mean, 0.0, 0.0))
    return tuple(out)


def _ratio(
    name: str, limit: float, found: Sequence[compare.Contrast], family: str, plant: str, method: str
) -> Target:
    what = f"{family}, {plant}: {method}"
    for c in found:
        if (c.family, c.plant, c.method) == (family, plant, method):
            return Target(name, f"{what} over {c.baseline}", limit, True, c.ratio, c.interval)
    return Target(name, what, limit, True, None, None)


def _drift(rows: Sequence[RunScore], family: str, plant: str, limit: float) -> Target:
    what = f"{family}, {plant}: drift of {ADAPTIVE} in {LONG_S:g} s, % of the distance"
    own = [row for row in rows if (row.family, row.plant, row.method) == (family, plant, ADAPTIVE)]
    percent = [row.percent for row in own if row.outage_s == LONG_S and row.percent is not None]
    percent += [math.inf for row in own if row.failed]
    found, interval = compare.median_interval(percent) if percent else (None, None)
    return Target("G5", what, limit, True, found, interval, "%")
