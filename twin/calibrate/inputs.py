"""Input of the twin for a log: its commands within the robot's limits, or its measured wheel speeds."""

from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.datasets.core.printable import counted
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.calibrate.observations import sample_interval_s
from terrafusion.twin.model.vehicle import VehicleParams
from terrafusion.twin.scenario.commands import limit_slew, side_speeds

SOURCES = ("auto", "command", "wheels")
"""What drives the twin: the log's commands or its wheel speeds; "auto" takes commands where there are any."""
DT_S = 0.01
"""Sample interval of the twin's runs."""
MOVING_RADPS = 0.3
"""A log that starts with faster wheels starts on the move."""
STEP, ALONE = 4.0, 0.2
"""Commands that change this many times faster than the robot may accelerate are steps; so are those that
before and after change by less than this share of it."""
LONGEST_GAP_S = 0.5
"""Measurements within a longer gap of the input are not used."""


def check_source(source: str) -> None:
    """Raise a ConfigError for what is none of `SOURCES`."""
    if source not in SOURCES:
        raise ConfigError(f"unknown input '{source}'", remedy=f"give one of {', '.join(SOURCES)}")


@dataclass(frozen=True, eq=False)
class Commanded:
    """Twists (N + 1, 2) commanded every `DT_S`, before the limits, and the one (2,) to start from."""

    twist: Array
    start: Array

    def sides(self, vehicle: VehicleParams) -> Array:
        """Wheel speeds (N + 1, 2) within the vehicle's limits, rad/s."""
        return side_speeds(limit_slew(self.twist, DT_S, vehicle, self.start), vehicle)


@dataclass(frozen=True, eq=False)
class TwinInput:
    """The twin's input.

    Attributes:
        start_ns: time of the first sample.
        sides: (N + 1, 2) wheel speeds of left and right, rad/s, every `DT_S`, before any dead time.
        commanded: what they follow from; None for measured speeds, which the wheels follow.
        gaps: (G, 2) stretches without input, s.
        notes: what was assumed.
        step_s: time between two commands; 0 for measured speeds.
    """

    start_ns: int
    sides: Array
    commanded: Commanded | None
    gaps: Array
    notes: tuple[str, ...]
    step_s: float = 0.0

    def end_s(self) -> float:
        """Time of the last sample, s."""
        return (len(self.sides) - 1) * DT_S


def twin_input(recording: Recording, vehicle: VehicleParams, source: str) -> TwinInput:
    """The input from one of `SOURCES`; a DataError where the log lacks it, or its vehicle steers."""
    if vehicle.steered() is not None:
        raise DataError(
            f"drive type {vehicle.drive.type}: the twin is held against logs of robots without steering only",
            file=recording.name,
            remedy="give a log of a differential, skid_steer or tracked robot",
        )
    command, wheels = recording.command, recording.wheels
    if source != "wheels" and command is not None and len(command) > 1:
        return _commands(recording, vehicle)
    if source == "command":
        raise DataError(
            "the log has no commands", file=recording.name, channel="command", remedy="use --input wheels"
        )
    if wheels is None or len(wheels) < 3:
        raise DataError(
            "the log has neither commands nor wheel speeds: the twin has no input",
            file=recording.name,
            remedy="give a log with a command or a wheels channel",
        )
    return _measured(recording, vehicle)


def _measured(recording: Recording, vehicle: VehicleParams) -> TwinInput:
    wheels = recording.wheels
    assert wheels is not None
    notes = [
        "driven by the measured wheel speeds, which the twin's wheels follow through a stiff speed loop: "
        "motors, speed loop and delays cannot be identified from this log"
    ]
    if not wheels.has_sides():
        notes.append("the log has one wheel speed for both sides: the twin drives straight ahead")
    known = np.isfinite(wheels.speed).all(axis=1)
    start, radius = int(wheels.t_ns[0]), vehicle.odometry.wheel_radius_m
    t_s: Array = (wheels.t_ns[known] - start).astype(float) * 1e-9
    measured = wheels.side_speeds_mps(radius)[known] / radius
    # A speed is the mean since the sample before: it holds half an interval earlier.
    centre = t_s - 0.5 * min(sample_interval_s(t_s), 0.1)
    grid = DT_S * np.arange(round(float(t_s[-1]) / DT_S) + 1)
    sides = np.stack([np.interp(grid, centre, side) for side in measured.T], axis=1)
    return TwinInput(start, sides, None, _gaps(t_s), tuple(notes))


