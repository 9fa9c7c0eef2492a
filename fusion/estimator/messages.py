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
        if message.fix and np.isfinite(message.enu_m[:2].sum() + message.sigma_enu_m[:2].sum()):
            m = message
            estimator.add_gnss(m.t_ns, m.enu_m, m.sigma_enu_m, m.velocity_enu_mps, m.sigma_v_mps, m.fix)
    elif isinstance(message, CommandSample):
        if np.isfinite(message.v_mps):
            estimator.add_command(message.t_ns, message.v_mps)
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
    needed = message.gyro_radps[2]
    if kind == "six_axis":
        needed = sum(message.gyro_radps.tolist()) + sum(message.accel_mps2.tolist())
    if kind != "none" and math.isfinite(needed):
        estimator.add_imu(*message)


def _steering(estimator: Inlets, message: SteeringSample) -> None:
    rig = estimator.config.rig
    if rig.steering is not None and np.isfinite(message.angle_rad).all():
        front, rear = axles(message.angle_rad[None], message.names, front_ratio(rig))[0].tolist()
        estimator.add_steering(message.t_ns, front, rear)


def _wheels(estimator: Inlets, message: WheelSample) -> None:
    radius_m = estimator.config.rig.wheel_radius_m
    left, right = _sides(message.speed, 1.0 if message.unit == "mps" else radius_m, message.names)
    if not math.isfinite(left + right):
        return
    travel: tuple[float | None, float | None] = (None, None)
    if message.angle_rad is not None:
        turned = _sides(message.angle_rad, radius_m, message.names)
        travel = turned if math.isfinite(turned[0] + turned[1]) else travel
    estimator.add_wheels(message.t_ns, left, right, *travel)


def _sides(values: Array, factor: float, names: tuple[str, ...]) -> tuple[float, float]:
    """Left and right, times a factor: what `channels.sides` gives, for one sample at a time."""
    scaled = [factor * value for value in values.tolist()]
    if len(scaled) == 1:
        return scaled[0], scaled[0]
    left, right = _places(names)
    return sum([scaled[i] for i in left]) / len(left), sum([scaled[i] for i in right]) / len(right)


@functools.lru_cache(maxsize=16)
def _places(names: tuple[str, ...]) -> tuple[list[int], list[int]]:
    """Which values are of the left and of the right side."""
    left = [i for i, name in enumerate(names) if name.endswith("left")]
    return left, [i for i, name in enumerate(names) if name.endswith("right")]
