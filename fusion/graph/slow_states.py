"""Priors and processes of the linear states."""

import math

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.gauss_markov import MarkovStep, markov_step
from terrafusion.fusion.graph.key_state import ICR_X, LINEAR, NAV, SIDE_SLIP, SLIP, SURGE_SLIP, YAW_SCALE
from terrafusion.fusion.graph.wheel_factor import WheelIncrement
from terrafusion.fusion.noise.policy import SensorNoise

SLIP_STEADY = 30.0
"""Correlation time of slip at constant wheel speed over the policy's, which is that of whole runs with
starts, stops and hills. Longer is better on one soil, shorter where grounds change without GNSS; see
docs/explanation/monitor.md."""
SLIP_RENEWAL = 1.1
"""Where the wheels change their speed by a share x, `SLIP_RENEWAL x^2` of the slip is new, as traction
changes with speed (tuned)."""
MOST_SWITCH = 0.98
"""Largest share of the slip that a detected change of ground renews: spread over keyframes, a change that is
certain would renew all of it at each of them."""
GROUND_STATES = np.array([SLIP, YAW_SCALE, SIDE_SLIP, SURGE_SLIP]) - NAV.stop
"""What another ground changes; the receiver's drift and the calibration stay."""
CRAWL_MPS = 0.1
"""Below this wheel speed any change of it is a start or a stop."""
ICR_SIGMA_M, ICR_TIME_S = 0.10, 60.0
"""Centre of rotation along the body: a few tenths of the wheelbase, moving with the load (assumed)."""
YAW_SCALE_TIME_S = 60.0
YAW_SCALE_ROBOT = 0.2
"""Spread of the yaw scale between robots on one ground (assumed)."""
SIDE_SLIP_TIME_S = 5.0
SIDE_SLIP_SHARE = 0.3
"""Share of the ground's side-slip that lasts; all of it is new at every keyframe besides. Tuned on the twin:
more cannot be distinguished from heading on a straight drive."""
SIDE_SLIP_PER_GRADE, SIDE_SLIP_DOUBT = 0.7, 0.3
"""Side-slip on a cross slope over the slip on a grade as steep (twin: 0.70 on loose sand across 10 deg, 0.69
on medium sand across 15 deg), and its relative error (assumed)."""
SURGE_TIME_S, SURGE_DOUBT = 60.0, 0.5
"""An acceleration a needs the thrust, and so the slip, of a grade a / g; its relative error (assumed)."""
CALIBRATION_SIGMA = {
    "radius_scale": 0.02,
    "antenna_x_m": 0.05,
    "antenna_y_m": 0.05,
    "imu_roll_rad": 0.02,
    "imu_pitch_rad": 0.02,
    "imu_yaw_rad": 0.02,
    "wheel_delay_s": 0.03,
    "gnss_delay_s": 0.1,
}
"""Prior 1 sigma of a vehicle file (assumed: tyre wear and pressure, tape measure, mounting plate, driver
clocks). The estimator replaces that of the antenna by `calibration.numbers.antenna_sigma_m`."""
_ICR = ICR_X - NAV.stop
_WALK_SIGMA = 2e-4 * np.array(list(CALIBRATION_SIGMA.values()))
"""Random walk of the calibration per sqrt(s), so that its covariance stays positive."""
_CONSTANT = slice(6, 6 + len(CALIBRATION_SIGMA))
"""Places of the calibration among the linear states."""
_NONE, _FOREVER = [0.0] * len(CALIBRATION_SIGMA), [math.inf] * len(CALIBRATION_SIGMA)


def prior(noise: SensorNoise, grade: float, drift_sigma_m: float) -> tuple[Array, Array]:
    """Mean and 1 sigma (15,) of the linear states before any data, on the ground of `noise`."""
    mean, sigma = np.zeros(len(LINEAR)), np.empty(len(LINEAR))
    mean[0], mean[3] = noise.slip_at(grade), noise.yaw_scale_mean
    sigma[:6] = _stationary(noise, drift_sigma_m)
    sigma[6:-1] = list(CALIBRATION_SIGMA.values())
    mean[-1], sigma[-1] = noise.slip_per_grade, _surge_sigma(noise)
    return mean, sigma


