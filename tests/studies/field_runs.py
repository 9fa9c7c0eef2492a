"""Field logs as the runs that studies use: whole ones, and those joined from consecutive windows."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from typing import TypeVar

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers import open_recordings
from terrafusion.fusion.benchmark.field_logs import CUT, Refusal, attempted, present_recordings
from tests.studies.joined_windows import joined_runs

WHOLE = "raw"
"""Windows cut from a run that the catalogue also has as a whole are left out."""
MIN_RUN_S = 10.0
"""Shorter recordings are windows cut from a run: consecutive ones are joined."""
MIN_JOINED_S = 25.0
"""Shorter joined runs are left out: no outage fits into them."""
Result = TypeVar("Result")


def catalogued() -> list[str]:
    """Recordings of the catalogue whose files are all present, without windows cut from another of them."""
    names = present_recordings()
    cut = {f"{name.removesuffix(WHOLE)}{CUT}" for name in names if name.endswith(f"/{WHOLE}")}
    return [name for name in names if name not in cut]


def each_run(
    log: str, run: Callable[[str, int, Recording], Iterable[Result | Refusal]]
) -> list[Result | Refusal]:
    """Results of `run(name, number, recording)` for every run of a log; an error becomes a `Refusal`."""
    out: list[Result | Refusal] = []
    found = attempted(log, lambda: [read_runs(log)])
    for one in found:
        if isinstance(one, Refusal):
            return [one]
        recordings, joined = one
        for i, recording in enumerate(recordings):
            name = log if joined or len(recordings) == 1 else f"{log}#{i}"
            out += attempted(name, functools.partial(run, name, i, recording))
    return out


@functools.lru_cache(maxsize=1)
def read_runs(log: str) -> tuple[list[Recording], bool]:
    """The runs of a log, and whether they were joined from windows; cached for consecutive modes."""
    recordings = open_recordings(log)
    if len(recordings) == 1 or max(r.duration_s() for r in recordings) >= MIN_RUN_S:
        return recordings, False
    joined = [run for run in joined_runs(log, recordings) if run.duration_s() >= MIN_JOINED_S]
    runs = [run for run in joined if run.truth is not None]
    if not runs:
        raise DataError(
            f"holds {len(recordings)} windows that form no run of {MIN_JOINED_S:g} s with a truth",
            remedy="give a log of one run",
        )
    return runs, True
