"""Conventions that a log format leaves open: axes, signs, held values, lags.

A reader returns the numbers of its file; `apply` converts them to the conventions of a `Recording`. Those
of a public data set are in the catalogue, each with its source; every applied one becomes a note.
"""

import dataclasses
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from terrafusion.datasets.core.arrays import Array, Mask
from terrafusion.datasets.core.channels import Channel, Imu, Terrain
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.quantity import Position, Sourced, Word, shown
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import DRIVES, Rig, axes_matrix
from terrafusion.datasets.core.trajectory import Trajectory

Sign = Annotated[float, Sourced("", -1.0, 1.0)]
BODY_AXES = ("+x", "+y", "+z")
LATE_CHANNELS = (*Recording.CHANNELS, "truth")
HELD_CHANNELS = tuple(name for name in LATE_CHANNELS if name != "terrain")
"""Channels that `lag_s` and `held` can name: a ground label holds until the next by definition."""


@dataclass(frozen=True)
class Conventions:
    """Conventions of a log.

    Attributes:
        vehicle: name of the vehicle, "" where the log has it.
        imu_axes: sensor axes that point along body x (forward), y (left), z (up).
        gyro_z_sign: -1 where the yaw rate is positive to the right (after `imu_axes`).
        left_wheels_sign, right_wheels_sign: -1 where that side is negative when driving forward.
        wheel_radius_m, track_m: of the robot; the track is the geometric one.
        drive, wheelbase_m: how the robot turns, and the distance of its axles.
        antenna_m, imu_m: positions in the body frame.
        held: rows for which a channel holds a value, by channel name (`HELD_CHANNELS`); of a run of
            equal rows the first and then every so many rows are true updates.
        lag_s: seconds by which a channel's times are late, by channel name (`LATE_CHANNELS`).
        truth_channels: channels of the truth that can be scored against; () for all.
        terrain: name of the ground of the whole log, "" where unknown.
    """

    vehicle: str = ""
    imu_axes: tuple[str, ...] = BODY_AXES
    gyro_z_sign: Sign = 1.0
    left_wheels_sign: Sign = 1.0
    right_wheels_sign: Sign = 1.0
    wheel_radius_m: Annotated[float, Sourced("m", 0.01, 2.0)] | None = None
    track_m: Annotated[float, Sourced("m", 0.05, 10.0)] | None = None
    drive: Annotated[str, Word(DRIVES)] | None = None
    wheelbase_m: Annotated[float, Sourced("m", 0.05, 10.0)] | None = None
    antenna_m: Position | None = None
    imu_m: Position | None = None
    held: dict[str, Annotated[float, Sourced("rows", 1.0, 1e4)]] = field(default_factory=dict)
    lag_s: dict[str, Annotated[float, Sourced("s", -10.0, 10.0)]] = field(default_factory=dict)
    truth_channels: tuple[str, ...] = ()
    terrain: str = ""

    def __post_init__(self) -> None:
        axes_matrix(self.imu_axes)
        for key, named, known in (("held", self.held, HELD_CHANNELS), ("lag_s", self.lag_s, LATE_CHANNELS)):
            wrong = next((name for name in named if name not in known), None)
            if wrong is not None:
                raise ValueError(f"'{key}' names the channel '{shown(wrong)}'; give {', '.join(known)}")


def apply(recording: Recording, conventions: Conventions) -> Recording:
    """The recording converted, with a note for every convention that changed it."""
    recording = _geometry(recording, conventions)
    recording = _inertial(recording, conventions)
    recording = _wheels(recording, conventions)
    recording = _true_updates(recording, conventions)
    recording = _lags(recording, conventions)
    return _truth_and_terrain(recording, conventions)


def _geometry(recording: Recording, c: Conventions) -> Recording:
    own = {name: getattr(c, name, None) for name in vars(recording.overrides)}
    new = {name: value for name, value in own.items() if value is not None}
    return dataclasses.replace(
        recording,
        vehicle=c.vehicle or recording.vehicle,
        overrides=dataclasses.replace(recording.overrides, **new),
    )


def _inertial(recording: Recording, c: Conventions) -> Recording:
    imu, field = recording.imu, recording.magnetometer
    if field is not None and c.imu_axes != BODY_AXES:
        turned = dataclasses.replace(field, field_t=permuted(axes_matrix(c.imu_axes), field.field_t))
        recording = dataclasses.replace(recording, magnetometer=turned).with_notes(
            "magnetometer: assumed to have the IMU's axes, and turned with it"
        )
    if imu is None:
        return recording
    if c.imu_axes != BODY_AXES:
        R = axes_matrix(c.imu_axes)
        imu = Imu(imu.t_ns, permuted(R, imu.gyro_radps), permuted(R, imu.accel_mps2))
        recording = recording.with_notes(
            f"imu: axes {', '.join(c.imu_axes)} brought to x forward, y left, z up"
        )
    if c.gyro_z_sign < 0:
        imu = dataclasses.replace(imu, gyro_radps=imu.gyro_radps * (1.0, 1.0, -1.0))
        recording = recording.with_notes("imu: yaw rate was positive to the right; its sign is changed")
    return dataclasses.replace(recording, imu=imu)


