"""From recordings to logs of one twin: geometry, soils, common channels."""

import dataclasses
import hashlib
from collections.abc import Sequence

import numpy as np

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.calibrate.log import PreparedLog, prepare
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.calibrate.observations import Observed
from terrafusion.twin.calibrate.start import Soils, start_model
from terrafusion.twin.model.vehicle import VehicleParams

WINDOW_S = 10.0  # length of a window, at whose start the pose is reset
SAME = 1e-9  # share of a reading by which one that never changes differs: rounding of its means
GENERIC_SOIL = "medium_sand"
"""Stands in where a log names no known soil; the references then set its strength."""


def check_distinct(recordings: Sequence[Recording]) -> None:
    """Refuses a log that is given twice: it would make the scatter from run to run look too small.

    Raises:
        DataError: two recordings have the same content.
    """
    known: dict[bytes, str] = {}
    for recording in recordings:
        content = digest(recording)
        if content in known:
            raise DataError(f"the same log as {known[content]}", file=recording.name, remedy="give each once")
        known[content] = recording.name


def digest(recording: Recording) -> bytes:
    """Hash of the content of all channels."""
    content = hashlib.sha256()
    for name, channel in recording.channels().items():
        content.update(name.encode() + channel.t_ns.tobytes())
        for column in channel.columns().values():
            content.update(column.astype(str).tobytes() if column.dtype == object else column.tobytes())
    return content.digest()


def order_of(recording: Recording) -> tuple[bytes, bytes]:
    """Sorts references by hashes of their wheel speeds, which do not tell when and where a run was made, then
    of all their content."""
    speed = b"" if recording.wheels is None else recording.wheels.speed.tobytes()
    return hashlib.sha256(speed).digest(), digest(recording)


def _is_dead(observed: Observed, log: PreparedLog) -> bool:
    """Whether a gyro, accelerometer or current sensor reads the same all along, though the robot is driven in
    turns: that is no effect of the catalogue, and would be named as the largest of one."""
    sensor = observed.channel.startswith(("yaw_rate", "accel", "current"))
    turning = bool(np.ptp(log.sides[:, 1] - log.sides[:, 0]) > 0.0)
    size = float(np.abs(observed.value).max(initial=0.0))
    return sensor and turning and float(np.ptp(observed.value)) <= SAME * size


def prepared(
    recordings: Sequence[Recording], vehicle: VehicleParams, soils: Soils, source: str = "auto"
) -> tuple[list[PreparedLog], Model, list[str]]:
    """The logs with the channels that all have, the twin before anything is learnt, and notes.

    Raises:
        ConfigError: a named soil is unknown.
        DataError: the logs have different geometries, or no channel in common.
    """
    model, ground, notes = start_model(recordings, vehicle, soils, stand_in=GENERIC_SOIL)
    logs = [prepare(r, model, source=source, window_s=WINDOW_S, ground=ground) for r in recordings]
    for log in logs:
        if dead := {o.channel for o in log.observed if _is_dead(o, log)}:
            notes = [*notes, f"left out, as dead in {log.name}: {', '.join(sorted(dead))}"]
            kept = [tuple(o for o in own.observed if o.channel not in dead) for own in logs]
            logs = [dataclasses.replace(own, observed=o) for own, o in zip(logs, kept, strict=True)]
    channels = [{o.channel: o for o in log.observed} for log in logs]
    shared = [o.channel for o in logs[0].observed if all(o.channel in have for have in channels)]
    if not shared:
        raise DataError("the logs have no channel in common", remedy="diagnose logs of one robot")
    left = [name for name in dict.fromkeys(c for have in channels for c in have) if name not in shared]
    if left:
        lacks = next(r.name for r, have in zip(recordings, channels, strict=True) if left[0] not in have)
        notes = [*notes, f"left out of all logs, as some lack them (such as {lacks}): {', '.join(left)}"]
    in_common = [tuple(have[c] for c in shared) for have in channels]
    logs = [dataclasses.replace(log, observed=o) for log, o in zip(logs, in_common, strict=True)]
    return logs, model, notes
