"""Rows of terrafusion's replay, as a user runs it: public API, defaults."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.api.replays import replay
from terrafusion.fusion.estimate.estimate import Estimate
from terrafusion.fusion.estimator.feed import split_fixes
from terrafusion.fusion.metrics.scores import Outage, Scores, score
from terrafusion.twin.model.vehicle import VehicleParams
from tests.studies.opponents.drives import vehicle_of
from tests.studies.opponents.protocol import Row, Streams

ELLIPSE_95 = 5.991
"""95 % point of chi-square with two degrees of freedom."""


@dataclass(frozen=True)
class Replayed(Row):
    """An outage of a replay: the share of its errors inside their 95 % ellipses, None where not known."""

    share_inside: float | None = None


def rows(
    recording: Recording,
    streams: Streams,
    seconds: float,
    mode: str,
    vehicle: VehicleParams | str | None = None,
    original: Recording | None = None,
) -> tuple[list[Replayed], list[str]]:
    """Rows of all outages of a length, and errors; a replay that fails has the whole distance as error.

    With `original` the estimate of a changed recording is scored against what that one holds.
    """
    out, failures = [], []
    for starts in streams.passes(seconds):
        outages = [Outage(round(a, 3), seconds) for a in starts]
        try:
            result = replay(recording, vehicle=vehicle, mode=mode, outages=outages)
        except TerrafusionError as error:
            failures.append(str(error))
            out += [Replayed(a, d, d) for a in starts for d in [streams.driven_m(a, seconds)]]
            continue
        scores = result.scores if original is None else _scores(result.estimate, original, outages)
        for a, outage, found in zip(starts, outages, scores.outages, strict=True):
            driven = streams.driven_m(a, seconds)
            end_m = driven if found.end_error_m is None else found.end_error_m
            out.append(Replayed(a, end_m, driven, _inside(scores, outage, recording.start_ns)))
    return out, failures


def _scores(estimate: Estimate, recording: Recording, outages: Sequence[Outage]) -> Scores:
    """Against the truth of a recording, else the fixes in its outages, with the antenna of its vehicle."""
    _, held_out = split_fixes(recording, outages)
    antenna = vehicle_of(recording, None).rig().sensors.gnss.antenna_m
    return score(estimate, recording, held_out=held_out, outages=outages, antenna_m=antenna)


def _inside(scores: Scores, outage: Outage, start_ns: int) -> float | None:
    """Share of the errors in an outage that lie in their 95 % ellipses."""
    errors = scores.errors
    if errors is None:
        return None
    nees = errors.nees()[outage.covers(errors.t_ns, start_ns)]
    nees = nees[np.isfinite(nees)]
    return float(np.mean(2.0 * nees <= ELLIPSE_95)) if len(nees) else None
