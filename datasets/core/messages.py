"""Single samples of a recording, as a driver would deliver them: one small type a channel.

Arrays are views into the channels. Units and frames are those of the channel of the same name in `recording`.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array


class ImuSample(NamedTuple):
    """Angular rate (3,) rad/s and specific force (3,) m/s2, body axes."""

    t_ns: int
    gyro_radps: Array
    accel_mps2: Array


class WheelSample(NamedTuple):
    """Speed (k,) of the wheels or sides `names`, in `unit` "radps" or "mps"; angle turned where counted."""

    t_ns: int
    speed: Array
    names: tuple[str, ...]
    unit: str
    angle_rad: Array | None


class GnssSample(NamedTuple):
    """One fix: antenna position and 1 sigma (3,), ENU m; class of fix; velocity (3,) and sigma if known."""

    t_ns: int
    enu_m: Array
    sigma_enu_m: Array
    fix: int
    velocity_enu_mps: Array | None
    sigma_v_mps: float


class CommandSample(NamedTuple):
    """Commanded forward speed and yaw rate."""

    t_ns: int
    v_mps: float
    yaw_rate_radps: float


class MotorSample(NamedTuple):
    """Current (2,) of left and right, A, and voltage (2,), V, where known."""

    t_ns: int
    current_a: Array
    voltage_v: Array | None


class TerrainSample(NamedTuple):
    """Label of the ground, its source, and probabilities by class where known."""

    t_ns: int
    label: str
    source: str
    probabilities: dict[str, float] | None


class SteeringSample(NamedTuple):
    """Steering angles (k,) of `names`, rad, positive to the left."""

    t_ns: int
    angle_rad: Array
    names: tuple[str, ...]


class BarometerSample(NamedTuple):
    """Static pressure, Pa."""

    t_ns: int
    pressure_pa: float


class MagnetometerSample(NamedTuple):
    """Magnetic flux density (3,), body axes, T."""

    t_ns: int
    field_t: Array


Message = (
    ImuSample
    | WheelSample
    | GnssSample
    | CommandSample
    | MotorSample
    | SteeringSample
    | TerrainSample
    | BarometerSample
    | MagnetometerSample
)


def sides(values: NDArray[Any], names: tuple[str, ...]) -> Array:
    """Mean of the left and of the right wheels (N, 2); both the same where there is one column."""
    if len(names) == 1:
        return np.repeat(values, 2, axis=1)
    left = [i for i, name in enumerate(names) if name.endswith("left")]
    right = [i for i, name in enumerate(names) if name.endswith("right")]
    return np.stack([values[:, left].mean(axis=1), values[:, right].mean(axis=1)], axis=1)


def axles(angles: NDArray[Any], names: tuple[str, ...], steering_ratio: float = 1.0) -> Array:
    """Mean angle of the front and of the rear wheels (N, 2), of `Steering.angle_rad` (N, k) and its names.

    Rear wheels without a column do not steer. `steering_ratio` is the angle of a steering wheel over that
    of the front wheels.
    """
    still = np.zeros(len(angles))
    if names == ("front", "rear"):
        return np.asarray(angles, dtype=float)
    if len(names) == 1:
        return np.stack(
            [angles[:, 0] / (steering_ratio if names == ("steering_wheel",) else 1.0), still], axis=1
        )
    return np.stack([angles[:, :2].mean(axis=1), angles[:, 2:].mean(axis=1)], axis=1)
