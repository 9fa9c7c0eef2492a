"""Measurements of a log as rows that a twin run can be compared with: means over intervals, and positions.

Rates and accelerations are averaged over bins of `BIN_S`: a row holds the measured mean and the interval
it is the mean of, so that the twin's mean over the same interval is its exact counterpart. Positions and
velocities of GNSS and of a reference are rows at an instant.
"""

import dataclasses
import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.frames import quaternion_to_matrix
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.model.vehicle import VehicleParams
from terrafusion.twin.physics.layout import OUTPUTS

Rows = NDArray[np.int64]

BIN_S = 0.1
"""Rates and accelerations are compared as means over this long."""
TRUTH_SIGMA = (0.01, 0.005)
"""First guess of a reference's sigma (assumed): m, rad."""
LEAST_SHARE = 1e-4
"""Learnt noise is at least this share of the first guess (exact data would give zero)."""
CURRENT_SIGMA_A = 0.05
"""Least first guess of a current sensor's sigma (assumed)."""
CHANNELS = (
    *(name for name in OUTPUTS if "speed" not in name),
    *("wheel_mean_radps", "truth_east_m", "truth_north_m", "truth_yaw_rad"),
)
"""What can be compared: `layout.OUTPUTS` that sensors measure, the mean of all wheels, and a reference."""


@dataclass(frozen=True, eq=False)
class Observed:
    """Rows of one channel.

    Attributes:
        channel: one of `CHANNELS`.
        begin_s, end_s: (n,) interval a row is the mean over; equal where it holds at an instant.
        value: (n,) measured.
        sigma: (n,) first guess of the noise's 1 sigma.
        slot: (n,) number of the row on a regular clock of `slot_s` seconds.
        least: lower bound of the learnt noise, as a share of `sigma`.
        correlation: share of the variance that is correlated in time, and its time constant in s,
            where a data sheet gives it; None: it is estimated.
        timing: (n,) 1 sigma by the unknown time of changes of the input, beside the noise; None: none.
    """

    channel: str
    begin_s: Array
    end_s: Array
    value: Array
    sigma: Array
    slot: Rows
    slot_s: float
    least: float
    correlation: tuple[float, float] | None = None
    timing: Array | None = None

    def select(self, rows: NDArray[np.bool_]) -> Self:
        """The rows of a mask."""
        return dataclasses.replace(
            self, begin_s=self.begin_s[rows], end_s=self.end_s[rows], value=self.value[rows],
            sigma=self.sigma[rows], slot=self.slot[rows],
        )  # fmt: skip


def checked_channels(names: tuple[str, ...]) -> tuple[str, ...]:
    """Names of channels, or beginnings of them.

    Raises:
        ConfigError: one that no channel begins with.
    """
    if unknown := [name for name in names if not any(one.startswith(name) for one in CHANNELS)]:
        raise ConfigError(f"unknown channel '{unknown[0]}'", remedy=f"known are {', '.join(CHANNELS)}")
    return names


def observe(
    recording: Recording, vehicle: VehicleParams, start_ns: int, *, wheels: bool, truth: bool
) -> tuple[Observed, ...]:
    """Every channel of the log that the twin can be compared with; times in seconds from `start_ns`.

    `wheels` says whether the wheels are measurements (and not the twin's input), `truth` whether the log's
    reference pose is one.
    """
    found: list[Observed] = []
    if wheels:
        found += _wheels(recording, vehicle, start_ns)
    found += _imu(recording, vehicle, start_ns)
    found += _gnss(recording, vehicle, start_ns)
    found += _motor(recording, vehicle, start_ns)
    if truth:
        found += _truth(recording, start_ns)
    return tuple(o for o in found if len(o.value) >= 2)


def sample_interval_s(t_s: Array) -> float:
    """Usual time between samples, s."""
    return float(np.median(np.diff(t_s))) if len(t_s) > 1 else BIN_S


