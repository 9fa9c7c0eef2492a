"""Battery, motor, gearbox and speed loop, as expressions.

Everything here is evaluated on the states a step begins with: the battery's
voltage follows from the torques the motors have, and limits those they may be
given next. So there is no algebraic loop. `motor_current` and `motor_voltage`
work on CasADi expressions and numpy arrays alike.
"""

from typing import Any

SMOOTHING_S = 0.02
"""Time constant of the current behind the battery's sag (assumed)."""
TURNING_RADPS = 0.05
"""Wheel speed within which the no-load current changes its sign."""
DRAW_WIDTH_W = 1e-3
"""A motor's power is cut off at zero within this width: the bridge does not feed back."""


def motor_torque(
    p: dict[str, Any], speed_radps: Any, error_radps: Any, integral_rad: Any, voltage_share: Any = 1.0
) -> tuple[Any, Any]:
    """Torque at the wheel the speed loop asks for within the motor's limits, N m, and d(integral)/dt, rad/s.

    A PI loop, clipped smoothly to the torque-speed line of a DC motor and to
    its current limit; back-calculation keeps the integral from winding up.
    `voltage_share` is the supply's voltage over the nominal one: stall torque
    and no-load speed are proportional to it.
    """
    from terrafusion.twin.physics.smooth import smooth_max, smooth_min

    wanted = p["loop_p_nms"] * error_radps + p["loop_i_nm"] * integral_rad
    at_wheel = p["gear_ratio"] * p["gear_efficiency"]
    relative = speed_radps * p["gear_ratio"] / p["no_load_radps"]
    limit, stall = p["torque_limit_nm"] * at_wheel, p["stall_torque_nm"] * at_wheel
    upper = smooth_min(limit, stall * (voltage_share - relative), 0.05)
    lower = -smooth_min(limit, stall * (voltage_share + relative), 0.05)
    clipped = smooth_max(smooth_min(wanted, upper, 0.05), lower, 0.05)
    return clipped, error_radps - (wanted - clipped) / p["loop_p_nms"]


def motor_current(p: Any, torque_nm: Any, speed_radps: Any) -> Any:
    """Motor current, A, from the torque (N m) and speed (rad/s) at the wheel.

    The gearbox takes its share of the power in both directions: 1/efficiency when driving, efficiency when
    braking, joined such that its loss is never negative. The no-load current overcomes the friction of motor
    and gears at any torque.
    """
    power = torque_nm * speed_radps
    sign = power / (power * power + 1e-2) ** 0.5
    driving, braking = 1.0 / p["gear_efficiency"] - 1.0, 1.0 - p["gear_efficiency"]
    loss = 1.0 + sign * (0.5 * (driving + braking) + 0.5 * sign * (driving - braking))
    turning = speed_radps / (speed_radps * speed_radps + TURNING_RADPS**2) ** 0.5
    return torque_nm / p["gear_ratio"] * loss * p["no_load_radps"] / p["supply_v"] + p["no_load_a"] * turning


def motor_voltage(p: Any, current_a: Any, speed_radps: Any) -> Any:
    """Motor voltage, V: winding drop plus back-EMF of an ideal DC motor (k_t = k_e = U / no-load speed)."""
    return winding_ohm(p) * current_a + p["supply_v"] / p["no_load_radps"] * p["gear_ratio"] * speed_radps


def winding_ohm(p: Any) -> Any:
    """Resistance of a motor's winding, ohm: nominal voltage over stall current."""
    return p["supply_v"] * p["supply_v"] / (p["no_load_radps"] * p["stall_torque_nm"])


def drawn_power(p: Any, torque_nm: Any, speed_radps: Any) -> Any:
    """Power a motor draws, W, never negative: a bridge without recovery burns what comes back."""
    from terrafusion.twin.physics.smooth import smooth_max

    current = motor_current(p, torque_nm, speed_radps)
    return smooth_max(motor_voltage(p, current, speed_radps) * current, 0.0, DRAW_WIDTH_W)


def battery(p: Any, power_w: Any, drawn_j: Any, current_a: Any) -> tuple[Any, Any, Any]:
    """Battery voltage under load, V, the power taken from its store, W, and d(current)/dt, A/s.

    The open-circuit voltage falls linearly with the energy taken, from `battery_full_v` to
    `battery_empty_v` and not below. The internal resistance carries the motors' current smoothed
    over `SMOOTHING_S`, as polarisation and the controllers' capacitors do; so the loop from voltage to
    torque to current is not stiff. The voltage stays above a third of the open one.

    Args:
        p: vehicle parameters.
        power_w: what all motors draw at the terminals.
        drawn_j: energy taken from the store since the start.
        current_a: smoothed current (state).
    """
    from terrafusion.twin.physics.smooth import smooth_max

    charge = smooth_max(p["battery_charge"] - drawn_j / p["battery_j"], 0.0, 1e-3)
    open_v = p["battery_empty_v"] + (p["battery_full_v"] - p["battery_empty_v"]) * charge
    voltage = smooth_max(open_v - p["battery_ohm"] * current_a, open_v / 3.0, 1e-3 * open_v)
    taken = power_w + p["battery_ohm"] * current_a * current_a
    return voltage, taken, (power_w / voltage - current_a) / SMOOTHING_S
