"""Overlapping Allan deviation of an IMU and its noise parameters (IEEE Std 952-1997, annex C)."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.json_text import finite
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.sensors.imu import at_rest

REWEIGHTINGS = 5
SHORT_S, LONG_S = 1.0, 3.0
"""Clusters up to the first show white noise alone, those from the second on the others."""
ABSENT = "not in the log, constant, or with gaps"
GAP = 5.0
"""A step between samples that is so many times the usual one is a gap."""
TURNING, DRIVEN_SHARE = 0.05, 0.01
"""Wheels faster than the first (rad/s, or m/s), for more than this share of the time: the robot drives."""
LEAST_S = 10.0 * LONG_S
"""Shorter series have too few long clusters for the bias parameters."""


@dataclass(frozen=True, eq=False)
class Allan:
    """Allan deviation of one series.

    Attributes:
        tau_s: (K,) cluster times, s.
        deviation: (K,) in the unit of the series.
    """

    tau_s: Array
    deviation: Array


@dataclass(frozen=True)
class InertialNoise:
    """Coefficients of an inertial sensor's noise and their standard errors.

    `density` is the white noise (unit/sqrt(Hz)), `walk` the random walk of the bias (unit sqrt(Hz)),
    `floor` the flat part of the Allan deviation that bias instability makes (unit).
    """

    density: float
    walk: float
    floor: float
    density_error: float
    walk_error: float
    floor_error: float


def allan_deviation(values: Array, rate_hz: float, per_octave: int = 2) -> Allan:
    """Overlapping Allan deviation of rates (N,) sampled at `rate_hz`, to clusters of a fifth of the series.

    sigma^2(tau) = <(theta(t + 2 tau) - 2 theta(t + tau) + theta(t))^2> / (2 tau^2), theta the integral of the
    rates (IEEE Std 952-1997, annex C).

    Raises:
        ValueError: fewer than 10 values.
    """
    n = len(values)
    if n < 10:
        raise ValueError(f"{n} values are too few for an Allan deviation")
    octaves = math.log2(n / 5.0)
    sizes = np.unique(np.round(2.0 ** np.linspace(0.0, octaves, round(per_octave * octaves) + 1)).astype(int))
    theta = np.concatenate([[0.0], np.cumsum(values - values.mean())]) / rate_hz
    deviation = np.empty(len(sizes))
    for k, m in enumerate(sizes.tolist()):
        second = theta[2 * m :] - 2.0 * theta[m:-m] + theta[: -2 * m]
        deviation[k] = math.sqrt(float(np.mean(second**2)) / 2.0) * rate_hz / m
    return Allan(sizes / rate_hz, deviation)


def inertial_noise(curves: list[Allan]) -> InertialNoise:
    """White noise, bias walk and floor that explain the Allan variances of like sensors.

    sigma^2 = density^2 / tau + floor^2 + walk^2 tau / 3: the density from clusters up to 1 s, the others by
    non-negative least squares from clusters above 3 s, with the weights of the degrees of freedom. The
    standard errors are the scatter of the fits over the curves.
    """
    fits = np.array([_fit(curve) for curve in curves])
    spread = fits.std(axis=0, ddof=1) / math.sqrt(len(curves)) if len(curves) > 1 else np.full(3, math.nan)
    return InertialNoise(*fits.mean(axis=0).tolist(), *spread.tolist())


def _fit(curve: Allan) -> Array:
    """density, walk, floor of one curve."""
    from scipy.optimize import nnls

    tau, square = curve.tau_s, curve.deviation**2
    short, long = tau <= SHORT_S, tau >= LONG_S
    white = float(np.average((square * tau)[short], weights=1.0 / tau[short]))
    model = np.stack([tau / 3.0, np.ones_like(tau)], axis=1)[long]
    rest, expected = np.maximum(square - white / tau, 0.0)[long], square[long]
    for _ in range(REWEIGHTINGS):
        # The relative error of an Allan variance of clusters of m in N values grows with sqrt(m / N); of the
        # fitted variance, because a weight of the measured one would favour what came out small.
        weight = 1.0 / (expected * np.sqrt(tau[long]))
        squares, _ = nnls(model * weight[:, None], rest * weight)
        expected = model @ squares + white / tau[long]
    return np.sqrt([white, *squares])


def expected_deviation(tau_s: Array, density: float, walk: float, floor: float) -> Array:
    """Allan deviation (K,) of white noise, bias walk and a flat floor together."""
    return np.sqrt(density**2 / tau_s + walk**2 * tau_s / 3.0 + floor**2)


@dataclass(frozen=True, eq=False)
class ImuAtRest:
    """Curves of gyro and accelerometer by name (none: `ABSENT`), and what was specified."""

    title: str
    curves: Mapping[str, list[Allan]]
    specified: Mapping[str, Sequence[float]] = field(default_factory=dict)

    def lines(self) -> list[str]:
        """Title and tables as text."""
        lines = [self.title]
        for name, own in self.curves.items():
            lines += _table(name, own, self.specified.get(name)) if own else [f"{name}: {ABSENT}"]
        return lines

    def to_json(self) -> dict[str, Any]:
        """The same as numbers; the parameters in units of the channel, their errors one sigma."""
        found: dict[str, Any] = {"title": self.title}
        for name, own in self.curves.items():
            found[name] = None
            if own:
                curve = {"tau_s": own[0].tau_s.tolist(), "deviation": _mean(own).tolist()}
                noise = finite(asdict(inertial_noise(own)))
                found[name] = curve | noise | {"specified": self.specified.get(name)}
        return found


def vehicle_at_rest(vehicle: str, hours: float = 2.0, seeds: int = 4) -> ImuAtRest:
    """A vehicle's simulated IMU at rest, beside the parameters of its file.

    Raises:
        ConfigError: unknown vehicle.
    """
    params = load_vehicle(vehicle)
    spec, real = params.sensors.imu, params.realism.imu
    specified = {
        "gyro": (
            spec.gyro_noise_radps_sqrthz, spec.gyro_bias_walk_radps2_sqrthz, real.gyro_bias_instability_radps
        ),
        "accel": (
            spec.accel_noise_mps2_sqrthz, spec.accel_bias_walk_mps3_sqrthz, real.accel_bias_instability_mps2
        ),
    }  # fmt: skip
    count = round(3600.0 * hours * spec.rate_hz)
    curves: dict[str, list[Allan]] = {"gyro": [], "accel": []}
    for seed in range(seeds):
        for name, values in zip(curves, at_rest(params, count, seed), strict=True):
            curves[name] += [allan_deviation(column, spec.rate_hz, 1) for column in values.T]
    title = f"{vehicle}: IMU at rest, {hours:g} h, {seeds} seeds x 3 axes, mean of the curves"
    return ImuAtRest(title, curves, specified)


def recording_at_rest(recording: Recording) -> ImuAtRest:
    """A recorded IMU, which should be at rest, in its longest stretch without a gap.

    Raises:
        DataError: no IMU, too slow a one, or too short a log.
    """
    imu = recording.imu
    if imu is not None and len(imu) > 2:
        steps = np.diff(imu.t_ns)
        edges = np.r_[0, np.flatnonzero(steps > GAP * np.median(steps)) + 1, len(imu)]
        longest = int(np.argmax(np.diff(edges)))
        imu = imu.select(np.arange(edges[longest], edges[longest + 1]))
    seconds = 0.0 if imu is None or len(imu) < 2 else float(imu.t_ns[-1] - imu.t_ns[0]) * 1e-9
    if imu is None or seconds < LEAST_S:
        raise DataError(
            f"{seconds:.1f} s of IMU data are too short for an Allan deviation", file=recording.name,
            channel="imu", remedy=f"give a log of {LEAST_S:g} s or more with the robot at rest",
        )  # fmt: skip
    rate_hz = (len(imu) - 1) / seconds
    if rate_hz * SHORT_S < 1.0:
        raise DataError(
            f"{rate_hz:.2g} IMU samples a second are too few for an Allan deviation", file=recording.name,
            channel="imu", remedy="log the IMU at its full rate",
        )  # fmt: skip
    curves = {}
    for name, values in (("gyro", imu.gyro_radps), ("accel", imu.accel_mps2)):
        axes = [column for column in values.T if np.isfinite(column).all() and np.ptp(column) > 0.0]
        curves[name] = [allan_deviation(column, rate_hz, 1) for column in axes]
    title = f"{recording.name}: IMU, {seconds:.0f} s at {rate_hz:.1f} Hz, mean of the axes"
    if (wheels := recording.wheels) is not None:
        during = (wheels.t_ns >= imu.t_ns[0]) & (wheels.t_ns <= imu.t_ns[-1])
        turning = np.abs(wheels.speed[during]).max(axis=1, initial=0.0) > TURNING
        share = float(turning.sum()) / max(len(turning), 1)
        if share > DRIVEN_SHARE:
            title += f"; the wheels turn in {100.0 * share:.0f} % of it: this is no noise at rest"
    return ImuAtRest(title, curves)


def _mean(curves: list[Allan]) -> Array:
    """The curves as one: root of the mean square."""
    return np.asarray(np.sqrt(np.mean([curve.deviation**2 for curve in curves], axis=0)))


def _table(name: str, curves: list[Allan], specified: Sequence[float] | None) -> list[str]:
    """Deviation by cluster time and the parameters read from it, beside those specified where given."""
    tau_s = curves[0].tau_s
    lines = [f"{name}: tau s, Allan deviation" + (", expected" if specified else "")]
    theory = expected_deviation(tau_s, *specified) if specified else None
    for k, (tau, value) in enumerate(zip(tau_s, _mean(curves), strict=True)):
        lines.append(f"  {tau:9.2f}  {value:.3e}" + ("" if theory is None else f"  {theory[k]:.3e}"))
    fit = inertial_noise(curves)
    estimates = zip(
        ("density", "walk", "floor"),
        (fit.density, fit.walk, fit.floor),
        (fit.density_error, fit.walk_error, fit.floor_error),
        strict=True,
    )
    for k, (word, value, error) in enumerate(estimates):
        given = f"specified {specified[k]:.3e}, " if specified else ""
        lines.append(f"  {word}: {given}estimated {value:.3e} +- {error:.1e}")
    return lines