def binned(
    channel: str, t_s: Array, values: Array, sheet_sigma: float, *, instant: bool = False, trust: bool = True
) -> Observed:
    """Means of `values` (N,) at times (N,) over bins.

    A sample is taken as the mean since the one before or, with `instant`, as holding about its stamp.
    The first guess of sigma is the data sheet's or the scatter from bin to bin, whichever is larger. Without
    `trust` the data sheet's is also the least.
    """
    known = np.isfinite(values)
    t_s, values = t_s[known], values[known]
    interval = sample_interval_s(t_s)
    width = BIN_S * math.ceil(interval / BIN_S - 1e-3)
    span = min(interval, BIN_S)
    slots, first, count = np.unique(
        np.ceil(t_s / width - 1e-6).astype(np.int64) - 1, return_index=True, return_counts=True
    )
    if not len(slots):
        empty = np.zeros(0)
        return Observed(channel, empty, empty, empty, empty, np.zeros(0, dtype=np.int64), width, 1.0)
    mean = np.add.reduceat(values, first) / count
    last = t_s[first + count - 1]
    ahead = 0.5 * span if instant else 0.0
    begin, end = t_s[first] - span + ahead, last + ahead
    guess = max(sheet_sigma, scatter(mean), 1e-9)
    least = LEAST_SHARE if trust else sheet_sigma / guess
    rows = Observed(channel, begin, end, mean, np.full(len(slots), guess), slots, width, least)
    return rows.select(count * span >= 0.5 * (end - begin))


def scatter(values: Array) -> float:
    """Robust 1 sigma of white noise in a series, from the differences of neighbours; 0 for short ones."""
    if len(values) < 3:
        return 0.0
    steps = np.diff(values)
    return float(1.4826 * np.median(np.abs(steps - np.median(steps))) / math.sqrt(2.0))


def _seconds(t_ns: NDArray[np.int64], start_ns: int) -> Array:
    return np.asarray((t_ns - start_ns) * 1e-9)


def _wheels(recording: Recording, vehicle: VehicleParams, start_ns: int) -> list[Observed]:
    wheels = recording.wheels
    if wheels is None or not len(wheels):
        return []
    radius = vehicle.odometry.wheel_radius_m
    t_s = _seconds(wheels.t_ns, start_ns)
    sides = wheels.side_speeds_mps(radius) / radius
    # Wheels are less round than counts are fine: sigma is never below that of the vehicle's file.
    per_bin = max(1.0, BIN_S / sample_interval_s(t_s))
    sheet = max(vehicle.sensors.wheels.speed_sigma_mps / radius / math.sqrt(per_bin), 1e-6)
    if not wheels.has_sides():
        return [binned("wheel_mean_radps", t_s[1:], sides[1:, 0], sheet, trust=False)]
    names = ("wheel_left_radps", "wheel_right_radps")
    return [binned(name, t_s[1:], sides[1:, i], sheet, trust=False) for i, name in enumerate(names)]


def _imu(recording: Recording, vehicle: VehicleParams, start_ns: int) -> list[Observed]:
    imu, spec = recording.imu, vehicle.sensors.imu
    if imu is None or not len(imu):
        return []
    t_s = _seconds(imu.t_ns, start_ns)
    names = ("yaw_rate_radps", "accel_x_mps2", "accel_y_mps2")
    series = (imu.gyro_radps[:, 2], imu.accel_mps2[:, 0], imu.accel_mps2[:, 1])
    densities = (spec.gyro_noise_radps_sqrthz, spec.accel_noise_mps2_sqrthz, spec.accel_noise_mps2_sqrthz)
    return [
        binned(name, t_s, values, density / math.sqrt(BIN_S))
        for name, values, density in zip(names, series, densities, strict=True)
    ]


