"""Logs as the public functions take them: opened, or a path to open."""

from collections.abc import Sequence
from pathlib import Path

from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import Rig
from terrafusion.datasets.readers import open_recording

Log = Recording | str | Path


def opened(logs: Log | Sequence[Log], rig: Rig | None = None) -> list[Recording]:
    """Recordings of one log or several; paths are opened as the vehicle's sensors are mounted."""
    several = [logs] if isinstance(logs, (Recording, str, Path)) else logs
    return [log if isinstance(log, Recording) else open_recording(log, rig=rig) for log in several]
