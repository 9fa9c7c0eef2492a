"""One wheel on soft ground, as CasADi expressions: the laws of `terramechanics` put together.

Every function takes and returns CasADi scalars (or floats) in SI units, is
smooth everywhere, and is zero where the physics is: no force without
shear displacement, no resistance without motion.
"""

from typing import NamedTuple

import casadi as ca

from terrafusion.twin.physics import terramechanics as tm
from terrafusion.twin.physics.smooth import Scalar, saturate, smooth_abs, smooth_max
from terrafusion.twin.physics.terramechanics import SLIP_SPEED_MPS, WheelShape

REST_SPEED_MPS = 1e-4
"""Below this speed a wheel counts as resting: the leak of the held shear displacement is of this order."""
RESISTANCE_SPEED_MPS = 0.02
"""Speed over which motion resistance builds up from zero."""
BRAKE_BRISTLE_M = 0.01
"""Rim travel over which rolling resistance builds up."""
SHEAR_DAMPING_S = 0.03
"""Visco-elastic time constant of the soil in shear at rest."""
SHEAR_DAMPING_FADE_MPS = 0.05
"""Speed at which that damping has fallen to half: a rolling wheel meets fresh soil."""


class WheelSoil(NamedTuple):
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
    skid_sinkage: Scalar


class Contact(NamedTuple):
    """Forces of the ground on one wheel, and rates of its contact states.

    `force_x_n`, `force_y_n` act on the body at the hub (traction less motion
    resistance and drag, body axes), `traction_x_n` turns the wheel back (`traction_y_n` is its side part),
    `drag_torque_nm` brakes it. `shear_rate_x`, `shear_rate_y` are the time
    derivatives of the shear displacement, m/s, `brake_rate` that of the bristle
    deflection behind the braking torque, `renewal_per_s` the rate at which the wheel meets fresh soil.
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
    renewal_per_s: Scalar


class Footprint(NamedTuple):
    """Sinkage and length of the contact, m, and skid, 0 to 2.

    `wall_m` is the depth of its side in the ground, the rut it rolls in included.
    """

    sinkage_m: Scalar
    length_m: Scalar
    skid: Scalar
    wall_m: Scalar


def slipping(rim_mps: Scalar, hub_mps: tuple[Scalar, Scalar]) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """Slip velocity along body x and y, transport speed of the soil (both m/s), and the slip ratio."""
    u, v = hub_mps
    hub = ca.sqrt(u * u + v * v + REST_SPEED_MPS**2)
    transport = smooth_max(smooth_abs(rim_mps, REST_SPEED_MPS), hub, REST_SPEED_MPS)
    slip_x = rim_mps - u
    return slip_x, -v, transport, slip_x / smooth_abs(transport, SLIP_SPEED_MPS)


def footprint(
    ground: WheelSoil,
    load_n: Scalar,
    rim_mps: Scalar,
    hub_mps: tuple[Scalar, Scalar],
    clog: Scalar,
    shape: WheelShape,
    following: Scalar = 0.0,
) -> Footprint:
    """How deep and how long the wheel stands in the ground.

    z = z0 (1 - m f)(1 + k_ss d + k_sk s) + z_clog q^4: the static sinkage z0 (Bekker 1969), less what the
    wheel ahead has left to do in its rut (f = `following`, m = `multipass`), grown in proportion to the
    driven slip d (Lyasko 2010 has 1.5 to 3 for k_ss) and to the skid s, and by clogging q. What it sinks
    less in a rut the rut is deep already: its side meets ground as high as in fresh soil, at least.
    """
    transport = slipping(rim_mps, hub_mps)[2]
    static = tm.static_sinkage(ground.k_c, ground.k_phi, ground.exponent, load_n, shape)
    fresh = static * (1.0 - ground.multipass * following)
    skid = tm.skid(rim_mps, hub_mps)
    dug = ground.slip_sinkage * tm.driven_slip(rim_mps, hub_mps[0], transport) + ground.skid_sinkage * skid
    clog_square = clog * clog
    grown = fresh * (1.0 + dug) + ground.clog_sinkage_m * clog_square * clog_square
    limit = tm.SINKAGE_LIMIT_RADII * shape.radius_m
    z = saturate(grown, limit)
    rut = ground.multipass * following * static * (1.0 + dug)
    return Footprint(z, _chord(ground, z, shape), skid, saturate(grown + rut, limit))


def _chord(ground: WheelSoil, depth_m: Scalar, shape: WheelShape) -> Scalar:
    """Length of the contact of a wheel that stands at a depth, m."""
    return ca.sqrt(2.0 * shape.radius_m * depth_m - depth_m * depth_m + ground.contact_floor_m**2)


def contact(
    ground: WheelSoil,
    load_n: Scalar,
    rim_mps: Scalar,
    hub_mps: tuple[Scalar, Scalar],
    shear_m: tuple[Scalar, Scalar],
    brake_m: Scalar,
    clog: Scalar,
    shape: WheelShape,
    following: Scalar = 0.0,
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
        shape: of the wheel.
        following: share in which it rolls in the rut of a wheel ahead, 0 to 1.

    The soil under the wheel shears with the slip velocity v_s = (w R - u, -v)
    and is renewed at the transport speed V over the contact length l:
    dj/dt = v_s - j V / l, in steady rolling Janosi and Hanamoto's j = v_s l / |w R|.
    Rolling resistance, suction and clogging brake the wheel like dry friction, by a bristle
    (Dahl 1968) that deflects within `BRAKE_BRISTLE_M` of rim travel.
    """
    u, v = hub_mps
    slip_x, slip_y, transport, slip = slipping(rim_mps, hub_mps)
    z, length, skid, wall = footprint(ground, load_n, rim_mps, hub_mps, clog, shape, following)
    damping = SHEAR_DAMPING_S / (1.0 + transport / SHEAR_DAMPING_FADE_MPS)
    jx = shear_m[0] + damping * slip_x
    jy = shear_m[1] + damping * slip_y
    stiffness = _shear_stiffness(ground, load_n, (jx, jy), length, shape)
    front, side = _bulldozing(ground, (z, wall), (length, _chord(ground, wall, shape)), shape)
    traction_x = stiffness * jx
    traction_y = stiffness * jy + side * tm.mobilised(jy, ground.shear_modulus_m)

    pushed = tm.compaction_resistance(ground.exponent, load_n, z, shape.radius_m)
    # The soil is pushed along the path of the hub: the resistance opposes its velocity.
    speed = ca.sqrt(u * u + v * v + RESISTANCE_SPEED_MPS**2)
    drag = pushed / speed + ground.viscous_ns_per_m
    clog_square = clog * clog
    brake = ground.rolling * load_n * shape.radius_m + ground.clog_torque_nm * clog_square * clog_square
    brake = brake + tm.suction_torque(ground.suction_pa, length, shape.width_m)
    rolled = brake_m / BRAKE_BRISTLE_M
    return Contact(
        force_x_n=traction_x - (drag + front * skid / speed) * u,
        force_y_n=traction_y - drag * v,
        traction_x_n=traction_x,
        drag_torque_nm=brake * rolled,
        brake_rate=rim_mps - smooth_abs(rim_mps, REST_SPEED_MPS) * rolled,
        shear_rate_x=slip_x - shear_m[0] * transport / length,
        shear_rate_y=slip_y - shear_m[1] * transport / length,
        slip=slip,
        sinkage_m=z,
        traction_y_n=traction_y,
        renewal_per_s=transport / length,
    )


