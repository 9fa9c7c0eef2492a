"""Optional effects in a simulated drive: on the plant, on its motion and on each channel.

Effects on the motion are part of the plant. What effects add to the readings (`measurement.correction`) is
added to the channels, whose noise stays the same. A delay of a whole sensor shifts its stamps, a late GNSS
velocity is an earlier one.
"""

import dataclasses
from collections.abc import Mapping
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.channels import Gnss, Imu, Wheels
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.effects.catalogue import moves
from terrafusion.twin.effects.sensing import CLOCK_S, IMU, POSITION, VELOCITY
from terrafusion.twin.effects.steered import drive_terms
from terrafusion.twin.model.ground import under_wheels
from terrafusion.twin.model.measurement import corrections, measured
from terrafusion.twin.model.motion import BodyMotion
from terrafusion.twin.model.plant import Plant
from terrafusion.twin.model.vectors import mounting_vector
from terrafusion.twin.model.vehicle import VehicleParams
from terrafusion.twin.physics.layout import OUTPUTS, VEHICLE_PARAMETERS
from terrafusion.twin.scenario.commands import DrivenStates
from terrafusion.twin.sensors.noise import rows_at_rate, sample_rate_hz

C = TypeVar("C", Imu, Gnss)

DEAD_TIME = "dead_time/transport"
FIXES = (*POSITION, *VELOCITY)
CLOCK_DRIFT = "imu_time_offset/drift"  # the delay that grows with time: its value is that after `CLOCK_S`
DELAYS = {
    "imu_time_offset/shift": IMU, CLOCK_DRIFT: IMU, "gnss_latency/both": FIXES,
    "gnss_latency/velocity": VELOCITY,
}  # fmt: skip
"""Delays of the catalogue and the channels that they delay: exactly, where the forms are of first order."""


def without_delays(effects: Mapping[str, float]) -> dict[str, float]:
    """The effects that are no delays."""
    return {key: value for key, value in effects.items() if key not in DELAYS}


def with_effects(
    plant: Plant, effects: Mapping[str, float], drive: Mapping[str, float] | None = None
) -> Plant:
    """The plant with the effects that change its motion and the terms of its drive (`steered.drive_terms`).

    The dead time is applied to the inputs.
    """
    vehicle = plant.vehicle.copy()
    vehicle[VEHICLE_PARAMETERS.index("dead_time_applied_s")] += effects.get(DEAD_TIME, 0.0)
    moving = {key: value for key, value in effects.items() if moves(key)}
    return dataclasses.replace(plant, vehicle=vehicle, effects={**moving, **(drive or {})})


def as_driven(vehicle: VehicleParams, effects: Mapping[str, float]) -> VehicleParams:
    """The vehicle with the dead time among the effects added to its own."""
    late = vehicle.drive.dead_time_s + effects.get(DEAD_TIME, 0.0)
    return dataclasses.replace(vehicle, drive=dataclasses.replace(vehicle.drive, dead_time_s=late))


def true_motion(motion: BodyMotion, driven: DrivenStates, plant: Plant, vehicle: VehicleParams) -> BodyMotion:
    """The motion with the velocity of the body origin under effects that move the centre of gravity."""
    ground = np.tile(plant.route.soil[0], 4)  # the origin's velocity does not depend on it
    mounting = mounting_vector(vehicle)
    y = measured(driven.states, driven.inputs, plant.vehicle, ground, mounting, plant.effects)
    velocity = motion.velocity_body_mps.copy()
    velocity[:, :2] = y[:, [OUTPUTS.index("speed_mps"), OUTPUTS.index("side_speed_mps")]]
    return dataclasses.replace(motion, velocity_body_mps=velocity)


