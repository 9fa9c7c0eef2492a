"""Causes of losses of the adaptive weighting: detector or policy, which ground, which error.

The detector is to blame if the true labels would have won, else the policy. The ground and the kind of error
are those with the largest excess of mean square velocity error over the winning method, weighted by time.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

from terrafusion.fusion.benchmark.compare import EVEN, contrasts, groups_of
from terrafusion.fusion.benchmark.methods import ADAPTIVE, ORACLE
from terrafusion.fusion.benchmark.run_score import RunScore

BASELINES = ("data sheet", "fixed", "robust", "innovation")
KINDS = {
    "forward_mps": "speed along the robot (slip, wheels)",
    "side_mps": "speed across the robot (side-slip)",
    "heading_mps": "heading (gyro)",
}


@dataclass(frozen=True)
class Reason:
    """One family on one plant in which a baseline has smaller errors.

    Attributes:
        ratio: median of the paired ratios, adaptive over `winner`; `sure` if significantly above 1.
        oracle: the same ratio for true labels, or None.
        ground, kind: ground and quantity of the largest loss; "" without a true velocity.
        recognised: share of the outages with the right ground detected: on all grounds, and on `ground`.
    """

    family: str
    plant: str
    winner: str
    ratio: float
    sure: bool
    oracle: float | None
    ground: str
    kind: str
    recognised: tuple[float | None, float | None]

    def blame(self) -> str:
        """ "detector" or "policy"; "not known" without true labels."""
        if self.oracle is None:
            return "not known"
        return "detector" if self.oracle < 1.0 else "policy"


def reasons(rows: Sequence[RunScore]) -> list[Reason]:
    """One for each group in which a baseline beats the adaptive weighting by more than `EVEN`."""
    out = []
    for (family, plant), group in groups_of(rows).items():
        lost = [
            c
            for baseline in BASELINES
            for c in contrasts(group, baseline)
            if c.method == ADAPTIVE and c.ratio > 1.0 + EVEN
        ]
        if lost:
            c = max(lost, key=lambda c: c.ratio)
            sure = c.interval is not None and c.interval[0] > 1.0
            oracle = next((o.ratio for o in contrasts(group, c.baseline) if o.method == ORACLE), None)
            ground, kind = _where(group, c.baseline)
            shares = recognised(group), recognised(group, ground) if ground else None
            out.append(Reason(family, plant, c.baseline, c.ratio, sure, oracle, ground, kind, shares))
    return out


def recognised(rows: Sequence[RunScore], ground: str = "") -> float | None:
    """Share of the time in outages in which the adaptive method had the true ground, on one ground or all."""
    total = right = 0.0
    for row in rows:
        for g in row.grounds:
            if row.method == ADAPTIVE and g.recognised is not None and ground in ("", g.ground):
                total, right = total + g.seconds, right + g.seconds * g.recognised
    return right / total if total > 0.0 else None


def _where(rows: Sequence[RunScore], winner: str) -> tuple[str, str]:
    """Ground and kind of error with the largest excess of the adaptive method over the winner."""
    excess: dict[tuple[str, str], float] = defaultdict(float)
    for row in rows:
        sign = {ADAPTIVE: 1.0, winner: -1.0}.get(row.method, 0.0)
        for g in row.grounds:
            for kind, words in KINDS.items():
                error = getattr(g, kind)
                if sign and error is not None:
                    excess[g.ground, words] += sign * g.seconds * error**2
    if not excess:
        return "", ""
    place = max(excess, key=lambda key: excess[key])
    return place if excess[place] > 0.0 else ("", "")
