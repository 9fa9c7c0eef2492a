"""Priors and processes of the linear states: what wanders with the ground, and what a robot keeps."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from terrafusion.fusion.graph.gauss_markov import MarkovStep, markov_step
from terrafusion.fusion.graph.key_state import LINEAR, NAV, SIDE_SLIP, SLIP, SURGE_SLIP, YAW_SCALE
from terrafusion.fusion.graph.wheel_factor import WheelIncrement
from terrafusion.fusion.noise.policy import SensorNoise

if TYPE_CHECKING:
    from terrafusion.fusion.graph.chain import Chain

Array = NDArray[np.float64]

SLIP_STEADY = 30.0
"""Slip lasts so many correlation times of the policy's while the wheels keep their speed: those are of whole
drives, with starts, stops and hills. A compromise: on one soil the longer the better, where grounds change
without GNSS the shorter; see docs/monitor.md."""
SLIP_RENEWAL = 1.1
"""Slip is what traction asks for, and traction changes with speed: where the wheels change theirs by a
share x, `SLIP_RENEWAL x^2` of the slip is new. Tuned likewise,
as 2 of an x that was seen a quarter too small."""
GROUND_STATES = np.array([SLIP, YAW_SCALE, SIDE_SLIP, SURGE_SLIP]) - NAV.stop
"""What another ground changes; the receiver's drift and the calibration stay."""
CRAWL_MPS = 0.1
"""Below this wheel speed any change of it is a start or a stop."""
ICR_SIGMA_M, ICR_TIME_S = 0.10, 60.0
"""Centre of rotation along the body: a few tenths of the wheelbase, moving with the load (assumed)."""
YAW_SCALE_TIME_S = 60.0
YAW_SCALE_ROBOT = 0.2
"""Yaw scales of robots on one ground differ by so much from that of the policy's (assumed)."""
SIDE_SLIP_TIME_S = 5.0
SIDE_SLIP_SHARE = 0.3
"""Share of the ground's side-slip that lasts; all of it is new at every keyframe besides. Tuned on the twin:
what lasts cannot be told from heading on a straight drive, and 0.8 doubled the heading's error there."""
SIDE_SLIP_PER_GRADE, SIDE_SLIP_DOUBT = 0.7, 0.3
"""One shear law carries the robot along and across: on a cross slope it slips downhill by so much of the slip
it has on a grade as steep (twin: 0.70 on loose sand across 10 deg, 0.69 on medium sand across 15 deg), give
or take a share of it (assumed)."""
SURGE_TIME_S, SURGE_DOUBT = 60.0, 0.5
"""An acceleration asks for the thrust of a grade as steep as it is over gravity, and so for its slip, give or
take a share of it (assumed; in turns the twin slips more)."""
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
"""How well a vehicle file is trusted, 1 sigma (assumed: tyre wear and pressure, a tape measure, a mounting
plate, clocks of drivers)."""
_WALK = {name: 2e-4 * sigma for name, sigma in CALIBRATION_SIGMA.items()}
"""Walk of the calibration, per sqrt(s): hardly any, but what is certain for ever cannot be whitened."""


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
    backwards = wheels is not None and wheels.distance_m < 0.0
    downhill = -SIDE_SLIP_PER_GRADE * noise.slip_per_grade * float(up[1]) * (-1.0 if backwards else 1.0)
    sigma = _stationary(noise, drift_sigma_m)
    sigma[-1] = float(np.hypot(sigma[-1], SIDE_SLIP_DOUBT * downhill))
    renewed = 1.0 - (1.0 - switch) * (1.0 - _traction_change(dt_s, wheels))
    wandering = markov_step(
        dt_s,
        mean=[noise.slip_at(float(up[0])), 0.0, 0.0, noise.yaw_scale_mean, 0.0, downhill],
        sigma=sigma,
        time_s=[
            SLIP_STEADY * noise.slip_time_s,
            drift_time_s,
            drift_time_s,
            YAW_SCALE_TIME_S,
            ICR_TIME_S,
            SIDE_SLIP_TIME_S,
        ],
        forget=[renewed, 0.0, 0.0, switch, 0.0, switch],
    )
    walk = np.array(list(_WALK.values())) * np.sqrt(dt_s)
    surge = markov_step(dt_s, [noise.slip_per_grade], [_surge_sigma(noise)], [SURGE_TIME_S], [switch])
    return MarkovStep(
        np.concatenate([wandering.decay, np.ones(len(walk)), surge.decay]),
        np.concatenate([wandering.mean, np.zeros(len(walk)), surge.mean]),
        np.concatenate([wandering.sigma, walk, surge.sigma]),
    )


def inflate_slip_covariance(
    chain: Chain,
    t_ns: int,
    dt_s: float,
    noise: SensorNoise,
    drift_sigma_m: float,
    drift_time_s: float,
    switch: float,
) -> None:
    """Let the share `switch` of the slip start anew at the keyframe of `t_ns`, or the oldest that still can.

    The ground changed there, and is seen only now. What wheels and IMU told since then was explained by
    a speed that fits the old slip; with the slip free from there on, they tell the new one.
    """
    k = chain.at_or_after(t_ns)
    k = chain.first + 1 if k is None else max(k, chain.first + 1)
    if k <= chain.last:
        node = chain.nodes[k - chain.first]
        up = node.point.pose.rotation().matrix()[2]
        anew = step(dt_s, noise, up, drift_sigma_m, drift_time_s, switch, node.wheels)
        chain.revise(k, anew if node.markov is None else node.markov.opened(anew, GROUND_STATES))


def _traction_change(dt_s: float, wheels: WheelIncrement | None) -> float:
    """Share in [0, 1] of the slip that a change of the wheels' speed made anew."""
    if wheels is None:
        return 0.0
    speed_mps = max(abs(wheels.distance_m) / dt_s, CRAWL_MPS)
    return min(1.0, SLIP_RENEWAL * (wheels.speed_change_mps / speed_mps) ** 2)


def _surge_sigma(noise: SensorNoise) -> float:
    return SURGE_DOUBT * abs(noise.slip_per_grade) + 1e-3


def _stationary(noise: SensorNoise, drift_sigma_m: float) -> list[float]:
    slow_side_slip = SIDE_SLIP_SHARE * noise.side_slip_sigma
    drift = [drift_sigma_m, drift_sigma_m]
    yaw_scale = float(np.hypot(noise.yaw_scale_sigma, YAW_SCALE_ROBOT))
    return [noise.slip_sigma, *drift, yaw_scale, ICR_SIGMA_M, slow_side_slip]
