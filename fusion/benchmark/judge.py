"""The estimator as judge of a log: how far it is off, and how well its measurements agree with it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from statistics import fmean

from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.replay import replay

ERROR = "distance from fixes held out, m (median)"
NIS = "squared innovation of {}, a degree of freedom"


def estimator_judge(vehicle: str) -> Callable[[Recording], dict[str, float]]:
    """A function that replays a log and gives marks; the reference pose of the log is not used.

    Args:
        vehicle: name or YAML file, as `terrafusion replay` takes it.

    The error is that against every fifth fix, which the estimator is not given; a log without GNSS has none.
    A squared innovation (NIS) of one a degree of freedom is what its own covariance says.
    """

    def judge(recording: Recording) -> dict[str, float]:
        found = replay(dataclasses.replace(recording, truth=None, truth_channels=()), vehicle=vehicle)
        marks = {}
        if found.scores.held_out is not None:
            marks[ERROR] = found.scores.held_out.median_m
        by_sensor: dict[str, list[float]] = {}
        for one in found.estimate.innovations:
            if one.dof > 0 and math.isfinite(one.nis):
                by_sensor.setdefault(one.sensor, []).append(one.nis / one.dof)
        return marks | {NIS.format(sensor): fmean(values) for sensor, values in by_sensor.items()}

    return judge