def steady_contact(
    ground: WheelSoil, load_n: Scalar, rim_mps: Scalar, hub_mps: tuple[Scalar, Scalar], shape: WheelShape
) -> Contact:
    """The contact in steady motion on fresh ground: shear and bristle at rest in closed form."""
    slip_x, slip_y, transport, _ = slipping(rim_mps, hub_mps)
    stay_s = footprint(ground, load_n, rim_mps, hub_mps, 0.0, shape).length_m / transport
    brake = BRAKE_BRISTLE_M * rim_mps / smooth_abs(rim_mps, REST_SPEED_MPS)
    shear = (slip_x * stay_s, slip_y * stay_s)
    return contact(ground, load_n, rim_mps, hub_mps, shear, brake, 0.0, shape)


def _shear_stiffness(
    ground: WheelSoil, load_n: Scalar, shear_m: tuple[Scalar, Scalar], length_m: Scalar, shape: WheelShape
) -> Scalar:
    """Thrust over shear displacement, N/m: Mohr-Coulomb strength, mobilised by shear, below the cap."""
    ratio = ca.sqrt((shear_m[0] ** 2 + shear_m[1] ** 2) / ground.shear_modulus_m**2 + 1e-4)
    cohesive, frictional = tm.grouser_gains(shape, length_m)
    strength = ground.cohesion_pa * shape.width_m * length_m * (1.0 + cohesive)
    strength = strength + load_n * ground.tan_friction * (1.0 + frictional)
    thrust = strength * tm.shear_fraction_over_displacement(ratio) * ratio
    return saturate(thrust, ground.friction_cap * load_n) / (ratio * ground.shear_modulus_m)


def _bulldozing(
    ground: WheelSoil, depth_m: tuple[Scalar, Scalar], length_m: tuple[Scalar, Scalar], shape: WheelShape
) -> tuple[Scalar, Scalar]:
    """Passive force of the soil on the wheel's front and on its side, N, where fully mobilised.

    Depths and contact lengths are those of front and side: in a rut the side also meets its wall.
    """
    pressures = tm.passive_pressures(ground.cohesion_pa, ground.tan_friction, ground.unit_weight_n_per_m3)
    front, _ = tm.bulldozed(pressures, depth_m[0], length_m[0], shape.width_m)
    _, side = tm.bulldozed(pressures, depth_m[1], length_m[1], shape.width_m)
    return ground.bulldozing * front, ground.bulldozing * side


def clog_rate(ground: WheelSoil, clog: Scalar, rim_mps: Scalar, slip: Scalar) -> Scalar:
    """dq/dt of the clogging state, 1/s: picked up and shed with wheel travel (see `soil.Mud`)."""
    travel = smooth_abs(rim_mps, RESISTANCE_SPEED_MPS) - RESISTANCE_SPEED_MPS
    pickup = ground.pickup_per_m * (1.0 + ground.churn_gain * clog * slip * slip) * (1.0 - clog)
    return travel * (pickup - ground.shed_per_m * clog)