def step(
    dt_s: float,
    noise: SensorNoise,
    up: Array,
    drift_sigma_m: float,
    drift_time_s: float,
    switch: float,
    wheels: WheelIncrement | None = None,
) -> MarkovStep:
    """The step of all linear states over `dt_s`.

    `up` (3,) is the world's up in body axes, `switch` the share of the ground that just changed.
    """
    ahead = -1.0 if wheels is not None and wheels.distance_m < 0.0 else 1.0
    grade = ahead * float(up[0])
    downhill = -SIDE_SLIP_PER_GRADE * noise.slip_per_grade * ahead * float(up[1])
    sigma = _stationary(noise, drift_sigma_m)
    sigma[-1] = math.hypot(sigma[-1], SIDE_SLIP_DOUBT * downhill)
    if wheels is not None:
        sigma[_ICR] = math.hypot(ICR_SIGMA_M, wheels.course_lag_sigma_s * wheels.distance_m / dt_s)
    restarted = 1.0 - (1.0 - switch) * (1.0 - _traction_change(dt_s, wheels))
    drift, slip_time_s = drift_time_s, SLIP_STEADY * noise.slip_time_s
    mean = [noise.slip_at(grade), 0.0, 0.0, noise.yaw_scale_mean, 0.0, downhill]
    time_s = slip_time_s, drift, drift, YAW_SCALE_TIME_S, ICR_TIME_S, SIDE_SLIP_TIME_S
    out = markov_step(
        dt_s,
        mean=[*mean, *_NONE, noise.slip_per_grade],
        sigma=[*sigma, *_NONE, _surge_sigma(noise)],
        time_s=(*time_s, *_FOREVER, SURGE_TIME_S),
        forget=[restarted, 0.0, 0.0, switch, 0.0, switch, *_NONE, switch],
    )
    out.sigma[_CONSTANT] = _WALK_SIGMA * math.sqrt(dt_s)
    return out


def inflate_slip_covariance(
    chain: Chain,
    t_ns: int,
    dt_s: float,
    noise: SensorNoise,
    drift_sigma_m: float,
    drift_time_s: float,
    switch: float,
) -> None:
    """Restart the share `switch` of the slip, spread evenly over the keyframes since `t_ns` that are held.

    A change of ground is detected late; until then the measurements were explained by a speed that fits
    the old slip. With the restart spread out, the IMU shows when the speed changed.
    """
    k = chain.at_or_after(t_ns)
    k = chain.first + 1 if k is None else max(k, chain.first + 1)
    passed = range(k, chain.last + 1)
    share = 1.0 - (1.0 - min(switch, MOST_SWITCH)) ** (1.0 / max(len(passed), 1))
    for k in passed:
        node = chain.node(k)
        anew = step(dt_s, noise, node.point.rotation[2], drift_sigma_m, drift_time_s, share, node.wheels)
        chain.revise(k, anew if node.markov is None else node.markov.inflated(anew, GROUND_STATES))


def _traction_change(dt_s: float, wheels: WheelIncrement | None) -> float:
    """Share in [0, 1] of the slip that a change of wheel speed renews."""
    if wheels is None:
        return 0.0
    speed_mps = max(abs(wheels.distance_m) / dt_s, CRAWL_MPS)
    return min(1.0, SLIP_RENEWAL * (wheels.speed_change_mps / speed_mps) ** 2)


def _surge_sigma(noise: SensorNoise) -> float:
    return SURGE_DOUBT * abs(noise.slip_per_grade) + 1e-3


def _stationary(noise: SensorNoise, drift_sigma_m: float) -> list[float]:
    slow_side_slip = SIDE_SLIP_SHARE * noise.side_slip_sigma
    drift = [drift_sigma_m, drift_sigma_m]
    yaw_scale = math.hypot(noise.yaw_scale_sigma, YAW_SCALE_ROBOT)
    return [noise.slip_sigma, *drift, yaw_scale, ICR_SIGMA_M, slow_side_slip]
