"""The noise of GNSS fixes as they show it: which part is white, which drifts, and how large both are."""

import dataclasses
import math

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.sensors import GnssSpec
from terrafusion.fusion.estimator.drift_watch import DriftWatch
from terrafusion.fusion.estimator.skid import SkidDetector
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.inputs.validation import GnssFix
from terrafusion.fusion.noise.policy import SensorNoise
from terrafusion.fusion.weighting.weighting import white_variance

LEAST_SIGMA_M = 0.005
KINEMATIC_M, RTK_SHEET_M = 0.01, 0.05
"""Least horizontal sigma of a fix, whatever the receiver reports: RTK in motion has 8 mm + 1 ppm (data
sheets). Up to the second, a data sheet is that of RTK, and itself the least."""
WHITE_SHARE = 0.2
"""Share of a fix's variance that is white; the rest drifts slowly. More where fixes scatter more about the
dead-reckoned path."""
SLOW_SIGMA = math.sqrt(1.0 - WHITE_SHARE)
ALL_NEW = 0.75
"""Estimated share from which all scatter is white: the estimate is off by a tenth or two (assumed). An RTK
receiver with fixed ambiguities then has no drift; scatter of any other does not show that it has none."""
OPTIMISTIC_SCATTER = 2.0
"""If the scatter of fixes exceeds this many times the reported sigma, sigma is inflated."""
OPTIMISM = 3.0
"""A stand-alone receiver may report a sigma so many times below its data sheet and still drift; one that
reports even less has fixes of a better class (RTK), which drift in proportion to their sigma."""


class FixNoise:
    """White errors and drift of a receiver's fixes.

    Attributes:
        scale: scatter of the fixes over their reported sigma, 1 where it is below `OPTIMISTIC_SCATTER`.
        white: share of a fix's variance taken for white.
        sheet_sigma_m: 1 sigma by the data sheet, each axis.
        drift: the Gauss-Markov process of the slow errors.
    """

    def __init__(self, spec: GnssSpec) -> None:
        self.scale, self.white = 1.0, WHITE_SHARE
        self.sheet_sigma_m = spec.sigma_horizontal_m
        self.drift = DriftWatch(SLOW_SIGMA * spec.sigma_horizontal_m, max(spec.correlation_time_s, 0.1))
        # Heights are wrong for minutes at a time and of little use on the ground: no state is spent on them,
        # they are held to the whole Gauss-Markov spectrum at low frequency (2 sigma^2 tau) instead.
        self._height_factor = float(np.sqrt(1.0 + 2.0 * spec.correlation_time_s * spec.rate_hz))
        self._least_drift_m = self.drift.sigma_m
        self._class: Fix | None = None
        self._class_scale: dict[Fix | None, float] = {}
        self._newest_ns = 0

    def believable(self, fix: GnssFix) -> GnssFix:
        """A fix with at least the sigma that a receiver of its kind can have."""
        least_m = self.sheet_sigma_m if self.sheet_sigma_m <= RTK_SHEET_M else KINEMATIC_M
        if min(fix.sigma_m[:2].tolist()) >= 0.999 * least_m:
            return fix
        sigma = np.append(np.maximum(fix.sigma_m[:2], least_m), fix.sigma_m[2])
        return dataclasses.replace(fix, sigma_m=sigma)

    def learn(self, scatter: float, white: float) -> None:
        """Take in `DeadReckoning.scatter` and `white_share`."""
        self.scale = scatter if scatter > OPTIMISTIC_SCATTER else 1.0
        self.white = WHITE_SHARE if math.isnan(white) else max(white, WHITE_SHARE)
        if self.white > ALL_NEW:
            self.white = 1.0

    def changes_class(self, fix: GnssFix) -> bool:
        """Whether the newest fix is of another class than the one before.

        A receiver whose first fix of a class reports more than the data sheet drifts in proportion.
        """
        if fix.t_ns < self._newest_ns or (fix.fix == self._class and self._class_scale):
            return False
        self._newest_ns, first, self._class = fix.t_ns, not self._class_scale, fix.fix
        self._class_scale[fix.fix] = max(1.0, fix.horizontal_sigma_m / self.sheet_sigma_m)
        return not first

    def of(self, fix: GnssFix, inflation: float) -> tuple[Array, float]:
        """1 sigma (3,), m, of the white part of a fix, east, north, up, and the factor on the drift state in
        it: 0 to 1, above 1 for classes worse than the data sheet's. `inflation` is of the reported sigma.
        """
        reported_m = fix.horizontal_sigma_m * inflation
        by_report = math.sqrt((1.0 - self.white) / (1.0 - WHITE_SHARE))
        scale = min(self._class_scale.get(fix.fix, 1.0), OPTIMISM * reported_m / self.sheet_sigma_m)
        self._least_drift_m = SLOW_SIGMA * reported_m * by_report / scale
        fixed = fix.fix == Fix.FIXED or fix.horizontal_sigma_m <= RTK_SHEET_M
        share = (by_report if fixed else 1.0) * scale
        *level, up = (fix.sigma_m * inflation).tolist()
        drift_m2 = (share * self.drift.sigma_m) ** 2
        white = [math.sqrt(white_variance(sigma**2, drift_m2, self.white)) for sigma in level]
        return np.maximum([*white, up * self._height_factor], LEAST_SIGMA_M), share

    def test_wheels(self, chain: Chain, skid: SkidDetector, noise: SensorNoise) -> None:
        """See `DriftWatch.test_wheels`."""
        self.drift.test_wheels(chain, skid, self.sheet_sigma_m, noise, self._least_drift_m)