def turned_as_mounted(recording: Recording, rig: Rig) -> Recording:
    """Channels that are still in the axes of the IMU's frame, in body axes where `rig` has that frame."""
    mounted = rig.sensors.imu
    if not recording.unturned or mounted.frame_id.lstrip("/") != recording.imu_frame_id:
        return recording
    R, changed = mounted.base_from_sensor(), {}
    for name in recording.unturned if mounted.axes != BODY_AXES else ():
        channel = getattr(recording, name)
        changed[name] = dataclasses.replace(
            channel, **{key: permuted(R, value) for key, value in vars(channel).items() if key != "t_ns"}
        )
        recording = recording.with_notes(
            f"{name}: rotated from {mounted.frame_id} to the body: axes {', '.join(mounted.axes)}"
        )
    return dataclasses.replace(recording, **changed, unturned=())


def permuted(R: Array, values: Array) -> Array:
    """R @ v of vectors (N, 3) for a signed permutation R; NaN axes do not affect the others."""
    source = np.abs(R).argmax(axis=1)
    return values[:, source] * R[np.arange(3), source]


def _wheels(recording: Recording, c: Conventions) -> Recording:
    wheels = recording.wheels
    if wheels is None or c.left_wheels_sign == c.right_wheels_sign == 1.0:
        return recording
    if not wheels.has_sides() and c.left_wheels_sign != c.right_wheels_sign:
        raise DataError(
            "has one speed for both sides, but the left and right wheels are to get different signs",
            file=recording.name,
            channel="wheels",
            remedy="give left_wheels_sign and right_wheels_sign alike, or leave both out",
        )
    signs = np.array(
        [c.left_wheels_sign if n.endswith("left") else c.right_wheels_sign for n in wheels.names]
    )
    angle = None if wheels.angle_rad is None else wheels.angle_rad * signs
    turned = dataclasses.replace(wheels, speed=wheels.speed * signs, angle_rad=angle)
    signs_by_side = (("left", c.left_wheels_sign), ("right", c.right_wheels_sign))
    sides = " and ".join(side for side, sign in signs_by_side if sign < 0)
    note = f"wheels: the {sides} side was negative when driving forward; its sign is changed"
    return dataclasses.replace(recording, wheels=turned).with_notes(note)


def _true_updates(recording: Recording, c: Conventions) -> Recording:
    for name, rows in c.held.items():
        channel = getattr(recording, name)
        if channel is None or not len(channel):
            continue
        values = numbers_of(channel)
        keep = true_updates(values, round(rows))
        if keep.all() or not values.shape[1]:
            continue
        note = f"{name}: held values dropped: {int(keep.sum())} true updates of {len(keep)} rows"
        recording = dataclasses.replace(recording, **{name: channel.select(keep)}).with_notes(note)
    return recording


def true_updates(values: Array, rows: int) -> Mask:
    """Mask (N,) of the rows of `values` (N, k) that are updates: changes, and every `rows` rows of a run."""
    same = np.zeros(len(values), dtype=bool)
    same[1:] = ((values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1]))).all(axis=1)
    index = np.arange(len(values))
    since_change = index - np.maximum.accumulate(np.where(same, 0, index))
    return since_change % max(rows, 1) == 0


def numbers_of(channel: Channel | Trajectory) -> Array:
    """The numbers of a channel side by side, (N, k); of a trajectory its poses."""
    if isinstance(channel, Trajectory):
        return (
            channel.position_m
            if channel.quaternion is None
            else np.hstack([channel.position_m, channel.quaternion])
        )
    columns = [v for v in channel.columns().values() if v.dtype.kind == "f"]
    return np.stack(columns, axis=1) if columns else np.zeros((len(channel), 0))


def _lags(recording: Recording, c: Conventions) -> Recording:
    for name, lag_s in c.lag_s.items():
        channel = getattr(recording, name)
        if channel is None or lag_s == 0.0:
            continue
        shifted = dataclasses.replace(channel, t_ns=channel.t_ns - round(lag_s * 1e9))
        note = f"{name}: times are {'late' if lag_s > 0 else 'early'} by {abs(lag_s):g} s; corrected"
        recording = dataclasses.replace(recording, **{name: shifted}).with_notes(note)
    return recording


def _truth_and_terrain(recording: Recording, c: Conventions) -> Recording:
    if c.truth_channels and recording.truth is not None:
        usable = tuple(name for name in recording.truth_channels if name in c.truth_channels)
        lost = [name for name in recording.truth_channels if name not in usable]
        recording = dataclasses.replace(recording, truth_channels=usable)
        if lost:
            recording = recording.with_notes(f"truth: {', '.join(lost)} not good enough to score against")
    if c.terrain and not recording.terrain_name:
        terrain = recording.terrain or Terrain.throughout(recording.start_ns, c.terrain)
        recording = dataclasses.replace(recording, terrain_name=c.terrain, terrain=terrain)
    return recording
