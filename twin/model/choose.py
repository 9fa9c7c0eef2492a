"""The vehicle of a recording: the one asked for or named by the log, with the log's own geometry."""

from __future__ import annotations

from pathlib import Path

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.model.vehicle import VehicleParams, as_vehicle, geometry_notes, with_overrides


def choose_vehicle(
    recording: Recording, vehicle: str | Path | VehicleParams | None = None
) -> tuple[VehicleParams, tuple[str, ...]]:
    """The vehicle of a recording, with the log's own geometry, and notes on what was assumed.

    Args:
        vehicle: name, YAML file or vehicle; by default the one that the log names, else a generic one.

    Raises:
        DataError: no vehicle is named and the log lacks wheel radius or track.
        ConfigError: an unknown vehicle name.
    """
    asked, overrides = vehicle or recording.vehicle, recording.overrides
    loaded = as_vehicle(asked or "generic")
    notes = geometry_notes(loaded, overrides)
    if asked:
        return with_overrides(loaded, overrides), notes
    wheels = recording.wheels
    needs_radius = wheels is not None and wheels.unit == "radps"
    if overrides.track_m is None or (needs_radius and overrides.wheel_radius_m is None):
        raise DataError(
            "the log names no vehicle and not its geometry",
            remedy="give --vehicle NAME, or wheel_radius_m and track_m in meta.yaml",
        )
    notes += ("no vehicle is named: a generic one is used, with its assumed sensor noise",)
    return with_overrides(loaded, overrides), notes
