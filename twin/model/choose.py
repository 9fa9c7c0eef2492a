"""The vehicle of a recording: the one asked for or named by the log, with the log's own geometry."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.datasets.core.files import expanded
from terrafusion.datasets.core.recording import Overrides, Recording
from terrafusion.datasets.core.sensors import STEERED_DRIVES
from terrafusion.twin.model.library import is_named
from terrafusion.twin.model.vehicle import (
    VehicleParams,
    as_vehicle,
    geometry_notes,
    listed_overrides,
    vehicle_names,
    with_overrides,
)

TRACK_OVER_WHEELBASE = 0.6
"""Of cars and carts (assumed), for a steered robot whose track is not known."""


def choose_vehicle(
    recording: Recording, vehicle: str | Path | VehicleParams | None = None
) -> tuple[VehicleParams, tuple[str, ...]]:
    """The vehicle of a recording, with the log's own geometry, and notes on what was assumed.

    Args:
        vehicle: name, YAML file or vehicle; by default the one that the log names, else a generic one.

    Raises:
        DataError: the log names no vehicle that is known, and lacks wheel radius or track.
        ConfigError: an unknown vehicle is asked for, or the log names a file that is not there.
    """
    asked, overrides = vehicle, recording.overrides
    if overrides.drive is None and recording.steering is not None:
        overrides = dataclasses.replace(overrides, drive=recording.steering.drive())
    asked = asked or named_vehicle(recording)
    if asked:
        loaded = as_vehicle(asked)
        if loaded.drive.type in STEERED_DRIVES:
            overrides = dataclasses.replace(overrides, drive=recording.overrides.drive)
        return with_overrides(loaded, overrides), geometry_notes(loaded, overrides)
    name = recording.vehicle
    which = f"unknown vehicle '{name}'" if name else "the log names no vehicle"
    missing = _missing_geometry(recording, overrides)
    if missing:
        raise DataError(
            f"{which}, and the log lacks its {' and '.join(missing)}",
            file=recording.name,
            remedy=f"give {' and '.join(missing)} in meta.yaml or a column map, or --vehicle with one of "
            f"{', '.join(vehicle_names())} or a YAML file: `terrafusion init LOG` writes one",
        )
    steered, wheelbase_m = overrides.drive in STEERED_DRIVES, overrides.wheelbase_m
    track_m = overrides.track_m
    if steered and wheelbase_m is not None and track_m is None:
        track_m = TRACK_OVER_WHEELBASE * wheelbase_m
    chosen = with_overrides(as_vehicle("generic"), dataclasses.replace(overrides, track_m=track_m))
    given = f", with {listed_overrides(overrides)} of the log" if overrides != Overrides() else ""
    track = f"its track of {chosen.odometry.track_m:g} m and " if overrides.track_m is None else ""
    if steered and wheelbase_m is None:
        track = f"its wheelbase of {chosen.body.wheelbase_m:g} m, {track}"
    return chosen, (f"{which}: the generic vehicle is used{given}; assumed are {track}its sensor noise",)


def named_vehicle(recording: Recording) -> str | None:
    """The vehicle that a log names, a name or a file, where it is known.

    Raises:
        ConfigError: the file is not there.
    """
    name = recording.vehicle
    if not name or not is_named("vehicles", name):
        return None
    if name not in vehicle_names() and not expanded(name).exists():
        what = f"the log names the vehicle file '{name}': no such file"
        remedy = "correct the path in its meta.yaml, or give --vehicle FILE"
        raise ConfigError(what, file=recording.name, remedy=remedy)
    return name


def vehicle_of_logs(
    recordings: Sequence[Recording], vehicle: str | Path | VehicleParams | None = None
) -> tuple[str | Path | VehicleParams, tuple[str, ...]]:
    """The vehicle of logs without their own geometry: as asked for, or named by all, or `generic`; notes.

    Raises:
        DataError: they name several, or none that is known and lack wheel radius or track.
        ConfigError: a log names a file that is not there.
    """
    if vehicle is not None:
        return vehicle, ()
    first = named_vehicle(recordings[0])
    for recording in recordings[1:]:
        if (name := named_vehicle(recording)) != first:
            raise DataError(
                f"its vehicle is '{name or 'unknown'}', that of {recordings[0].name} '{first or 'unknown'}'",
                file=recording.name,
                remedy="give logs of one vehicle, or say which by --vehicle",
            )
    return (first, ()) if first is not None else ("generic", choose_vehicle(recordings[0])[1])


def _missing_geometry(recording: Recording, overrides: Overrides) -> list[str]:
    """What a generic vehicle cannot replace: a radius for rad/s; without a gyro track or wheelbase."""
    wheels, imu = recording.wheels, recording.imu
    missing = []
    if wheels is not None and wheels.unit == "radps" and overrides.wheel_radius_m is None:
        missing.append("wheel_radius_m")
    yaw_by_gyro = imu is not None and bool(np.isfinite(imu.gyro_radps[:, 2]).any())
    turns = wheels is None or wheels.has_sides()
    if recording.steering is not None and overrides.drive in STEERED_DRIVES:
        if not yaw_by_gyro and overrides.wheelbase_m is None:
            missing.append("wheelbase_m")
    elif turns and not yaw_by_gyro and overrides.track_m is None:
        missing.append("track_m")
    return missing
