"""Where the energy of a run went: a balance that checks the states the twin integrates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.physics.layout import INDEX, VEHICLE_PARAMETERS, state_slice
from terrafusion.twin.physics.motors import motor_current, motor_voltage, winding_ohm


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


def winding_loss(p: Any, current_a: Any) -> Any:
    """Heat in a motor's winding, W."""
    return winding_ohm(p) * current_a * current_a


def gear_loss(p: Any, current_a: Any, torque_nm: Any, speed_radps: Any) -> Any:
    """Heat of friction in motor and gearbox, W: the power of the motor's field less that at the wheel."""
    back_emf = p["supply_v"] / p["no_load_radps"] * p["gear_ratio"] * speed_radps
    return back_emf * current_a - torque_nm * speed_radps
