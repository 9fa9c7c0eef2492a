"""Messages of a recording or a driver into an estimator."""

from __future__ import annotations

import functools
import math
from typing import Protocol

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
from terrafusion.fusion.inputs.validation import as_number, as_numbers
from terrafusion.fusion.terrain.external import TRUE_SOURCES, known_probabilities


class Inlets(Protocol):
    """The methods of an estimator that take samples."""

    config: EstimatorConfig

    def add_imu(self, t_ns: int, gyro_radps: ArrayLike, accel_mps2: ArrayLike) -> None: ...
    def add_wheels(
        self, t_ns: int, left_mps: float, right_mps: float, left_m: float | None, right_m: float | None
    ) -> None: ...
    def add_gnss(
        self,
        t_ns: int,
        enu_m: ArrayLike,
        sigma_m: ArrayLike | None,
        velocity_mps: ArrayLike | None,
        sigma_v_mps: float,
        fix: int,
    ) -> None: ...
    def add_terrain(self, t_ns: int, probabilities: dict[str, float]) -> None: ...
    def add_command(self, t_ns: int, v_mps: float) -> None: ...
    def add_steering(self, t_ns: int, front_rad: float, rear_rad: float) -> None: ...
    def add_pressure(self, t_ns: int, pressure_pa: float) -> None: ...


def add_message(estimator: Inlets, message: Message) -> None:
    """Gives a message to the method of its channel; what cannot be used is left out.

    Left out are rows with missing values that the graph needs, fixes of class "none", ground labels that a
    person or the simulation gave, motor currents, and the magnetometer (use `add_magnetic_field`).

    Raises:
        DataError: it is no message.
    """
    if isinstance(message, ImuSample):
        _imu(estimator, message)
    elif isinstance(message, WheelSample):
        _wheels(estimator, message)
    elif isinstance(message, GnssSample):
        _gnss(estimator, message)
    elif isinstance(message, CommandSample):
        if math.isfinite(v_mps := as_number(message.v_mps, "speed", "command")):
            estimator.add_command(message.t_ns, v_mps)
    elif isinstance(message, SteeringSample):
        _steering(estimator, message)
    elif isinstance(message, BarometerSample):
        estimator.add_pressure(message.t_ns, message.pressure_pa)
    elif isinstance(message, TerrainSample):
        if message.probabilities is not None and message.source not in TRUE_SOURCES:
            named = known_probabilities(message.probabilities, estimator.config.policy.names())
            if named is not None:
                estimator.add_terrain(message.t_ns, named)
    elif not isinstance(message, tuple):
        raise DataError(
            f"a {type(message).__name__} is no message",
            remedy="give what Recording.messages() yields, or call add_imu, add_wheels, add_gnss",
        )


def _imu(estimator: Inlets, message: ImuSample) -> None:
    kind = estimator.config.inputs.imu
    gyro = _vector(message.gyro_radps, 3, "gyro", "imu")
    accel = _vector(message.accel_mps2, 3, "accel", "imu")
    needed = sum(gyro.tolist()) + sum(accel.tolist()) if kind == "six_axis" else gyro[2]
    if kind != "none" and math.isfinite(needed):
        estimator.add_imu(message.t_ns, gyro, accel)


def _gnss(estimator: Inlets, message: GnssSample) -> None:
    m = message
    if m.fix:
        enu = _vector(m.enu_m, 3, "position", "gnss")
        sigma = _vector(m.sigma_enu_m, 3, "sigma", "gnss")
        if math.isfinite(enu[0] + enu[1] + sigma[0] + sigma[1]):
            estimator.add_gnss(m.t_ns, enu, sigma, m.velocity_enu_mps, m.sigma_v_mps, m.fix)


def _steering(estimator: Inlets, message: SteeringSample) -> None:
    rig = estimator.config.rig
    if rig.steering is None:
        return
    angle = _vector(message.angle_rad, len(message.names), "steering angle", "steering")
    if np.isfinite(angle).all():
        front, rear = axles(angle[None], message.names, front_ratio(rig))[0].tolist()
        estimator.add_steering(message.t_ns, front, rear)


def _wheels(estimator: Inlets, message: WheelSample) -> None:
    radius_m, names = estimator.config.rig.wheel_radius_m, message.names
    speed = _vector(message.speed, len(names), "wheel speed", "wheels")
    left, right = _sides(speed, 1.0 if message.unit == "mps" else radius_m, names)
    if not math.isfinite(left + right):
        return
    travel: tuple[float | None, float | None] = (None, None)
    if message.angle_rad is not None:
        turned = _sides(_vector(message.angle_rad, len(names), "wheel angle", "wheels"), radius_m, names)
        travel = turned if math.isfinite(turned[0] + turned[1]) else travel
    estimator.add_wheels(message.t_ns, left, right, *travel)


def _vector(values: ArrayLike | None, count: int, what: str, channel: str) -> Array:
    """Values (count,) of a message as floats."""
    vector = as_numbers(values, what, channel)
    if vector.shape != (count,):
        raise DataError(
            f"{what} has the shape {vector.shape}", channel=channel, remedy=f"give {count} numbers"
        )
    return vector


def _sides(values: Array, factor: float, names: tuple[str, ...]) -> tuple[float, float]:
    """Left and right, times a factor: what `channels.sides` gives, for one sample at a time."""
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
