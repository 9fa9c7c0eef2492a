"""Segments of a long recording as separate runs.

Field logs are often one long run, while the diagnosis compares several: `LOG@60-105` is the segment from 60
to 105 s after the log's start, `LOG@/45` are all consecutive segments of 45 s.
"""

import dataclasses
import itertools
import re
from collections.abc import Callable
from typing import Any

import numpy as np

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording

LEAST_S = 5.0
"""Shortest segment; a shorter remainder at the end is dropped."""
_CUT = re.compile(r"^(?P<log>.+)@(?:/(?P<every>[\d.]+)|(?P<begin>[\d.]+)-(?P<end>[\d.]+))$")


Cut = Callable[[Recording], list[Recording]]
"""Gives the selected parts of a log; a DataError where there is none."""


def split_name(text: str) -> tuple[str, Cut]:
    """Split `LOG`, `LOG@60-105` or `LOG@/45` into the log and what cuts it; the first is left whole.

    Raises:
        DataError: no number, or a segment shorter than `LEAST_S`.
    """
    found = _CUT.match(text)
    if found is None:
        return text, lambda recording: [recording]
    try:
        numbers = {k: float(v) for k, v in found.groupdict().items() if k != "log" and v is not None}
    except ValueError:
        raise DataError(f"'{text}' has no number behind @", remedy="write LOG@60-105 or LOG@/45") from None
    length_s = numbers.get("every", numbers.get("end", 0.0) - numbers.get("begin", 0.0))
    if length_s < LEAST_S:
        raise DataError(f"'{text}' is {length_s:g} s long", remedy=f"give at least {LEAST_S:g} s")
    if "every" in numbers:
        return found["log"], lambda recording: segments_of(recording, length_s)
    return found["log"], lambda recording: [segment(recording, numbers["begin"], numbers["end"])]


def segment(recording: Recording, begin_s: float, end_s: float) -> Recording:
    """The recording from `begin_s` to `end_s` after its start, with the ground label valid at its start.

    Raises:
        DataError: nothing was recorded then.
    """
    start, end = (recording.start_ns + round(t * 1e9) for t in (begin_s, end_s))
    parts = {name: channel.between(start, end) for name, channel in recording.channels().items()}
    terrain = recording.terrain
    if terrain is not None and len(terrain):
        first = max(0, int(np.searchsorted(terrain.t_ns, start, side="right")) - 1)
        labels = terrain.select(slice(first, int(np.searchsorted(terrain.t_ns, end))))
        parts["terrain"] = dataclasses.replace(labels, t_ns=np.maximum(labels.t_ns, start))
    present: dict[str, Any] = {name: channel if len(channel) else None for name, channel in parts.items()}
    if not any(channel is not None for name, channel in present.items() if name != "terrain"):
        raise DataError(
            f"nothing was recorded from {begin_s:g} to {end_s:g} s",
            file=recording.name, remedy=f"the log lasts {recording.duration_s():.0f} s",
        )  # fmt: skip
    truth = recording.truth
    if truth is not None:
        truth = truth.between(start, end) or None
    jumps = tuple(j for j in recording.clock_jumps if start <= j.t_ns < end)
    name = f"{recording.name}@{begin_s:g}-{end_s:g}"
    return dataclasses.replace(
        recording, name=name, start_ns=start, truth=truth, clock_jumps=jumps, **present
    )  # fmt: skip


def segments_of(recording: Recording, length_s: float) -> list[Recording]:
    """All segments of `length_s` seconds (see `segment_spans`).

    Raises:
        DataError: the log is shorter than `LEAST_S`.
    """
    return [segment(recording, begin, end) for begin, end in segment_spans(recording, length_s)]


def segment_spans(recording: Recording, length_s: float) -> list[tuple[float, float]]:
    """Begin and end of all segments in seconds from the log's start.

    They cover the time from the first wheel or command sample (the inputs of the twin) to the end of the
    log; the last may be shorter.

    Raises:
        DataError: the log is shorter than `LEAST_S`.
    """
    inputs = [c for c in (recording.command, recording.wheels) if c is not None and len(c)]
    first_ns = min((int(c.t_ns[0]) for c in inputs), default=recording.start_ns)
    begin_s, end_s = max(0.0, (first_ns - recording.start_ns) * 1e-9), recording.duration_s()
    edges = [*np.arange(begin_s, end_s, length_s).tolist(), end_s]
    found = [(round(a, 2), round(b, 2)) for a, b in itertools.pairwise(edges) if b - a >= LEAST_S]
    if not found:
        raise DataError(
            f"lasts {end_s - begin_s:.1f} s: too short for a segment", file=recording.name,
            remedy=f"give a log of at least {LEAST_S:g} s",
        )  # fmt: skip
    return found
