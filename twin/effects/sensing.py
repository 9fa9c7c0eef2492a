"""Effects of the sensors. With a positive offset in time, a reading is that of an earlier time."""

import math
from typing import Any

import casadi as ca

from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.twin.effects.form import SIDES_BY_NAME, Form, Parameter, Quantities, on_side, one, two
from terrafusion.twin.physics.smooth import grown, smooth_abs

WHEEL_SPEEDS = ("wheel_left_radps", "wheel_right_radps")
ACCELS = ("accel_x_mps2", "accel_y_mps2")
IMU = ("yaw_rate_radps", *ACCELS)
POSITION, VELOCITY = ("gnss_east_m", "gnss_north_m"), ("gnss_v_e_mps", "gnss_v_n_mps")

# Constants of the laws, assumed unless a source is given; see the equations below.
DROPPING_RADPS = 5.0
WARM_UP_S, CLOCK_S = 60.0, 60.0
TURN_WIDTH_RADPS = 0.01
RESONANCE_MPS, RESONANCE_WIDTH = 0.8, 0.1
MULTIPATH_M, SLOW_MPS = 10.0, 0.3


def _scaled(q: Quantities, names: tuple[str, ...], factor: Any) -> dict[str, Any]:
    return {name: q[name] * factor for name in names}


def _in_loop(q: Quantities, share: Any) -> dict[str, Any]:
    return {"loop_speed_radps": q["loop_speed_radps"] * (1.0 + share)}


def _added(q: Quantities, names: tuple[str, ...], values: tuple[Any, ...]) -> dict[str, Any]:
    return {name: q[name] + value for name, value in zip(names, values, strict=True)}


def _late(q: Quantities, names: tuple[str, ...], delay: Any) -> dict[str, Any]:
    """Readings of the past, to first order in the delay."""
    return {name: q[name] - delay * q[f"d_{name}"] for name in names}


def _drops_when_fast(q: Quantities, share: Any) -> dict[str, Any]:
    lost = {name: share * grown(q[name], DROPPING_RADPS) for name in WHEEL_SPEEDS}
    return {name: q[name] * (1.0 - lost[name]) for name in WHEEL_SPEEDS}


def _warmed(q: Quantities) -> Any:
    return 1.0 - ca.exp(-q["elapsed"] / WARM_UP_S)


def _turned(q: Quantities, angle: Any) -> dict[str, Any]:
    """Readings of an IMU turned by `angle` to the left."""
    x, y, cos, sin = q[ACCELS[0]], q[ACCELS[1]], ca.cos(angle), ca.sin(angle)
    return {ACCELS[0]: cos * x + sin * y, ACCELS[1]: cos * y - sin * x}


def _resonance(q: Quantities) -> Any:
    """Power of a structure that rings at `RESONANCE_MPS`: 0 at rest, 1 at its peak."""
    square = (q["rim_mps"] / RESONANCE_MPS) ** 2
    off = 1.0 - square
    return RESONANCE_WIDTH * square / (off * off + RESONANCE_WIDTH * square)


def _bent_mast(q: Quantities, compliance: Any) -> dict[str, Any]:
    x, y = (-compliance / GRAVITY_MPS2 * q[f"specific_force_{axis}_mps2"] for axis in ("x", "y"))
    cos, sin = q["cos_yaw"], q["sin_yaw"]
    return _added(q, POSITION, (cos * x - sin * y, sin * x + cos * y))


def _standing_waves(q: Quantities, east: Any, north: Any) -> dict[str, Any]:
    turn = 2.0 * math.pi / MULTIPATH_M
    return _added(q, POSITION, (east * ca.sin(turn * q["x"]), north * ca.sin(turn * q["y"])))


def _when_slow(q: Quantities, east: Any, north: Any) -> dict[str, Any]:
    fade = 1.0 / (1.0 + (q["u"] * q["u"] + q["v"] * q["v"]) / SLOW_MPS**2)
    return _added(q, POSITION, (east * fade, north * fade))


