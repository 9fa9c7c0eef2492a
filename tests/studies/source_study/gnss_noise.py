"""Which Gaussian position noise the study's GNSS errors imply.

The study adds zero-mean Gaussian noise to the GNSS and does not say how much.
Here white noise of one size is added to the true positions of the twin's three
runs, sampled at a rate, processed as in the study, and the size is sought at
which the mean speed error is the study's: for each run alone, and one for all.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.analysis.speeds import differenced_speed, match, mean_percent
from tests.studies.source_study.cases import CaseRun
from tests.studies.source_study.profiles import OTHERS, USUAL, Assumed, Profiles

RATES_HZ = (1.0, 5.0, 10.0, 100.0)  # rates at which positions may have been differenced; the study names none
SIGMAS_M = (1e-4, 10.0)  # sizes of noise that are searched
DATA_SHEET_M = 0.02  # tab. 2 of the study: RTK below this


@dataclass(frozen=True)
class NoiseFit:
    """White position noise at one rate that gives the study's errors.

    Attributes:
        rate_hz: of the positions.
        alone_m: sigma of each horizontal axis that fits a terrain's error alone, m.
        common_m: the one sigma with the least squared logarithm of error / study's error over all terrains.
        common_error: mean percent of each terrain with `common_m`.
        data_sheet_error: the same with 0.02 m.
    """

    rate_hz: float
    alone_m: Mapping[str, float]
    common_m: float
    common_error: Mapping[str, float]
    data_sheet_error: Mapping[str, float]

    def worst_factor(self, wanted: Mapping[str, float]) -> float:
        """By what factor the worst terrain's error misses the wanted one with the common noise."""
        return max(
            math.exp(abs(math.log(self.common_error[terrain] / wanted[terrain]))) for terrain in wanted
        )


@dataclass(frozen=True, eq=False)
class NoisyRun:
    """A run's true positions (n, 2) at one rate, with unit noise (n, 2) that waits for its size."""

    profiles: Profiles
    t_s: Array
    enu_m: Array
    unit: Array

    @classmethod
    def of(cls, run: CaseRun, rate_hz: float) -> Self:
        """The run's positions at `rate_hz` (the antenna moves as the body does), with noise by its seed."""
        t_s = np.arange(int(run.truth_t_s[-1] * rate_hz) + 1) / rate_hz
        enu = np.stack([np.interp(t_s, run.truth_t_s, axis) for axis in run.truth_enu_m.T], axis=1)
        unit = np.random.default_rng([run.seed, round(rate_hz)]).normal(size=enu.shape)
        return cls(run.profiles, t_s, enu, unit)

    def noisy(self, sigma_m: float, assumed: Assumed = USUAL) -> Profiles:
        """The run with GNSS speed from positions with noise of `sigma_m` on each axis."""
        t_s, speed = differenced_speed(self.t_s, self.enu_m + sigma_m * self.unit, assumed.cutoff_hz)
        matched = match(t_s, speed, self.profiles.t_s)
        return dataclasses.replace(self.profiles, gnss=matched, assumed=assumed)

    def error(self, sigma_m: float, assumed: Assumed = USUAL) -> float:
        """Mean GNSS speed error, percent."""
        noisy = self.noisy(sigma_m, assumed)
        return mean_percent(noisy.error(noisy.gnss))


def mean_error(runs: Sequence[NoisyRun], sigma_m: float, assumed: Assumed = USUAL) -> float:
    """Mean of the runs' errors, percent."""
    return float(np.mean([run.error(sigma_m, assumed) for run in runs]))


def least_ratio(upper: Sequence[NoisyRun], lower: Sequence[NoisyRun], sigma_m: float) -> float:
    """Least quotient of two grounds' errors with the same noise, whatever is assumed of the processing."""
    return min(
        mean_error(upper, sigma_m, assumed) / mean_error(lower, sigma_m, assumed)
        for assumed in (USUAL, *OTHERS)
    )


def fit_noise(
    runs: Mapping[str, Sequence[NoisyRun]], wanted: Mapping[str, float], rate_hz: float
) -> NoiseFit:
    """The sizes of noise that give the `wanted` errors (percent, by terrain)."""
    from scipy.optimize import minimize_scalar

    low, high = (math.log(sigma) for sigma in SIGMAS_M)

    def misfit(log_sigma: float) -> float:
        sigma = math.exp(log_sigma)
        return sum(math.log(mean_error(runs[name], sigma) / wanted[name]) ** 2 for name in wanted)

    common = math.exp(
        minimize_scalar(misfit, bounds=(low, high), method="bounded", options={"xatol": 1e-3}).x
    )
    return NoiseFit(
        rate_hz=rate_hz,
        alone_m={name: _sigma_for(runs[name], error) for name, error in wanted.items()},
        common_m=common,
        common_error={name: mean_error(runs[name], common) for name in wanted},
        data_sheet_error={name: mean_error(runs[name], DATA_SHEET_M) for name in wanted},
    )


def rate_for(fits: Sequence[NoiseFit], terrain: str, sigma_m: float = DATA_SHEET_M) -> float:
    """Rate at which noise of this size gives a terrain's error, Hz, between the fitted ones; NaN outside."""
    log_sigma = [-math.log(fit.alone_m[terrain]) for fit in fits]
    log_rate = [math.log(fit.rate_hz) for fit in fits]
    found = np.interp(-math.log(sigma_m), log_sigma, log_rate, left=math.nan, right=math.nan)
    return float(np.exp(found))


def _sigma_for(runs: Sequence[NoisyRun], error: float) -> float:
    """The size of noise with this mean error (it grows with the noise); NaN outside the searched sizes."""
    from scipy.optimize import brentq

    low, high = (math.log(sigma) for sigma in SIGMAS_M)

    def excess(log_sigma: float) -> float:
        return math.log(mean_error(runs, math.exp(log_sigma)) / error)

    if excess(low) > 0.0 or excess(high) < 0.0:
        return math.nan
    return math.exp(brentq(excess, low, high, xtol=1e-3))
