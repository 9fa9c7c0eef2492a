"""The laws of a wheel on soil, each alone: sinkage, resistance, shear, passive pressure, grousers, ruts.

CasADi expressions (or floats) in SI units, smooth everywhere, without `if_else` and with no power of a
number that may be zero. Symbols: W load, R radius, D = 2R, b width, z sinkage, l contact length,
n exponent of the pressure-sinkage law p = (k_c / b + k_phi) z^n.
"""

import math
from typing import Any, NamedTuple

import casadi as ca

from terrafusion.twin.physics.smooth import saturate, smooth_abs, smooth_max

Scalar = Any
"""A CasADi SX scalar or a float."""

SINKAGE_LIMIT_RADII = 1.5
"""Sinkage saturates at this many wheel radii (deepest in the single-wheel trials: 1.3)."""
SLIP_SPEED_MPS = 0.02
"""Speed below which slip and skid fade to zero: a standing wheel digs no deeper."""
SKID_LIMIT = 2.0
"""Skid of a wheel that turns backwards saturates here."""
FOLLOWING_SPEED_MPS = 0.05
"""Speed over which an axle becomes the one that follows."""


class WheelShape(NamedTuple):
    """Geometry of a wheel; grousers stand out by `grouser_height_m`, `grouser_count` around the rim."""

    radius_m: Scalar
    width_m: Scalar
    grouser_height_m: Scalar = 0.0
    grouser_count: Scalar = 0.0


def static_sinkage(k_c: Scalar, k_phi: Scalar, exponent: Scalar, load_n: Scalar, shape: WheelShape) -> Scalar:
    """Sinkage of a rigid wheel that rolls freely, m (Bekker 1969; Wong 2008, eq. 2.57).

    z0 = [3 W / ((3 - n)(k_c + b k_phi) sqrt(D))]^(2/(2n+1)).
    """
    stiffness = (3.0 - exponent) * (k_c + shape.width_m * k_phi) * ca.sqrt(2.0 * shape.radius_m)
    return ca.exp(2.0 / (2.0 * exponent + 1.0) * ca.log(3.0 * load_n / stiffness))


def driven_slip(rim_mps: Scalar, along_mps: Scalar, transport_mps: Scalar) -> Scalar:
    """Slip ratio of a driven wheel, 0 to 1 (2 against the motion); 0 for a braked wheel."""
    rim = smooth_abs(rim_mps, SLIP_SPEED_MPS)
    ahead = (rim_mps - along_mps) * rim_mps / (rim * smooth_abs(transport_mps, SLIP_SPEED_MPS))
    return smooth_max(ahead, 0.0, 0.01)


def skid(rim_mps: Scalar, hub_mps: tuple[Scalar, Scalar]) -> Scalar:
    """Skid 1 - w R u / |V|^2: share of the path that the wheel slides, 0 where it rolls or spins.

    The skid ratio of a braked wheel; 1 for one that is pushed sideways.
    """
    u, v = hub_mps
    square = u * u + v * v
    skid = smooth_max((square - rim_mps * u) / (square + SLIP_SPEED_MPS**2), 0.0, 0.01)
    return saturate(skid, SKID_LIMIT)


def compaction_resistance(exponent: Scalar, load_n: Scalar, sinkage_m: Scalar, radius_m: Scalar) -> Scalar:
    """Motion resistance by compaction, N: 3 W / ((3 - n)(n + 1)) sqrt(z / D).

    Bekker's (k_c + b k_phi) z^(n+1) / (n+1) (1969) with the stiffness for which the load W is in balance
    at the sinkage z. At the static sinkage both are the same; a wheel that has dug itself in deeper still
    carries no more than its load.
    """
    share = 3.0 / ((3.0 - exponent) * (exponent + 1.0))
    return share * load_n * ca.sqrt(sinkage_m / (2.0 * radius_m))


