"""A `ReplayResult` of a synthetic estimate, as `replay` would give it."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.estimate.estimate import Estimate
from terrafusion.fusion.metrics.baselines import Baselines
from terrafusion.fusion.metrics.scores import Scores
from terrafusion.fusion.metrics.verdict import Verdict
from terrafusion.fusion.noise.policy import load_policy
from terrafusion.fusion.replay import ReplayResult
from terrafusion.twin.model.vehicle import load_vehicle


def result_of(recording: Recording, estimate: Estimate, scores: Scores, **changed: Any) -> ReplayResult:
    """The result of a replay at 90 times real time; `changed` are fields that differ."""
    rejected = rejected_counts(estimate)
    result = ReplayResult(
        recording=recording,
        vehicle=load_vehicle("elevate"),
        mode="adaptive",
        policy=load_policy(),
        estimate=estimate,
        scores=scores,
        used=None,
        held_out=None,
        outages=(),
        seconds=recording.duration_s() / 90.0,
        latencies_ms=np.array([0.5, 0.6, 2.0]),
        rejected_gnss=rejected["gnss"],
        rejected_wheels=rejected["wheels"],
        baselines=Baselines(),
        verdict=Verdict("good", ("Its sigmas hold.",)),
        assumed=(),
    )
    return dataclasses.replace(result, **changed)


def rejected_counts(estimate: Estimate) -> dict[str, int]:
    """Measurements rejected by a gate, by sensor: `gnss` with velocities, `wheels` with side-slip."""
    counts = {"gnss": 0, "wheels": 0}
    for innovation in estimate.innovations:
        if not innovation.accepted:
            sensor = next((name for name in counts if innovation.sensor.startswith(name)), innovation.sensor)
            counts[sensor] = counts.get(sensor, 0) + 1
    return counts
