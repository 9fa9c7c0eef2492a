"""One wheel on soft ground, as CasADi expressions.

Every function takes and returns CasADi scalars (or floats) in SI units, is
smooth everywhere, and is zero where the physics says zero: no force without
shear displacement, no resistance without motion.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca

Scalar = Any
"""A CasADi SX scalar or a float."""

REST_SPEED_MPS = 1e-4
"""Below this speed a wheel counts as resting: the leak of the held shear displacement is of this order."""
RESISTANCE_SPEED_MPS = 0.02
"""Speed over which motion resistance builds up from zero."""
BRAKE_BRISTLE_M = 0.01
"""Rim travel over which rolling resistance builds up."""
SLIP_SPEED_MPS = 0.02
"""Speed below which the slip ratio fades to zero."""
SHEAR_DAMPING_S = 0.03
"""Visco-elastic time constant of the soil in shear at rest."""
SHEAR_DAMPING_FADE_MPS = 0.05
"""Speed at which that damping has fallen to half: a rolling wheel meets fresh soil."""
SINKAGE_LIMIT_RADII = 0.8
"""Sinkage saturates at this fraction of the wheel radius."""


class Ground(NamedTuple):
    """Ground under one wheel: the soil numbers of `soil.SoilParams` as expressions (SI units)."""

    k_c: Scalar
    k_phi: Scalar
    exponent: Scalar
    slip_sinkage: Scalar
    contact_floor_m: Scalar
    cohesion_pa: Scalar
    tan_friction: Scalar
    shear_modulus_m: Scalar
    friction_cap: Scalar
    rolling: Scalar
    viscous_ns_per_m: Scalar
    pickup_per_m: Scalar
    churn_gain: Scalar
    shed_per_m: Scalar
    clog_torque_nm: Scalar
    clog_sinkage_m: Scalar
    unit_weight_n_per_m3: Scalar
    bulldozing: Scalar
    suction_pa: Scalar
    multipass: Scalar


class Contact(NamedTuple):
    """What the ground does to one wheel.

    `force_x_n`, `force_y_n` act on the body at the hub (traction less motion
    resistance and drag, body axes), `traction_x_n` turns the wheel back (`traction_y_n` is its side part),
    `drag_torque_nm` brakes it. `shear_rate_x`, `shear_rate_y` are the time
    derivatives of the shear displacement, m/s, `brake_rate` that of the bristle
    deflection behind the braking torque.
    """

    force_x_n: Scalar
    force_y_n: Scalar
    traction_x_n: Scalar
    drag_torque_nm: Scalar
    shear_rate_x: Scalar
    shear_rate_y: Scalar
    brake_rate: Scalar
    slip: Scalar
    sinkage_m: Scalar
    traction_y_n: Scalar


def smooth_abs(value: Scalar, width: float) -> Scalar:
    """|value|, rounded within `width` of zero, never below `width`."""
    return ca.sqrt(value * value + width * width)


def smooth_max(a: Scalar, b: Scalar, width: float) -> Scalar:
    """The larger of a and b, rounded where they differ by less than `width`."""
    return 0.5 * (a + b + smooth_abs(a - b, width))


def smooth_min(a: Scalar, b: Scalar, width: float) -> Scalar:
    """The smaller of a and b, rounded where they differ by less than `width`."""
    return 0.5 * (a + b - smooth_abs(a - b, width))


def saturate(value: Scalar, limit: Scalar) -> Scalar:
    """value / (1 + (value/limit)^4)^(1/4) for value >= 0: identity when small, `limit` when large."""
    ratio = value / limit
    square = ratio * ratio
    return value / ca.sqrt(ca.sqrt(1.0 + square * square))


def sinkage(
    ground: Ground, load_n: Scalar, slip: Scalar, clog: Scalar, radius_m: Scalar, width_m: Scalar
) -> Scalar:
    """Sinkage, m: rigid wheel (Bekker 1969), grown by slip (Lyasko 2010) and by clogging.

    z0 = [3 W / ((3 - n)(k_c + b k_phi) sqrt(D))]^(2/(2n+1)), z = z0 (1 + k_ss |s|) + z_clog q^4.
    """
    n = ground.exponent
    stiffness = ground.k_c + width_m * ground.k_phi
    static = (3.0 * load_n / ((3.0 - n) * stiffness * ca.sqrt(2.0 * radius_m))) ** (2.0 / (2.0 * n + 1.0))
    grown = static * (1.0 + ground.slip_sinkage * smooth_abs(slip, 0.01)) + ground.clog_sinkage_m * clog**4
    return saturate(grown, SINKAGE_LIMIT_RADII * radius_m)


def compaction_resistance(ground: Ground, sinkage_m: Scalar, width_m: Scalar) -> Scalar:
    """Motion resistance by compaction, N (Bekker 1969): (k_c + b k_phi) z^(n+1) / (n+1)."""
    n1 = ground.exponent + 1.0
    return (ground.k_c + width_m * ground.k_phi) * sinkage_m**n1 / n1


def shear_fraction_over_displacement(ratio: Scalar) -> Scalar:
    """g(x)/x of the mean shear under a wheel, x = j/K: g = 1 - (1 - exp(-x)) / x (Wong 2008, eq. 2.65).

    The shear displacement grows linearly along the contact to j at its end.
    `ratio` must be positive; the limit at zero is 1/2.
    """
    return (ratio - 1.0 + ca.exp(-ratio)) / (ratio * ratio)


def slipping(rim_mps: Scalar, hub_mps: tuple[Scalar, Scalar]) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """Slip velocity along body x and y, transport speed of the soil (both m/s), and the slip ratio."""
    u, v = hub_mps
    hub = ca.sqrt(u * u + v * v + REST_SPEED_MPS**2)
    transport = smooth_max(smooth_abs(rim_mps, REST_SPEED_MPS), hub, REST_SPEED_MPS)
    slip_x = rim_mps - u
    return slip_x, -v, transport, slip_x / smooth_abs(transport, SLIP_SPEED_MPS)


def contact(
    ground: Ground,
    load_n: Scalar,
    rim_mps: Scalar,
    hub_mps: tuple[Scalar, Scalar],
    shear_m: tuple[Scalar, Scalar],
    brake_m: Scalar,
    clog: Scalar,
    radius_m: Scalar,
    width_m: Scalar,
) -> Contact:
    """Forces and shear rates of one wheel.

    Args:
        ground: soil numbers.
        load_n: vertical load, N.
        rim_mps: circumferential speed w R, m/s.
        hub_mps: velocity of the hub along body x and y, m/s.
        shear_m: shear displacement at the end of the contact along body x and y, m (states).
        brake_m: bristle deflection of the braking torque, m (state).
        clog: clogging state, 0 clean to about 1.
        radius_m: wheel radius, m.
        width_m: wheel width, m.

    The soil under the wheel shears with the slip velocity v_s = (w R - u, -v)
    and is renewed at the transport speed V over the contact length l:
    dj/dt = v_s - j V / l, in steady rolling Janosi and Hanamoto's j = v_s l / |w R|.
    Rolling resistance and clogging brake the wheel like dry friction, by a bristle
    (Dahl 1968) that deflects within `BRAKE_BRISTLE_M` of rim travel.
    """
    u, v = hub_mps
    rim = smooth_abs(rim_mps, REST_SPEED_MPS)
    slip_x, slip_y, transport, slip = slipping(rim_mps, hub_mps)
    z = sinkage(ground, load_n, slip, clog, radius_m, width_m)
    length = ca.sqrt(2.0 * radius_m * z - z * z + ground.contact_floor_m**2)

    damping = SHEAR_DAMPING_S / (1.0 + transport / SHEAR_DAMPING_FADE_MPS)
    jx = shear_m[0] + damping * slip_x
    jy = shear_m[1] + damping * slip_y
    ratio = ca.sqrt((jx * jx + jy * jy) / ground.shear_modulus_m**2 + 1e-4)
    fraction = shear_fraction_over_displacement(ratio)
    strength = ground.cohesion_pa * width_m * length + load_n * ground.tan_friction
    scale = saturate(strength * fraction * ratio, ground.friction_cap * load_n) / (
        ratio * ground.shear_modulus_m
    )
    traction_x, traction_y = scale * jx, scale * jy

    compaction = saturate(compaction_resistance(ground, z, width_m), load_n)
    # The soil is pushed along the hub's way: the resistance opposes its velocity.
    drag = compaction / ca.sqrt(u * u + v * v + RESISTANCE_SPEED_MPS**2) + ground.viscous_ns_per_m
    clog_square = clog * clog
    brake = ground.rolling * load_n * radius_m + ground.clog_torque_nm * clog_square * clog_square
    rolled = brake_m / BRAKE_BRISTLE_M
    return Contact(
        force_x_n=traction_x - drag * u,
        force_y_n=traction_y - drag * v,
        traction_x_n=traction_x,
        drag_torque_nm=brake * rolled,
        brake_rate=rim_mps - rim * rolled,
        shear_rate_x=slip_x - shear_m[0] * transport / length,
        shear_rate_y=slip_y - shear_m[1] * transport / length,
        slip=slip,
        sinkage_m=z,
        traction_y_n=traction_y,
    )


def clog_rate(ground: Ground, clog: Scalar, rim_mps: Scalar, slip: Scalar) -> Scalar:
    """dq/dt of the clogging state, 1/s: picked up and shed with wheel travel (see `soil.Mud`)."""
    travel = smooth_abs(rim_mps, RESISTANCE_SPEED_MPS) - RESISTANCE_SPEED_MPS
    pickup = ground.pickup_per_m * (1.0 + ground.churn_gain * clog * slip * slip) * (1.0 - clog)
    return travel * (pickup - ground.shed_per_m * clog)
