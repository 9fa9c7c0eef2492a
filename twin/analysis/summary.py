"""What a run amounts to: slip, energy and where it went, and whether the robot got stuck."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.sensors import STEERED_DRIVES
from terrafusion.twin.model.motion import BodyMotion
from terrafusion.twin.model.vehicle import VehicleParams
from terrafusion.twin.physics.layout import ENDS, INDEX, SIDES, VEHICLE_PARAMETERS, state_slice
from terrafusion.twin.physics.motors import gear_loss, motor_current, motor_voltage, winding_loss
from terrafusion.twin.scenario.commands import DrivenStates, wheel_angles

MOVING_MPS = 0.1
"""Slip is averaged over samples that move faster than this."""
STOPPED_MPS = 0.05
LOST_TRAVEL_M = 5.0
"""A robot that stands while this much more travel is commanded is immobilised."""
SPINNING_SHARE = 0.2
"""A robot that stands has lost traction where its rims run at more than this share of the commanded speed."""
TRACTION_LOST, MOTOR_STALLED = "traction lost", "motors stalled"


@dataclass(frozen=True)
class RunSummary:
    """What a run amounts to.

    `mean_abs_slip` is the mean of |1 - v_odom / v_truth| over samples with
    |v_truth| > 0.1 m/s (the source study's proxy, eq. 2), `mean_slip_ratio`
    that of the usual |w R - u| / max(|w R|, |u|); both NaN for a run that never
    moves. `energy_j` is drawn from the battery, `motor_work_j` done at the
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


@dataclass(frozen=True)
class Energy:
    """Where the energy of a run went, J; every entry is a sum over the run.

    Attributes:
        battery_j: taken from the battery's store.
        battery_heat_j: lost in its internal resistance.
        motor_heat_j: lost in the windings.
        gear_heat_j: lost in the gearboxes.
        braking_heat_j: given back by the motors while braking, and burnt.
        slip_j: spent in the slip of the wheels.
        resistance_j: spent in rolling, compaction and drag.
        potential_j: gained in height.
        kinetic_j: gained in speed of body and wheels.
    """

    battery_j: float
    battery_heat_j: float
    motor_heat_j: float
    gear_heat_j: float
    braking_heat_j: float
    slip_j: float
    resistance_j: float
    potential_j: float
    kinetic_j: float

    def missing_j(self) -> float:
        """What the balance does not account for; zero but for errors of quadrature."""
        lost = self.battery_heat_j + self.motor_heat_j + self.gear_heat_j + self.braking_heat_j
        return self.battery_j - lost - self.slip_j - self.resistance_j - self.potential_j - self.kinetic_j


def slip_ratios(driven: DrivenStates, motion: BodyMotion, vehicle: VehicleParams) -> Array:
    """Slip ratio (N, 4) of each wheel, (w R - u) / max(|w R|, |u|), 0 at rest; u is along the wheel."""
    rim = driven.states[:, state_slice("wheel_speed")] * vehicle.wheel.radius_m
    half = 0.5 * vehicle.body.track_m * np.array(SIDES)
    hub = motion.velocity_body_mps[:, :1] - motion.yaw_rate_radps[:, None] * half
    if vehicle.drive.type in STEERED_DRIVES:
        ahead = 0.5 * vehicle.body.wheelbase_m * np.array(ENDS)
        across = motion.velocity_body_mps[:, 1:2] + motion.yaw_rate_radps[:, None] * ahead
        angle = wheel_angles(driven.inputs, vehicle)
        hub = np.cos(angle) * hub + np.sin(angle) * across
    larger = np.maximum(np.abs(rim), np.abs(hub))
    return np.where(larger > 1e-3, (rim - hub) / np.maximum(larger, 1e-3), 0.0)


def summarise(driven: DrivenStates, motion: BodyMotion, vehicle: VehicleParams, slip: Array) -> RunSummary:
    """The run in a few numbers, from its states and slip ratios (N, 4)."""
    states, t_s = driven.states, motion.t_s
    speed = motion.velocity_body_mps[:, 0]
    odometry = states[:, state_slice("wheel_speed")].mean(axis=1) * vehicle.odometry.wheel_radius_m
    moving = np.abs(speed) > MOVING_MPS
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


def _immobilised(
    t_s: Array, motion: BodyMotion, driven: DrivenStates, vehicle: VehicleParams
) -> tuple[float, float, float, str] | tuple[None, None, None, None]:
    """When, where (x, y) and why the robot came to rest for good, or nothing."""
    moving = np.hypot(motion.velocity_body_mps[:, 0], motion.velocity_body_mps[:, 1]) > STOPPED_MPS
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


def energy_of(t_s: Array, states: Array, parameters: Array) -> Energy:
    """Where the energy of a run went.

    The heat is summed from the samples by the trapezoid rule and independently of the
    integrated states, so that the balance is a check of both.

    Args:
        t_s: (N,) samples, s.
        states: (N, X) in the order of `layout.STATES`.
        parameters: (V,) `layout.VEHICLE_PARAMETERS`.
    """
    p = dict(zip(VEHICLE_PARAMETERS, parameters.tolist(), strict=True))
    torque, wheel = states[:, state_slice("torque")], states[:, state_slice("wheel_speed")]
    current = motor_current(p, torque, wheel)
    power = motor_voltage(p, current, wheel) * current
    given_back = np.minimum(power, 0.0)
    total = {
        name: float(states[-1, INDEX[name]] - states[0, INDEX[name]])
        for name in ("electric_energy", "slip_work", "resistance_work")
    }
    return Energy(
        battery_j=total["electric_energy"],
        battery_heat_j=_sum(t_s, p["battery_ohm"] * states[:, INDEX["sag_current"]] ** 2),
        motor_heat_j=_sum(t_s, winding_loss(p, current).sum(axis=1)),
        gear_heat_j=_sum(t_s, gear_loss(p, current, torque, wheel).sum(axis=1)),
        braking_heat_j=-_sum(t_s, given_back.sum(axis=1)),
        slip_j=total["slip_work"],
        resistance_j=total["resistance_work"],
        potential_j=_gained(_potential_j(p, states)),
        kinetic_j=_gained(_kinetic_j(p, states)),
    )


def _potential_j(p: dict[str, float], states: Array) -> Array:
    """Potential energy (N,) of the centre of gravity in the plane's gravity."""
    x, y, yaw = (states[:, INDEX[name]] for name in ("x", "y", "yaw"))
    forward, left = p["cg_forward_m"], p["cg_left_m"]
    along_x = x + np.cos(yaw) * forward - np.sin(yaw) * left
    along_y = y + np.sin(yaw) * forward + np.cos(yaw) * left
    return np.asarray(-p["mass_kg"] * (p["gravity_x_mps2"] * along_x + p["gravity_y_mps2"] * along_y))


def _kinetic_j(p: dict[str, float], states: Array) -> Array:
    """Kinetic energy (N,) of body and wheels."""
    u, v, r = (states[:, INDEX[name]] for name in ("u", "v", "r"))
    wheels = (states[:, state_slice("wheel_speed")] ** 2).sum(axis=1)
    body = p["mass_kg"] * (u**2 + v**2) + p["yaw_inertia_kgm2"] * r**2
    return np.asarray(0.5 * (body + p["wheel_inertia_kgm2"] * wheels))


def _gained(energy_j: Array) -> float:
    return float(energy_j[-1] - energy_j[0])


def _sum(t_s: Array, power_w: Array) -> float:
    return float(np.trapezoid(power_w, t_s))
