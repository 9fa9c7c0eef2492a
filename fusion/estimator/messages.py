"""Messages of a recording or a driver as an estimator takes them."""

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.messages import (
    BarometerSample,
    CommandSample,
    GnssSample,
    ImuSample,
    Message,
    SteeringSample,
    TerrainSample,
    WheelSample,
    axles,
)
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimator.steering import front_ratio
from terrafusion.fusion.inputs.streams import DECLARE, ImuStream
from terrafusion.fusion.inputs.validation import as_number, as_numbers
from terrafusion.fusion.terrain.external import TRUE_SOURCES, known_probabilities
from terrafusion.fusion.weighting.adaptive import TerrainNoise

Arguments = tuple[Any, ...]


def arguments_of(message: Message, config: EstimatorConfig) -> tuple[str, Arguments] | None:
    """The estimator's method for a message and what it takes after the time; None if left out.

    Left out are rows with missing values that the graph needs, fixes of class "none", ground labels that a
    person or the simulation gave, motor currents, and the magnetometer (use `add_magnetic_field`).

    Raises:
        DataError: it is no message.
    """
    for kind, (method, read) in _READERS.items():
        if isinstance(message, kind):
            arguments = read(message, config)
            return None if arguments is None else (method, arguments)
    if not isinstance(message, tuple):
        raise DataError(
            f"a {type(message).__name__} is no message",
            remedy="give what Recording.messages() yields, or call add_imu, add_wheels, add_gnss",
        )
    return None


def count_left_out(message: Message, config: EstimatorConfig, imu: ImuStream, weights: TerrainNoise) -> None:
    """Count a message of which `arguments_of` makes nothing, where its source should have given more."""
    if isinstance(message, ImuSample) and config.inputs.imu == "six_axis":
        imu.leave_out(message.gyro_radps)
    elif isinstance(message, TerrainSample) and message.source not in TRUE_SOURCES:
        weights.left_out += 1


def _imu(message: ImuSample, config: EstimatorConfig) -> Arguments | None:
    kind = config.inputs.imu
    gyro = _vector(message.gyro_radps, 3, "gyro", "imu")
    accel = _vector(message.accel_mps2, 3, "accel", "imu")
    needed = sum(gyro.tolist()) + sum(accel.tolist()) if kind == "six_axis" else gyro[2]
    return (gyro, accel) if kind != "none" and math.isfinite(needed) else None


def _gnss(message: GnssSample, _: EstimatorConfig) -> Arguments | None:
    m = message
    if not m.fix:
        return None
    enu = _vector(m.enu_m, 3, "position", "gnss")
    sigma = _vector(m.sigma_enu_m, 3, "sigma", "gnss")
    known = math.isfinite(enu[0] + enu[1])  # a sigma that is missing is that of the class
    return (enu, sigma, m.velocity_enu_mps, m.sigma_v_mps, m.fix) if known else None


def _command(message: CommandSample, _: EstimatorConfig) -> Arguments | None:
    v_mps = as_number(message.v_mps, "speed", "command")
    return (v_mps,) if math.isfinite(v_mps) else None


def _terrain(message: TerrainSample, config: EstimatorConfig) -> Arguments | None:
    if message.probabilities is None or message.source in TRUE_SOURCES:
        return None
    named = known_probabilities(message.probabilities, config.policy.names())
    return None if named is None else (named,)


def _steering(message: SteeringSample, config: EstimatorConfig) -> Arguments | None:
    if config.rig.steering is None:
        return None
    angle = _vector(message.angle_rad, len(message.names), "steering angle", "steering")
    if not np.isfinite(angle).all():
        return None
    return tuple(axles(angle[None], message.names, front_ratio(config.rig))[0].tolist())


def _wheels(message: WheelSample, config: EstimatorConfig) -> Arguments | None:
    radius_m, names = config.rig.wheel_radius_m, message.names
    if len(names) == 1 and config.inputs.sides:
        raise DataError(
            "body speed alone, where the estimator expects both sides", channel="wheels", remedy=DECLARE
        )
    speed = _vector(message.speed, len(names), "wheel speed", "wheels")
    left, right = _sides(speed, 1.0 if message.unit == "mps" else radius_m, names)
    if not math.isfinite(left + right):
        return None
    if message.angle_rad is not None:
        turned = _sides(_vector(message.angle_rad, len(names), "wheel angle", "wheels"), radius_m, names)
        if math.isfinite(turned[0] + turned[1]):
            return left, right, *turned
    return left, right


_READERS: dict[type, tuple[str, Callable[..., Arguments | None]]] = {
    ImuSample: ("add_imu", _imu),
    WheelSample: ("add_wheels", _wheels),
    GnssSample: ("add_gnss", _gnss),
    CommandSample: ("add_command", _command),
    SteeringSample: ("add_steering", _steering),
    BarometerSample: ("add_pressure", lambda message, _: (message.pressure_pa,)),
    TerrainSample: ("add_terrain", _terrain),
}


def _vector(values: ArrayLike | None, count: int, what: str, channel: str) -> Array:
    """Values (count,) of a message as floats."""
    vector = as_numbers(values, what, channel)
    if vector.shape != (count,):
        raise DataError(
            f"{what} has the shape {vector.shape}", channel=channel, remedy=f"give {count} numbers"
        )
    return vector


def _sides(values: Array, factor: float, names: tuple[str, ...]) -> tuple[float, float]:
    """Left and right of one sample, times a factor."""
    scaled = [factor * value for value in values.tolist()]
    if len(scaled) == 1:
        return scaled[0], scaled[0]
    left, right = _places(names)
    if not left or not right:
        raise DataError(
            f"wheels named {', '.join(map(str, names))}", channel="wheels", remedy="name them left and right"
        )
    return sum([scaled[i] for i in left]) / len(left), sum([scaled[i] for i in right]) / len(right)


@functools.lru_cache(maxsize=16)
def _places(names: tuple[str, ...]) -> tuple[list[int], list[int]]:
    """Which values are of the left and of the right side."""
    left = [i for i, name in enumerate(names) if str(name).endswith("left")]
    return left, [i for i, name in enumerate(names) if str(name).endswith("right")]