def with_sensor_effects(
    recording: Recording,
    motion: BodyMotion,
    driven: DrivenStates,
    plant: Plant,
    vehicle: VehicleParams,
    effects: Mapping[str, float],
    gnss_latency_s: float = 0.0,
) -> Recording:
    """A simulated recording with what the effects add to its channels and the delays they cause.

    Args:
        recording: as the sensors without effects report the motion.
        motion: of the body (see `true_motion`), at the samples (N,).
        driven: inputs and states at the samples.
        plant: that was driven.
        vehicle: with the nominal sensors.
        effects: all of them, by name.
        gnss_latency_s: stamp less time of validity of the recording's fixes.
    """
    wheels, imu, gnss, motor = recording.wheels, recording.imu, recording.gnss, recording.motor
    if wheels is None or imu is None or gnss is None or motor is None:
        raise ValueError("a simulated recording has all channels")
    rest = without_delays(effects) | drive_terms(vehicle.drive.type)
    imu_t_s: Array = 1e-9 * (imu.t_ns - recording.start_ns).astype(float)
    imu_late_s = effects.get("imu_time_offset/shift", 0.0) + effects.get(CLOCK_DRIFT, 0.0) * imu_t_s / CLOCK_S
    ground = under_wheels(plant.route, plant.vehicle, motion.t_s, driven.states)
    mounting = mounting_vector(vehicle)
    added = corrections(driven.states, driven.inputs, plant.vehicle, ground, mounting, rest)
    columns = dict(zip(OUTPUTS, added.T, strict=True))
    if late_s := effects.get("gnss_latency/velocity", 0.0):
        y = measured(driven.states, driven.inputs, plant.vehicle, ground, mounting, rest)
        for name in VELOCITY:
            now = y[:, OUTPUTS.index(name)]
            columns[name] = columns[name] + np.interp(motion.t_s - late_s, motion.t_s, now) - now
    rows = rows_at_rate(len(motion.t_s), sample_rate_hz(motion.t_s), vehicle.sensors.wheels.rate_hz)
    epochs_s = (gnss.t_ns - recording.start_ns) * 1e-9 - gnss_latency_s
    seen = {name: np.interp(epochs_s, motion.t_s, column) for name, column in columns.items()}
    return dataclasses.replace(
        recording,
        wheels=_wheels(wheels, columns, motion.t_s, rows),
        imu=_stamped(_imu(imu, columns), imu_late_s),
        gnss=_stamped(_gnss(gnss, seen), effects.get("gnss_latency/both", 0.0)),
        motor=dataclasses.replace(motor, current_a=motor.current_a + _sides(columns, "current", "a")[rows]),
    )


def _stamped(channel: C, late_s: float | Array) -> C:
    late_ns = np.round(1e9 * np.asarray(late_s)).astype(np.int64)
    return dataclasses.replace(channel, t_ns=channel.t_ns + late_ns)


def _sides(columns: Mapping[str, Array], name: str, unit: str) -> Array:
    return np.stack([columns[f"{name}_{side}_{unit}"] for side in ("left", "right")], axis=1)


def _means(values: Array) -> Array:
    """Means over the intervals between samples."""
    return 0.5 * (values[1:] + values[:-1])


def _imu(imu: Imu, added: Mapping[str, Array]) -> Imu:
    gyro, accel = imu.gyro_radps.copy(), imu.accel_mps2.copy()
    gyro[:, 2] += _means(added["yaw_rate_radps"])
    accel[:, 0] += _means(added["accel_x_mps2"])
    accel[:, 1] += _means(added["accel_y_mps2"])
    return dataclasses.replace(imu, gyro_radps=gyro, accel_mps2=accel)


def _wheels(wheels: Wheels, added: Mapping[str, Array], t_s: Array, rows: NDArray[np.int64]) -> Wheels:
    """Angles gain the integral of what is added, after counting; speeds stay their differences."""
    rates = np.tile(_sides(added, "wheel", "radps"), 2)
    turned = np.zeros_like(rates)
    turned[1:] = np.cumsum(_means(rates) * np.diff(t_s)[:, None], axis=0)
    turned = turned[rows]
    speed = wheels.speed.copy()
    speed[1:] += np.diff(turned, axis=0) / np.diff(t_s[rows])[:, None]
    angle = None if wheels.angle_rad is None else wheels.angle_rad + turned
    return dataclasses.replace(wheels, speed=speed, angle_rad=angle)


def _gnss(gnss: Gnss, added: Mapping[str, Array]) -> Gnss:
    position, velocity = gnss.enu_m.copy(), gnss.velocity_enu_mps
    for column, axis in enumerate(("east", "north")):
        position[:, column] += added[f"gnss_{axis}_m"]
    if velocity is not None:
        velocity = velocity.copy()
        for column, axis in enumerate(("e", "n")):
            velocity[:, column] += added[f"gnss_v_{axis}_mps"]
    return dataclasses.replace(gnss, enu_m=position, velocity_enu_mps=velocity)
