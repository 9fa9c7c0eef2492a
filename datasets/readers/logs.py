"""Logs as the functions of the library take them: opened, or a path to open."""

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from terrafusion.datasets.core.conventions import turned_as_mounted
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import Rig
from terrafusion.datasets.readers.open import open_recording

Log = Recording | str | Path


def opened(logs: Log | Sequence[Log], rig: Rig | None = None) -> list[Recording]:
    """Recordings of one log or several, with the sensors turned as the vehicle has them mounted.

    Args:
        logs: recordings, or paths or catalogue names of logs that hold one.
        rig: the vehicle's; None: as each log says.

    Raises:
        DataError: what is given is no log, or a log cannot be read.
    """
    several = logs if isinstance(logs, Iterable) and not isinstance(logs, str) else [logs]
    found = []
    for log in several:
        if not isinstance(log, (Recording, str, Path)):
            remedy = "give a Recording, or the path or name of a log"
            raise DataError(f"a {type(log).__name__} is no log", remedy=remedy)
        if isinstance(log, Recording):
            log = _without_empty(log)
            found.append(log if rig is None else turned_as_mounted(log, rig))
        else:
            found.append(open_recording(log, rig=rig))
    return found


def _without_empty(log: Recording) -> Recording:
    """The recording with channels that hold no sample absent, as readers leave them out."""
    channels = {name: getattr(log, name) for name in (*log.CHANNELS, "truth")}
    empty: dict[str, Any] = {
        name: None for name, channel in channels.items() if channel is not None and not len(channel)
    }
    return dataclasses.replace(log, **empty) if empty else log
