"""Mode "innovation": the fixed noise, with that of wheels and GNSS adapted by their innovations.

Sage-Husa (Sage and Husa 1969, Joint Automatic Control Conf., pp. 760-769; with a forgetting factor): the
part of an innovation nu beyond the prediction's variance P is noise,

    R <- b R + (1 - b) (nu^2 - P),      b = 1 - 1 / memory.

The gain 1 - b is constant: the tuned noise is a better first guess than one innovation.

Variational Bayes (Sarkka and Nummenmaa 2009, IEEE T-AC 54(3)): R is inverse gamma with (alpha, beta),
forgotten by rho = 1 - 1 / memory, and each measurement is divided between state and noise in a few
fixed-point steps: alpha + d/2, beta + (residual^2 + posterior variance) / 2, R = beta / alpha.

Units: wheels (m/s)^2, GNSS the variance over the reported one. The wheels' sigma stays within a factor
`wheel_span` of the tuned one, that of GNSS within `GNSS_SPAN`. Fixes that a gate rejects count too: a
noise that is rejected could otherwise never be learnt.
"""

import dataclasses
import math

import numpy as np

from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimate.estimate import WeightChange
from terrafusion.fusion.graph.wheel_factor import WheelIncrement
from terrafusion.fusion.noise.modes import InnovationTuning
from terrafusion.fusion.weighting.weighting import (
    NOTEWORTHY,
    InnovationTest,
    NoiseInForce,
    Weighting,
    inflated,
    white_variance,
)

FIXED_POINT_STEPS = 4
GNSS_SPAN = (0.5, 50.0)
"""Assumed: no receiver is twice as good as it reports, and one that is fifty times worse is of no use."""
MOVING_MPS = 0.05
"""Wheel speed below which innovations say nothing of the wheels' noise."""


class SageHusa:
    """Noise variance `value` of one sensor, in units of `InnovationTest.unit_m` squared."""

    def __init__(self, value: float, memory: float, low: float, high: float) -> None:
        self.gain, self.low, self.high = 1.0 / memory, low, high
        self.start(value)

    def start(self, value: float) -> None:
        """Restart from a first guess."""
        self.value = value

    def update(self, test: InnovationTest) -> None:
        """Update by one measurement."""
        seen = float(np.mean((test.innovation_m**2 - test.predicted_m2) / test.unit_m**2))
        self.value += self.gain * (seen - self.value)
        self.value = min(max(self.value, self.low), self.high)


class Variational:
    """The same by the inverse gamma distribution of Sarkka and Nummenmaa."""

    def __init__(self, value: float, memory: float, low: float, high: float) -> None:
        self.memory, self.low, self.high = memory, low, high
        self.start(value)

    def start(self, value: float) -> None:
        """Restart from a first guess, as certain as the memory is long."""
        self.value, self._alpha = value, 0.5 * self.memory
        self._beta = self._alpha * value

    def update(self, test: InnovationTest) -> None:
        """Update by one measurement."""
        nu2, P, unit2 = test.innovation_m**2, np.maximum(test.predicted_m2, 0.0), test.unit_m**2
        keep = 1.0 - 1.0 / self.memory
        self._alpha = keep * self._alpha + 0.5 * len(nu2)
        kept = keep * self._beta
        for _ in range(FIXED_POINT_STEPS):
            R = self.value * unit2
            share = R / (P + R)
            self._beta = kept + 0.5 * float(np.sum((nu2 * share**2 + P * share) / unit2))
            self.value = self._beta / self._alpha
        self.value = min(max(self.value, self.low), self.high)
        self._beta = self.value * self._alpha


class InnovationWeighting(Weighting):
    """Adapts `wheel_sigma_mps` and `gnss_inflation` of the noise in force."""

    def __init__(self, config: EstimatorConfig, noise: NoiseInForce) -> None:
        self.method = config.innovation_method
        tuning: InnovationTuning = getattr(config.tuning, config.innovation_method)
        kind = SageHusa if self.method == "sage_husa" else Variational
        self._noise, fixed, span2 = noise, noise.noise, tuning.wheel_span**2
        start = fixed.wheel_sigma_mps**2
        self._wheels = kind(start, tuning.wheel_memory, start / span2, start * span2)
        self._gnss = kind(1.0, tuning.gnss_memory, 0.0, math.inf)
        self._gnss_seen = False
        self._low, self._high = (fixed.gnss_inflation * x for x in GNSS_SPAN)
        self._recorded = {"wheel_sigma_mps": fixed.wheel_sigma_mps, "gnss_inflation": fixed.gnss_inflation}

    def wheels(self, wheels: WheelIncrement, test: InnovationTest) -> WheelIncrement:
        """Learn from an increment of a moving robot, and weight it by the result."""
        dt_s = float(test.unit_m[0])
        if abs(wheels.distance_m) < MOVING_MPS * dt_s:
            return wheels
        own_m2, before = float(test.noise_m2[0]), self._noise.noise.wheel_sigma_mps
        quantum_m2 = own_m2 - (before * dt_s) ** 2
        predicted = test.predicted_m2 + quantum_m2
        self._wheels.update(dataclasses.replace(test, predicted_m2=predicted))
        self._set(test.t_ns, "wheels", "wheel_sigma_mps", math.sqrt(self._wheels.value), "m/s")
        return inflated(wheels, math.sqrt((quantum_m2 + self._wheels.value * dt_s**2) / own_m2))

    def gnss(self, test: InnovationTest) -> tuple[float, float]:
        """Learn from a fix, and weight it by the result."""
        before, unit2 = self._noise.noise.gnss_inflation, float(np.mean(test.unit_m**2))
        white = float(np.mean(test.noise_m2)) / unit2
        drift = test.drift_m2 / unit2
        least = test.white_share
        low, high = (white_variance(x**2, drift, least) for x in (self._low, self._high))
        if not self._gnss_seen:
            self._gnss.start(white)
            self._gnss_seen = True
        self._gnss.low, self._gnss.high = low, high
        self._gnss.update(test)
        inflation = math.sqrt(min(self._gnss.value + drift, self._gnss.value / least))
        self._set(test.t_ns, "gnss", "gnss_inflation", min(max(inflation, self._low), self._high), "")
        now = self._noise.noise.gnss_inflation
        return math.sqrt(white_variance(now**2, drift, least) / white_variance(before**2, drift, least)), 1.0

    def _set(self, t_ns: int, sensor: str, name: str, value: float, unit: str) -> None:
        self._noise.noise = dataclasses.replace(self._noise.noise, **{name: value})
        before = self._recorded[name]
        if abs(value - before) > NOTEWORTHY * before:
            why = f"{name}: innovations ({self.method})"
            self._noise.record(WeightChange(t_ns, sensor, before, value, unit, why))
            self._recorded[name] = value
