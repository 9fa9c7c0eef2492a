"""From recordings to logs of one twin: geometry, soils, common channels."""

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path

from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.calibrate.log import PreparedLog, grounds, prepare
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.model.soil import SoilParams, load_soil
from terrafusion.twin.model.vehicle import VehicleParams, geometry_notes, reported_geometry, with_overrides

Soils = str | Path | SoilParams | Mapping[str, str | Path | SoilParams] | None

WINDOW_S = 10.0  # length of a window, at whose start the pose is reset
GENERIC_SOIL = "medium_sand"
"""Stands in where a log names no known soil; the references then set its strength."""


def check_distinct(recordings: Sequence[Recording]) -> None:
    """Refuses a log that is given twice: it would make the scatter from run to run look too small.

    Raises:
        DataError: two recordings have the same content.
    """
    known: dict[bytes, str] = {}
    for recording in recordings:
        content = hashlib.sha256()
        for name, channel in recording.channels().items():
            content.update(name.encode() + channel.t_ns.tobytes())
            for column in channel.columns().values():
                content.update(column.astype(str).tobytes() if column.dtype == object else column.tobytes())
        digest = content.digest()
        if digest in known:
            raise DataError(f"the same log as {known[digest]}", file=recording.name, remedy="give each once")
        known[digest] = recording.name


def starting_model(
    recordings: Sequence[Recording], vehicle: VehicleParams, soils: Soils
) -> tuple[Model, str | None, list[str]]:
    """The twin before anything is learnt, the one soil of all logs where one is given, and notes.

    Raises:
        ConfigError: a named soil is unknown.
        DataError: the logs have different geometries.
    """
    overrides = reported_geometry(recordings)
    loaded, notes = with_overrides(vehicle, overrides), list(geometry_notes(vehicle, overrides))
    if soils is not None and not isinstance(soils, Mapping):
        soil = soils if isinstance(soils, SoilParams) else load_soil(soils)
        return Model(loaded, {soil.name: soil}, loaded.effects), soil.name, notes
    given, found = dict(soils or {}), dict[str, SoilParams]()
    for recording in recordings:
        for label in dict.fromkeys(grounds(recording, recording.start_ns)[0]):
            if label in found:
                continue
            try:
                named = given.get(label, label)
                found[label] = named if isinstance(named, SoilParams) else load_soil(named)
            except ConfigError:
                if label in given:
                    raise
                found[label] = load_soil(GENERIC_SOIL)
                notes.append(f"the ground '{label}' is not in the library: {GENERIC_SOIL} stands in")
    return Model(loaded, found, loaded.effects), None, notes


def prepared(
    recordings: Sequence[Recording], model: Model, soil: str | None, source: str
) -> list[PreparedLog]:
    """Logs of the recordings."""
    return [prepare(r, model, source=source, window_s=WINDOW_S, ground=soil) for r in recordings]


def with_common_channels(logs: Sequence[PreparedLog]) -> list[PreparedLog]:
    """The logs with the channels that all of them have.

    Raises:
        DataError: there is none.
    """
    channels = [{o.channel: o for o in log.observed} for log in logs]
    shared = [o.channel for o in logs[0].observed if all(o.channel in have for have in channels)]
    if not shared:
        raise DataError("the logs have no channel in common", remedy="diagnose logs of one robot")
    return [
        dataclasses.replace(log, observed=tuple(have[c] for c in shared))
        for log, have in zip(logs, channels, strict=True)
    ]
