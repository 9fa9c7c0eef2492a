"""Motor, gearbox and speed loop of one wheel, as CasADi expressions."""

from __future__ import annotations

from typing import Any


def motor_torque(p: dict[str, Any], speed_radps: Any, error_radps: Any, integral_rad: Any) -> tuple[Any, Any]:
    """Torque at the wheel the speed loop asks for within the motor's limits, N m, and d(integral)/dt, rad/s.

    A PI loop, clipped smoothly to the torque-speed line of a DC motor and to
    its current limit; back-calculation keeps the integral from winding up.
    """
    from terrafusion.twin.wheel import smooth_max, smooth_min

    wanted = p["loop_p_nms"] * error_radps + p["loop_i_nm"] * integral_rad
    at_wheel = p["gear_ratio"] * p["gear_efficiency"]
    relative = speed_radps * p["gear_ratio"] / p["no_load_radps"]
    limit, stall = p["torque_limit_nm"] * at_wheel, p["stall_torque_nm"] * at_wheel
    upper = smooth_min(limit, stall * (1.0 - relative), 0.05)
    lower = -smooth_min(limit, stall * (1.0 + relative), 0.05)
    clipped = smooth_max(smooth_min(wanted, upper, 0.05), lower, 0.05)
    return clipped, error_radps - (wanted - clipped) / p["loop_p_nms"]


def motor_current(p: Any, torque_nm: Any, speed_radps: Any) -> Any:
    """Motor current, A, from the torque (N m) and speed (rad/s) at the wheel.

    The gearbox takes its share of the power that flows through it, whichever
    way it flows. Works on CasADi expressions and numpy arrays alike.
    """
    power = torque_nm * speed_radps
    way = power / (power * power + 1e-2) ** 0.5
    loss = 0.5 * (1.0 + way) / p["gear_efficiency"] + 0.5 * (1.0 - way) * p["gear_efficiency"]
    return torque_nm / p["gear_ratio"] * loss * p["no_load_radps"] / p["supply_v"]


def motor_voltage(p: Any, current_a: Any, speed_radps: Any) -> Any:
    """Motor voltage, V: winding drop plus back-EMF of an ideal DC motor (k_t = k_e = U / no-load speed)."""
    k_e = p["supply_v"] / p["no_load_radps"]
    resistance = p["supply_v"] * k_e / p["stall_torque_nm"]
    return resistance * current_a + k_e * p["gear_ratio"] * speed_radps
