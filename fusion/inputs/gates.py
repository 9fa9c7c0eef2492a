"""Tests that keep a wrong measurement out without locking good ones out."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FAULT = 3.0
"""An increment of the wheels that is so many limits off is no measurement at all (a counter that jumps)."""


class Verdict(Enum):
    """What a gate says of a fix."""

    ACCEPT = "accept"
    REJECT = "reject"
    REACQUIRE = "reacquire"


@dataclass
class GnssGate:
    """Chi-square test of a fix against its prediction.

    When enough rejected fixes in a row agree with each other the estimate, not
    GNSS, is taken to be wrong: `test` answers REACQUIRE. They agree when they lie on
    a line over time, since an estimate that is wrong moves on, too. Whatever was
    rejected before, `limit` fixes in a row are the most that can be kept out.

    Attributes:
        threshold: chi-square quantile of the innovations tested.
        patience: rejected fixes in a row that must agree with each other.
        agreement_sigma: how well they must agree, in their own sigmas.
        limit: rejected fixes in a row after which the next is let in, whether they agree or not.
    """

    threshold: float
    patience: int = 5
    agreement_sigma: float = 4.0
    limit: int = 30
    rejected: list[tuple[Array, float]] = field(default_factory=list)

    def test(self, innovation_m: Array, covariance_m2: Array) -> tuple[Verdict, float]:
        """What to do with the fix, and the normalised innovation squared.

        `innovation_m` (d,) is fix minus prediction, `covariance_m2` (d, d) of it.
        """
        nis = float(innovation_m @ np.linalg.solve(covariance_m2, innovation_m))
        if nis <= self.threshold:
            self.rejected.clear()
            return Verdict.ACCEPT, nis
        self.rejected.append((innovation_m[:2].copy(), float(np.sqrt(covariance_m2[0, 0]))))
        if len(self.rejected) > self.limit or (len(self.rejected) >= self.patience and self._agree()):
            self.rejected.clear()
            return Verdict.REACQUIRE, nis
        return Verdict.REJECT, nis

    def _agree(self) -> bool:
        recent = self.rejected[-self.patience :]
        points = np.array([point for point, _ in recent])
        order = np.arange(len(points)) - 0.5 * (len(points) - 1)
        points = points - points.mean(axis=0)
        rest = points - np.outer(order, order @ points) / float(order @ order)
        spread = float(np.sqrt((rest**2).sum() / (len(points) - 2)))
        return spread <= self.agreement_sigma * max(sigma for _, sigma in recent)


@dataclass
class WheelGate:
    """Test of a wheel increment against the IMU's prediction.

    A burst of slip or a jammed wheel shows as an increment the IMU does not confirm. It counts less
    (Huber 1964, Ann. Math. Stat. 35(1): what is used must not hang by a hair on what else is known), far
    beyond the limit not at all; but for at most `patience` keyframes in a row: the IMU alone must not judge
    for longer than it can.

    Attributes:
        limit_sigma: normalised innovation up to which an increment is believed.
        patience: keyframes in a row in which an increment may count less.
    """

    limit_sigma: float
    patience: int = 10
    in_a_row: int = 0

    def test(self, innovation_m: float, sigma_m: float) -> tuple[bool, float]:
        """Believe it or not, and the normalised innovation squared."""
        nis = (innovation_m / sigma_m) ** 2
        if nis <= self.limit_sigma**2 or self.in_a_row >= self.patience:
            self.in_a_row = 0
            return True, nis
        self.in_a_row += 1
        return False, nis

    def doubt(self, nis: float) -> float:
        """Factor on the variance of an increment that is not believed, from 1 at the limit to infinity."""
        off = float(np.sqrt(nis))
        return off / self.limit_sigma if off < FAULT * self.limit_sigma else np.inf
