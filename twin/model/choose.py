"""The vehicle of a recording: the one asked for or named by the log, with the log's own geometry."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Overrides, Recording
from terrafusion.twin.model.library import is_named
from terrafusion.twin.model.vehicle import (
    VehicleParams,
    as_vehicle,
    geometry_notes,
    listed_overrides,
    vehicle_names,
    with_overrides,
)


def choose_vehicle(
    recording: Recording, vehicle: str | Path | VehicleParams | None = None
) -> tuple[VehicleParams, tuple[str, ...]]:
    """The vehicle of a recording, with the log's own geometry, and notes on what was assumed.

    Args:
        vehicle: name, YAML file or vehicle; by default the one that the log names, else a generic one.

    Raises:
        DataError: the log names no vehicle that is known, and lacks wheel radius or track.
        ConfigError: an unknown vehicle is asked for.
    """
    asked, overrides = vehicle, recording.overrides
    if not asked and recording.vehicle and is_named("vehicles", recording.vehicle):
        asked = recording.vehicle
    if asked:
        loaded = as_vehicle(asked)
        return with_overrides(loaded, overrides), geometry_notes(loaded, overrides)
    name = recording.vehicle
    which = f"unknown vehicle '{name}'" if name else "the log names no vehicle"
    missing = _missing_geometry(recording)
    if missing:
        raise DataError(
            f"{which}, and the log lacks its {' and '.join(missing)}",
            file=recording.name,
            remedy=f"give {' and '.join(missing)} in meta.yaml, or --vehicle with a YAML file or one of "
            + ", ".join(vehicle_names()),
        )
    chosen = with_overrides(as_vehicle("generic"), overrides)
    given = f", with {listed_overrides(overrides)} of the log" if overrides != Overrides() else ""
    track = f"its track of {chosen.odometry.track_m:g} m and " if overrides.track_m is None else ""
    return chosen, (f"{which}: the generic vehicle is used{given}; assumed are {track}its sensor noise",)


def _missing_geometry(recording: Recording) -> list[str]:
    """What a generic vehicle cannot replace: a radius for rad/s, a track where no gyro shows the yaw."""
    wheels, imu, overrides = recording.wheels, recording.imu, recording.overrides
    missing = []
    if wheels is not None and wheels.unit == "radps" and overrides.wheel_radius_m is None:
        missing.append("wheel_radius_m")
    yaw_by_gyro = imu is not None and bool(np.isfinite(imu.gyro_radps[:, 2]).any())
    turns = wheels is None or wheels.has_sides()
    if turns and not yaw_by_gyro and overrides.track_m is None:
        missing.append("track_m")
    return missing
