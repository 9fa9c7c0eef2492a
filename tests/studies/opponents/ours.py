"""Rows of terrafusion's replay, as a user runs it: public API, defaults."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.api.replays import replay
from terrafusion.fusion.metrics.scores import Outage, Scores
from terrafusion.twin.model.vehicle import VehicleParams
from tests.studies.opponents.protocol import Row, Streams

ELLIPSE_95 = 5.991
"""95 % point of chi-square with two degrees of freedom."""


@dataclass(frozen=True)
class Replayed(Row):
    """An outage of a replay: whether its end error lies in the 95 % ellipse, None where that is not known."""

    inside: bool | None = None


def rows(
    recording: Recording,
    streams: Streams,
    seconds: float,
    mode: str,
    vehicle: VehicleParams | str | None = None,
) -> tuple[list[Replayed], list[str]]:
    """Rows of all outages of a length, and errors; a replay that fails has the whole distance as error."""
    out, failures = [], []
    for starts in streams.passes(seconds):
        outages = [Outage(round(a, 3), seconds) for a in starts]
        try:
            scores = replay(recording, vehicle=vehicle, mode=mode, outages=outages).scores
        except TerrafusionError as error:
            failures.append(str(error))
            out += [Replayed(a, d, d) for a in starts for d in [streams.driven_m(a, seconds)]]
            continue
        for a, outage, found in zip(starts, outages, scores.outages, strict=True):
            driven = streams.driven_m(a, seconds)
            end_m = driven if found.end_error_m is None else found.end_error_m
            out.append(Replayed(a, end_m, driven, _inside(scores, outage, recording.start_ns)))
    return out, failures


def _inside(scores: Scores, outage: Outage, start_ns: int) -> bool | None:
    """Whether the last error in an outage lies in its 95 % ellipse."""
    errors = scores.errors
    if errors is None:
        return None
    nees = errors.nees()
    known = np.flatnonzero(outage.covers(errors.t_ns, start_ns) & np.isfinite(nees))
    return bool(2.0 * nees[known[-1]] <= ELLIPSE_95) if len(known) else None
