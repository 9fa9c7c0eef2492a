"""What a run amounts to: slip, energy and where it went, and whether the robot got stuck."""

import math
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.sensors import STEERED_DRIVES
from terrafusion.twin.model.measurement import rolling
from terrafusion.twin.model.motion import BodyMotion
from terrafusion.twin.model.plant import Plant
from terrafusion.twin.model.vehicle import VehicleParams
from terrafusion.twin.physics.layout import INDEX, SIDES, state_slice
from terrafusion.twin.scenario.commands import DrivenStates, wheel_angles

MOVING_MPS = 0.1
"""Slip is averaged over samples that move faster than this."""
STOPPED_MPS = 0.05
SLOW_SHARE = 0.5
"""A robot moves at this share of the fastest speed commanded, where that is less than the two above."""
LOST_TRAVEL_M = 5.0
"""A robot that stands while this much more travel is commanded is immobilised."""
SPINNING_SHARE = 0.2
"""A robot that stands has lost traction where its rims run at more than this share of the commanded speed."""
TRACTION_LOST, MOTOR_STALLED = "traction lost", "motors stalled"


@dataclass(frozen=True)
class RunSummary:
    """What a run amounts to.

    `mean_abs_slip` is the mean of |1 - v_odom / v_truth| over samples with
    |v_truth| > 0.1 m/s, or half the fastest speed commanded (the source study's proxy, eq. 2),
    `mean_slip_ratio` that of the wheels' mean of the usual (w R - u) / max(|w R|, |u|), without its sign;
    both NaN for a run that never moves. `energy_j` is drawn from the battery, `motor_work_j` done at the
    wheels; their difference is `heat_j`, in battery, motors, gearboxes and braking.
    `slip_work_j` is spent in the slip of the wheels, `resistance_work_j`
    in rolling, compaction and drag; what is left of the motors' work is in height and speed.

    `immobilised_at_s` is when the robot came to rest for good although more driving was commanded;
    `immobilised_x_m` and `immobilised_y_m` are where, east and north of the start, and
    `immobilised_cause` is why: "traction lost" (the wheels turn) or "motors stalled" (they do not).
    All four are None when it did not.
    """

    duration_s: float
    distance_m: float
    mean_abs_slip: float
    mean_slip_ratio: float
    energy_j: float
    energy_per_m_j: float
    motor_work_j: float
    immobilised_at_s: float | None
    immobilised_x_m: float | None
    immobilised_y_m: float | None
    immobilised_cause: str | None
    mean_power_w: float
    peak_power_w: float
    heat_j: float
    slip_work_j: float
    resistance_work_j: float


def slip_ratios(driven: DrivenStates, motion: BodyMotion, vehicle: VehicleParams, plant: Plant) -> Array:
    """Slip ratio (N, 4) of each wheel, (w R - u) / max(|w R|, |u|), 0 at rest; u is along the wheel.

    Radii and places of the wheels are those that the plant's effects make of the vehicle's.
    """
    if plant.effect_names():
        rim, hub = rolling(driven.states, driven.inputs, plant)
    else:
        rim = driven.states[:, state_slice("wheel_speed")] * vehicle.wheel.radius_m
        half = 0.5 * vehicle.body.track_m * np.array(SIDES)
        hub = motion.velocity_body_mps[:, :1] - motion.yaw_rate_radps[:, None] * half
    larger = np.maximum(np.abs(rim), np.abs(hub))
    return np.where(larger > 1e-3, (rim - hub) / np.maximum(larger, 1e-3), 0.0)


def summarise(driven: DrivenStates, motion: BodyMotion, vehicle: VehicleParams, slip: Array) -> RunSummary:
    """The run in a few numbers, from its states and slip ratios (N, 4)."""
    states, t_s = driven.states, motion.t_s
    speed = motion.velocity_body_mps[:, 0]
    turned = states[:, state_slice("wheel_speed")]
    if vehicle.drive.type in STEERED_DRIVES:  # the part of a wheel's way that is ahead
        turned = turned * np.cos(wheel_angles(driven.inputs, vehicle))
    odometry = turned.mean(axis=1) * vehicle.odometry.wheel_radius_m
    moving = np.abs(speed) > _least_speed(MOVING_MPS, driven)
    distance = float(np.sum(np.linalg.norm(np.diff(motion.position_m, axis=0), axis=1)))
    drawn, work, slipped, resisted = (
        states[:, INDEX[name]] for name in ("electric_energy", "motor_work", "slip_work", "resistance_work")
    )
    energy = float(drawn[-1])
    proxy = np.abs(1.0 - odometry[moving] / speed[moving])
    ratio = np.abs(slip.mean(axis=1))[moving]
    stuck = _immobilised(t_s, motion, driven, vehicle)
    return RunSummary(
        duration_s=float(t_s[-1]),
        distance_m=distance,
        mean_abs_slip=float(proxy.mean()) if moving.any() else math.nan,
        mean_slip_ratio=float(ratio.mean()) if moving.any() else math.nan,
        energy_j=energy,
        energy_per_m_j=energy / distance if distance > 0.1 else math.nan,
        motor_work_j=float(work[-1]),
        immobilised_at_s=stuck[0],
        immobilised_x_m=stuck[1],
        immobilised_y_m=stuck[2],
        immobilised_cause=stuck[3],
        mean_power_w=energy / float(t_s[-1]),
        peak_power_w=float(np.max(np.diff(drawn) / np.diff(t_s))),
        heat_j=energy - float(work[-1]),
        slip_work_j=float(slipped[-1]),
        resistance_work_j=float(resisted[-1]),
    )


def _least_speed(usual_mps: float, driven: DrivenStates) -> float:
    """From what speed a robot moves; turns on the spot alone command none."""
    fastest = float(np.abs(driven.commanded[:, 0]).max())
    return min(usual_mps, SLOW_SHARE * fastest) if fastest > 0.0 else usual_mps


def _immobilised(
    t_s: Array, motion: BodyMotion, driven: DrivenStates, vehicle: VehicleParams
) -> tuple[float, float, float, str] | tuple[None, None, None, None]:
    """When, where (x, y) and why the robot came to rest for good, or nothing."""
    speed = np.hypot(motion.velocity_body_mps[:, 0], motion.velocity_body_mps[:, 1])
    moving = speed > _least_speed(STOPPED_MPS, driven)
    commanded = driven.commanded[:, 0] != 0.0
    # A robot that never moved is stuck from its first command on.
    last = int(np.flatnonzero(moving)[-1]) if moving.any() else int(np.argmax(commanded))
    missing = float(np.sum(np.abs(driven.commanded[last:, 0]))) * float(t_s[1] - t_s[0])
    if missing <= LOST_TRAVEL_M:
        return None, None, None, None
    rims = np.abs(driven.states[last:, state_slice("wheel_speed")]) * vehicle.wheel.radius_m
    turned = float(np.sum(rims.mean(axis=1))) * float(t_s[1] - t_s[0])
    cause = TRACTION_LOST if turned > SPINNING_SHARE * missing else MOTOR_STALLED
    x, y, _ = motion.position_m[last].tolist()
    return float(t_s[last]), x, y, cause