def passive_pressures(
    cohesion_pa: Scalar, tan_friction: Scalar, unit_weight_n_per_m3: Scalar
) -> tuple[Scalar, Scalar]:
    """Rankine's passive pressure at the depth h, a + g h (Rankine 1857, Bell 1915; Wong 2008, eq. 2.10).

    a = 2 c sqrt(N), Pa, and g = gamma N, Pa/m, with the flow value N = tan^2(45 deg + phi/2).
    """
    root = tan_friction + ca.sqrt(1.0 + tan_friction * tan_friction)
    return 2.0 * cohesion_pa * root, unit_weight_n_per_m3 * root * root


def bulldozed(
    pressures: tuple[Scalar, Scalar], sinkage_m: Scalar, chord_m: Scalar, width_m: Scalar
) -> tuple[Scalar, Scalar]:
    """Passive force, N, on the sunken front (width b, depth z) and on one sunken side of a wheel.

    The side is the segment below the surface, taken as a parabola of depth z over 2 l (`chord_m` is l):
    its area is 4/3 z l, its first moment 8/15 z^2 l.
    """
    a, g = pressures
    z = sinkage_m
    return width_m * z * (a + 0.5 * g * z), z * chord_m * (4.0 / 3.0 * a + 8.0 / 15.0 * g * z)


def shear_fraction_over_displacement(ratio: Scalar) -> Scalar:
    """g(x)/x of the mean shear under a wheel, x = j/K: g = 1 - (1 - exp(-x)) / x (Wong 2008, eq. 2.65).

    The shear displacement grows linearly along the contact to j at its end (Janosi and Hanamoto 1961).
    `ratio` must be positive; the limit at zero is 1/2.
    """
    return (ratio - 1.0 + ca.exp(-ratio)) / (ratio * ratio)


def mobilised(displacement: Scalar, modulus: Scalar) -> Scalar:
    """Share from -1 to 1 of the passive pressure mobilised by a displacement: g(x) with its sign.

    Pade's approximant x (3 + x) / (6 + 4 x + x^2) of the same g, within 0.018: no exponential.
    """
    x = displacement / modulus
    size = smooth_abs(x, 0.01)
    return x * (3.0 + size) / (6.0 + 4.0 * size + size * size)


def grouser_gains(shape: WheelShape, length_m: Scalar) -> tuple[Scalar, Scalar]:
    """What grousers add to the cohesive and to the frictional thrust, as shares (Bekker 1969).

    H = c b l (1 + 2 h/b) + W tan(phi) (1 + 0.64 (h/b) arctan(b/h)), once at least one of them is in the
    contact; below that the gain falls with their number. arctan(1/q) is taken as pi/2 - q + q^3/3,
    right to 0.006 for q = h/b up to 0.5.
    """
    q = shape.grouser_height_m / shape.width_m
    engaged = saturate(shape.grouser_count * length_m / (2.0 * math.pi * shape.radius_m), 1.0)
    return engaged * 2.0 * q, engaged * 0.64 * q * (0.5 * math.pi - q + q * q * q / 3.0)


def suction_torque(suction_pa: Scalar, length_m: Scalar, width_m: Scalar) -> Scalar:
    """Torque, N m, of soil that clings to the rear contact: suction on the area b l at the arm l/2."""
    return 0.5 * suction_pa * width_m * length_m * length_m


def following(u_mps: Scalar, v_mps: Scalar, wheelbase_m: Scalar, width_m: Scalar, end: int) -> Scalar:
    """Share from 0 to 1 in which an axle (`end` 1 front, -1 rear) rolls in the rut of the other.

    Smooth in the direction of travel. The tracks lie wheelbase * v / u apart, v the side speed midway
    between the axles: in a steady turn the rear wheels follow, in a side-slip they do not. The share falls
    to a half where the tracks overlap by half a width.
    """
    speed = smooth_abs(u_mps, FOLLOWING_SPEED_MPS)
    behind = 0.5 * (1.0 - end * u_mps / speed)
    apart = 2.0 * wheelbase_m * v_mps / (speed * width_m)
    return behind * behind / (1.0 + apart * apart)
