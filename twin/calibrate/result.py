"""The result of a calibration: parameters with sigma, identifiability, and the fit of each channel."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.calibrate.identifiability import IDENTIFIED, Identifiability
from terrafusion.twin.calibrate.model import Model

SCHEMA = "terrafusion.calibration/1"
CONVERGED = ("converged", "at_bound")
"""Outcomes of a search that converged."""
MISFIT = 5.0
"""Noise of a channel over that of its data sheet, from which the twin does not fit (assumed)."""


@dataclass(frozen=True)
class FittedParameter:
    """One parameter.

    Attributes:
        name, unit: dotted name and unit.
        value, sigma: the fit and its 1 sigma, in the unit; the prior value where it is not identified.
        low, high: two sigma about it, by the logarithm where the number moves so.
        start: where the search began; prior, prior_sigma: what was known before.
        status: one of the three of `identifiability`.
        ratio: posterior over prior sigma.
        at_bound: whether it ended at the end of its range.
    """

    name: str
    unit: str
    value: float
    sigma: float
    low: float
    high: float
    start: float
    prior: float
    prior_sigma: float
    status: str
    ratio: float
    at_bound: bool


@dataclass(frozen=True, eq=False)
class ChannelFit:
    """One channel of one log, before and after.

    Attributes:
        log, channel: names.
        t_s: (n,) times from the log's first input; measured, before, after: (n,) values there, those of the
            twin with its offsets added and each window's pose fitted. "Before" is with the start values.
        sigma: noise of one row, estimated.
        correlation: autocorrelation of neighbouring rows.
        left: the same of whitened rows, about zero if the noise model holds.
        outliers: share of whitened rows beyond 4.
        noise_ratio: the noise over that of the data sheet.
    """

    log: str
    channel: str
    t_s: Array
    measured: Array
    before: Array
    after: Array
    sigma: float
    correlation: float
    left: float
    outliers: float
    noise_ratio: float

    def misfit(self) -> str | None:
        """A sentence where the twin does not fit the channel."""
        if self.noise_ratio <= MISFIT:
            return None
        return (
            f"{self.log}: {self.channel} is off by {self.noise_ratio:.0f} times its noise: is it the right "
            "vehicle, ground, slope, load and frame?"
        )

    def rms(self, series: Array) -> float:
        """Root mean square of a series (n,) less what was measured."""
        return float(np.sqrt(np.mean((series - self.measured) ** 2)))


SHOWN = 10
"""Parameters in the representation of a result."""


@dataclass(frozen=True, eq=False, repr=False)
class Calibration:
    """The result.

    Attributes:
        fitted: the parameters, in the order asked for.
        correlation: (P, P) of their errors; covariance: (P, P) in their units.
        identifiability: what the data identify.
        model: vehicle, soils and effects with the numbers in place.
        before: the model at the start.
        channels: how each channel fits.
        sensor_errors: by log name, channel and kind: the estimated offset or gain, and its sigma.
        outcome, sentence: how the search ended, as a key and in words.
        runs, seconds_of_data: evaluations of the twin, and what they ran over.
        notes: what was assumed.
    """

    fitted: tuple[FittedParameter, ...]
    correlation: Array
    covariance: Array
    identifiability: Identifiability
    model: Model
    before: Model
    channels: tuple[ChannelFit, ...]
    sensor_errors: dict[str, dict[str, tuple[float, float]]]
    outcome: str
    sentence: str
    runs: int
    seconds_of_data: float
    notes: tuple[str, ...]

    def __getitem__(self, name: str) -> FittedParameter:
        """A parameter by its name; `soil.` stands for the ground where there is one only."""
        alone = len(self.model.soils) == 1
        return next(
            f for f in self.fitted
            if f.name == name or (alone and f"soil.{f.name.partition('.')[2]}" == name)
        )  # fmt: skip

    def __repr__(self) -> str:
        lines = [f"Calibration of {self.model.vehicle.name}: {self.sentence}"]
        lines += [
            f"  {f.name} {f.value:.5g} +- {f.sigma:.2g} {f.unit} (was {f.start:.5g}; {f.status})"
            for f in self.fitted[:SHOWN]
        ]
        left = len(self.fitted) - SHOWN
        return "\n".join([*lines, f"  and {left} more"] if left > 0 else lines)

    def converged(self) -> bool:
        """Whether the search converged; if not, values and sigma are not valid."""
        return self.outcome in CONVERGED

    def unidentified(self) -> tuple[FittedParameter, ...]:
        """Parameters that the data do not identify one by one."""
        return tuple(f for f in self.fitted if f.status != IDENTIFIED)

    def as_dict(self) -> dict[str, Any]:
        """The content of `calibration.json`."""
        return {
            "schema": SCHEMA,
            "vehicle": self.model.vehicle.name,
            "soils": list(self.model.soils),
            "logs": list(self.sensor_errors),
            "seconds": round(self.seconds_of_data, 3),
            "outcome": self.outcome,
            "sentence": self.sentence,
            "converged": self.converged(),
            "runs": self.runs,
            "parameters": {f.name: _entry(f, self.converged()) for f in self.fitted},
            "order": [f.name for f in self.fitted],
            "correlation": self.correlation.tolist(),
            "covariance": self.covariance.tolist(),
            "identifiability": {
                "eigenvalues": self.identifiability.eigenvalues.tolist(),
                "eigenvectors": self.identifiability.eigenvectors.T.tolist(),
                "weak": [
                    {"weights": d.weights, "ratio": d.ratio, "sentence": d.sentence}
                    for d in self.identifiability.weak
                ],
            },
            "sensor_errors": {
                log: {name: {"value": value, "sigma": sigma} for name, (value, sigma) in found.items()}
                for log, found in self.sensor_errors.items()
            },
            "channels": [
                {
                    "log": c.log, "channel": c.channel, "rows": len(c.measured),
                    "rms_before": c.rms(c.before), "rms_after": c.rms(c.after), "sigma": c.sigma,
                    "correlation": c.correlation, "whitened_correlation": c.left, "outliers": c.outliers,
                }
                for c in self.channels
            ],
            "notes": list(self.notes),
        }  # fmt: skip


def _entry(f: FittedParameter, converged: bool) -> dict[str, Any]:
    return {
        "value": f.value, "sigma": f.sigma, "unit": f.unit, "interval_2_sigma": [f.low, f.high],
        "start": f.start, "prior": f.prior, "prior_sigma": f.prior_sigma, "status": f.status,
        "posterior_over_prior": f.ratio, "at_bound": f.at_bound, "sigma_valid": converged,
    }  # fmt: skip