def _motor(recording: Recording, vehicle: VehicleParams, start_ns: int) -> list[Observed]:
    motor = recording.motor
    if motor is None or not len(motor):
        return []
    t_s = _seconds(motor.t_ns, start_ns)
    per_bin = max(1.0, BIN_S / sample_interval_s(t_s))
    sheet = max(vehicle.realism.current_noise_a / math.sqrt(per_bin), CURRENT_SIGMA_A)
    names = ("current_left_a", "current_right_a")
    return [binned(name, t_s, motor.current_a[:, i], sheet, instant=True) for i, name in enumerate(names)]


def _gnss(recording: Recording, vehicle: VehicleParams, start_ns: int) -> list[Observed]:
    gnss, spec = recording.gnss, vehicle.sensors.gnss
    if gnss is None or not len(gnss):
        return []
    t_s = _seconds(gnss.t_ns, start_ns) - vehicle.realism.gnss_latency_s  # as the receiver's stamps are late
    seen = np.isfinite(gnss.enu_m[:, :2]).all(axis=1) & (gnss.fix > 0)
    position_sigma = np.where(
        np.isfinite(gnss.sigma_enu_m[:, :2]), gnss.sigma_enu_m[:, :2], spec.sigma_horizontal_m
    )
    correlated = (1.0 - vehicle.realism.gnss_white_share, spec.correlation_time_s)
    share = correlated if spec.correlation_time_s > 0.0 else (0.0, 1.0)
    found = [
        _instants(name, t_s[seen], gnss.enu_m[seen, i], np.maximum(position_sigma[seen, i], 1e-4), share)
        for i, name in enumerate(("gnss_east_m", "gnss_north_m"))
    ]
    if gnss.velocity_enu_mps is not None:
        moving = np.isfinite(gnss.velocity_enu_mps[:, :2]).all(axis=1) & (gnss.fix > 0)
        sigma = gnss.sigma_v_mps if gnss.sigma_v_mps is not None else np.full(len(t_s), np.nan)
        sigma = np.maximum(np.where(np.isfinite(sigma), sigma, spec.sigma_velocity_mps), 1e-4)
        found += [
            _instants(name, t_s[moving], gnss.velocity_enu_mps[moving, i], sigma[moving], None)
            for i, name in enumerate(("gnss_v_e_mps", "gnss_v_n_mps"))
        ]
    return found


def _instants(
    channel: str, t_s: Array, values: Array, sigma: Array, correlation: tuple[float, float] | None
) -> Observed:
    known = np.isfinite(values)
    t_s, values, sigma = t_s[known], values[known], sigma[known]
    slot_s = sample_interval_s(t_s) if len(t_s) > 1 else 1.0
    slots = np.round(t_s / max(slot_s, 1e-6)).astype(np.int64)
    rows = Observed(channel, t_s, t_s, values, sigma, slots, slot_s, LEAST_SHARE, correlation)
    return rows.select(np.append(True, np.diff(slots) > 0)[: len(slots)])


def _truth(recording: Recording, start_ns: int) -> list[Observed]:
    truth, holds = recording.truth, recording.truth_channels
    if truth is None or not len(truth):
        return []
    every = max(1, round(BIN_S / sample_interval_s(_seconds(truth.t_ns, start_ns))))
    truth = truth.select(slice(None, None, every))
    t_s, found = _seconds(truth.t_ns, start_ns), []
    if "position" in holds and recording.truth_frame == "base":
        for i, name in enumerate(("truth_east_m", "truth_north_m")):
            sigma = np.full(len(t_s), TRUTH_SIGMA[0])
            found.append(_instants(name, t_s, truth.position_m[:, i], sigma, None))
    if truth.quaternion is not None and ("yaw" in holds or "orientation" in holds):
        seen = np.isfinite(truth.quaternion).all(axis=1)
        forward = quaternion_to_matrix(truth.quaternion[seen])[:, :, 0]
        yaw = np.unwrap(np.arctan2(forward[:, 1], forward[:, 0]))
        found.append(_instants("truth_yaw_rad", t_s[seen], yaw, np.full(len(yaw), TRUTH_SIGMA[1]), None))
    return found