def _seconds(scale: float, high: float) -> tuple[Parameter, ...]:
    return one("s", scale, -high, high)


FORMS = (
    Form(
        "encoder_scale", "reading", one("", 0.02, -0.5, 0.5),
        {"measurement": lambda q, e: _scaled(q, WHEEL_SPEEDS, 1.0 + e)},
        "reads w (1 + e); the speed loop does not know", "scale factor",
    ),
    Form(
        "encoder_scale", "in_loop", one("", 0.02, -0.5, 0.5),
        {
            "motor": _in_loop,
            "measurement": lambda q, e: _scaled(q, WHEEL_SPEEDS, 1.0 + e),
        },
        "reads w (1 + e), and the speed loop closes on it", "scale factor",
    ),
    *(
        Form(
            "encoder_scale", f"{name}_in_loop", one("", 0.02, -0.5, 0.5),
            {
                "motor": on_side(side, _in_loop),
                "measurement": lambda q, e, of=speed: _scaled(q, (of,), 1.0 + e),
            },
            f"{name} wheels read w (1 + e), and the speed loop closes on it", "scale factor", composite=True,
        )
        for speed, (name, side) in zip(WHEEL_SPEEDS, SIDES_BY_NAME.items(), strict=True)
    ),
    Form(
        "encoder_dropout", "share", one("", 0.02, 0.0, 1.0),
        {"measurement": lambda q, e: _scaled(q, WHEEL_SPEEDS, 1.0 - e)},
        "the share e of all counts is lost: mean reading w (1 - e)", "expected value",
    ),
    Form(
        "encoder_dropout", "with_speed", one("", 0.05, 0.0, 1.0), {"measurement": _drops_when_fast},
        "mean reading w (1 - e w^2 / (w^2 + (5 rad/s)^2))", "ours: edges too close to count",
    ),
    Form(
        "gyro_bias", "constant", one("rad/s", 0.003, -0.2, 0.2),
        {"measurement": lambda q, e: _added(q, IMU[:1], (e,))}, "r + e", "bias",
    ),
    Form(
        "gyro_bias", "warm_up", one("rad/s", 0.003, -0.2, 0.2),
        {"measurement": lambda q, e: _added(q, IMU[:1], (e * _warmed(q),))},
        "r + e (1 - exp(-t / 60 s))", "ours: first-order warm-up",
    ),
    Form(
        "gyro_scale", "scale", one("", 0.02, -0.5, 0.5),
        {"measurement": lambda q, e: _scaled(q, IMU[:1], 1.0 + e)}, "r (1 + e)", "scale factor (IEEE 528)",
    ),
    Form(
        "gyro_scale", "asymmetry", one("", 0.02, -0.5, 0.5),
        {"measurement": lambda q, e: _added(
            q, IMU[:1], (e * (smooth_abs(q["r"], TURN_WIDTH_RADPS) - TURN_WIDTH_RADPS),)
        )},
        "r + e abs(r)", "scale factor asymmetry (IEEE 528)",
    ),
    Form(
        "accel_bias", "constant", two(("x", "y"), "m/s2", 0.05, 2.0),
        {"measurement": lambda q, x, y: _added(q, ACCELS, (x, y))}, "f + e, e along x and y", "bias",
    ),
    Form(
        "accel_bias", "warm_up", two(("x", "y"), "m/s2", 0.05, 2.0),
        {"measurement": lambda q, x, y: _added(q, ACCELS, (x * _warmed(q), y * _warmed(q)))},
        "f + e (1 - exp(-t / 60 s))", "ours: first-order warm-up",
    ),
    Form(
        "imu_yaw_misalignment", "rotation", one("rad", 0.03, -0.5, 0.5), {"measurement": _turned},
        "IMU turned by e to the left: f rotated by -e", "geometry",
    ),
    Form(
        "imu_yaw_misalignment", "cross_axis", one("rad", 0.03, -0.5, 0.5),
        {"measurement": lambda q, e: _added(q, ACCELS[1:], (-e * q[ACCELS[0]],))},
        "only the y axis leans: f_y - e f_x", "cross-axis sensitivity (IEEE 528)",
    ),
    Form(
        "imu_lever_arm", "offset", two(("x", "y"), "m", 0.1, 1.0),
        {"mounting": lambda q, x, y: _added(q, ("imu_x_m", "imu_y_m"), (x, y))},
        "IMU sits e further along x and y", "rigid body",
    ),
    Form(
        "imu_lever_arm", "size_effect", two(("x", "y"), "m", 0.1, 1.0),
        {"measurement": lambda q, x, y: _added(q, ACCELS, (-x * q["r"] * q["r"], -y * q["r"] * q["r"]))},
        "f - r^2 e: each accelerometer displaced along its own axis", "size effect (Savage 2000)",
    ),
    Form(
        "vibration_rectification", "power", two(("x", "y"), "m/s2", 0.05, 2.0),
        {"measurement": lambda q, x, y: _added(q, ACCELS, (x * q["rim_mps"] ** 2, y * q["rim_mps"] ** 2))},
        "f + e (V / 1 m/s)^2, V mean rim speed", "bias by the variance of the vibration (IEEE 1293)",
    ),
    Form(
        "vibration_rectification", "resonance", two(("x", "y"), "m/s2", 0.05, 2.0),
        {"measurement": lambda q, x, y: _added(q, ACCELS, (x * _resonance(q), y * _resonance(q)))},
        "f + e 0.1 s / ((1 - s)^2 + 0.1 s), s = (V / 0.8 m/s)^2", "ours: a mount that rings",
    ),
    Form(
        "imu_time_offset", "shift", _seconds(0.02, 0.5), {"stamp": lambda q, e: _late(q, IMU, e)},
        "gyro and accelerometer read y - e dy/dt", "first order",
    ),
    Form(
        "imu_time_offset", "drift", _seconds(0.02, 0.5),
        {"stamp": lambda q, e: _late(q, IMU, e * q["elapsed"] / CLOCK_S)},
        "the same with e t / 60 s", "first order; a clock that runs slow",
    ),
    Form(
        "gnss_latency", "both", _seconds(0.1, 2.0),
        {"stamp": lambda q, e: _late(q, POSITION + VELOCITY, e)},
        "position and velocity read y - e dy/dt", "first order",
    ),
    Form(
        "gnss_latency", "velocity", _seconds(0.1, 2.0), {"stamp": lambda q, e: _late(q, VELOCITY, e)},
        "velocity alone reads v - e dv/dt",
        "first order; receivers that average it (NovAtel BESTVEL)",
    ),
    Form(
        "gnss_lever_arm", "offset", two(("x", "y"), "m", 0.1, 2.0),
        {"mounting": lambda q, x, y: _added(q, ("antenna_x_m", "antenna_y_m"), (x, y))},
        "antenna sits e further along x and y", "rigid body",
    ),
    Form(
        "gnss_lever_arm", "mast", one("m", 0.1, 0.0, 1.0), {"measurement": _bent_mast},
        "antenna displaced by -e f / g, f specific force along x and y", "ours: a mast that bends",
    ),
    Form(
        "gnss_multipath", "standing", two(("east", "north"), "m", 0.3, 20.0),
        {"measurement": _standing_waves},
        "position + e sin(2 pi x / 10 m), x and y of the plane", "ours",
    ),
    Form(
        "gnss_multipath", "slow", two(("east", "north"), "m", 0.3, 20.0), {"measurement": _when_slow},
        "position + e / (1 + (V / 0.3 m/s)^2): the antenna's motion averages it out", "ours",
    ),
)  # fmt: skip