def _commands(recording: Recording, vehicle: VehicleParams) -> TwinInput:
    """Commanded twists within the vehicle's own limits.

    Between two commands the twist is a cubic; a sudden change is a step.
    """
    command = recording.command
    assert command is not None
    twist = np.stack([command.v_mps, command.yaw_rate_radps], axis=1)
    known = np.isfinite(twist).all(axis=1)
    if known.sum() < 2:
        raise DataError(
            "the commands are not numbers", file=recording.name, channel="command",
            remedy="repair them or use --input wheels",
        )  # fmt: skip
    twist, stamps = twist[known], command.t_ns[known]
    start = int(stamps[0])
    t_s: Array = (stamps - start).astype(float) * 1e-9
    ends = [int(channel.t_ns[-1]) for channel in recording.channels().values() if len(channel)]
    after_ns = max(ends) - int(stamps[-1])
    if after_ns > 86_400 * 10**9:
        raise DataError(
            f"the log goes on for {after_ns * 1e-9:.0f} s after its last command: its clocks differ",
            file=recording.name, channel="command", remedy="try --stamps receipt",
        )  # fmt: skip
    count = round((max(ends) - start) * 1e-9 / DT_S) + 1
    grid: Array = DT_S * np.arange(float(count))
    limits = np.array([vehicle.drive.max_accel_mps2, vehicle.drive.max_yaw_accel_radps2])
    wanted = np.stack([_between(t_s, twist[:, i], grid, limits[i]) for i in range(2)], axis=1)
    commanded = Commanded(wanted, np.zeros(2) if _rests(recording, vehicle) else wanted[0])
    # Rare commands hold until the next one.
    interval_s = sample_interval_s(t_s)
    rare = interval_s > 0.5 * LONGEST_GAP_S
    gaps = np.zeros((0, 2)) if rare else _gaps(t_s)
    notes = [
        f"the commands have {counted(len(gaps), 'gap')} of up to {np.diff(gaps).max():.1f} s, in which "
        "nothing is compared and the last command is held"
    ] if len(gaps) else []  # fmt: skip
    if rare:
        notes.append(
            f"the commands are {interval_s:.2g} s apart, and each is taken to hold until the next: if the "
            "robot was commanded more often, give a log with all commands, or --input wheels"
        )
    step_s = min(interval_s, LONGEST_GAP_S)
    return TwinInput(start, commanded.sides(vehicle), commanded, gaps, tuple(notes), step_s)


def _gaps(t_s: Array) -> Array:
    """Intervals (G, 2) without samples that are longer than `LONGEST_GAP_S`."""
    far = np.flatnonzero(np.diff(t_s) > LONGEST_GAP_S)
    return np.stack([t_s[far], t_s[far + 1]], axis=1)


def _between(t_s: Array, wanted: Array, grid: Array, limit: float) -> Array:
    """Commands (n,) at times (n,) interpolated on the grid (N,): cubic, except at steps."""
    before = np.clip(np.searchsorted(t_s, grid + 1e-6, side="right") - 1, 0, len(t_s) - 1)
    out = wanted[before]
    apart = np.append(np.diff(t_s), np.inf)
    change = np.abs(np.diff(wanted))
    beside = np.maximum(np.append(0.0, change[:-1]), np.append(change[1:], 0.0))
    follows = np.append((change <= STEP * limit * np.diff(t_s)) & (ALONE * change <= beside), False)
    # A slope at a sample is the central difference where both neighbours are reached smoothly.
    slopes = np.where(follows, np.diff(wanted, append=wanted[-1]) / apart, 0.0)
    both = follows & np.append(False, follows[:-1])
    middle = np.where(
        both, 0.5 * (slopes + np.roll(slopes, 1)), np.where(follows, slopes, np.roll(slopes, 1))
    )
    smooth = follows[before] & (apart[before] < LONGEST_GAP_S)
    if smooth.any():
        k = before[smooth]
        h, s = apart[k], (grid[smooth] - t_s[k]) / apart[k]
        # Cubic by values and slopes at both ends (Hermite's basis).
        out[smooth] = (1.0 + 2.0 * s) * (1.0 - s) ** 2 * wanted[k] + s * s * (3.0 - 2.0 * s) * wanted[k + 1]
        out[smooth] += h * s * (1.0 - s) * ((1.0 - s) * middle[k] - s * middle[k + 1])
    return out


def _rests(recording: Recording, vehicle: VehicleParams) -> bool:
    """Whether the robot stands at the start, by its wheel speeds."""
    wheels = recording.wheels
    if wheels is None or len(wheels) < 2:
        return True
    radius = vehicle.odometry.wheel_radius_m
    return bool(np.nanmax(np.abs(wheels.side_speeds_mps(radius)[:3]), initial=0.0) < MOVING_RADPS * radius)
