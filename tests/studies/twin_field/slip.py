"""Slip and effective track by ground: as measured, and as each model has it on the same forks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.studies.joined_windows import DT_S
from tests.studies.twin_field.compare import SAME, Result
from tests.studies.twin_field.forks import N_PAST, Forks
from tests.studies.twin_field.models import BEST_KINEMATIC, TWIN, TWIN_NOMINAL
from tests.studies.twin_field.resampled_groups import resampled_groups
from tests.studies.twin_field.scores import DRAWS, SEED, Interval, interval

Array = NDArray[np.float64]

ROLLED_M = 2.5
"""Horizons in which the wheels roll less than this, net, say nothing about slip."""
TURNED_RAD = 0.3
"""Horizons in which the robot turns less than this by its geometric track say nothing about the track."""
MEASURED = "measured"
SOURCES = (TWIN_NOMINAL, TWIN, "radius, track", BEST_KINEMATIC)


@dataclass(frozen=True)
class SlipRow:
    """What a ground does to the wheels' travel over five seconds.

    Attributes:
        ground, recording: where; `recording` is "" for all of a ground.
        source: `MEASURED` or a model's name.
        count: forks that roll far enough.
        slip: median of 1 - way / rolled way, by the nominal radius, with a 95 % interval.
        slip_low, slip_high: 10th and 90th percentile over the forks.
        track_m: wheel difference over yaw, sum D^2 / sum D psi over forks, with a 95 % interval.
    """

    ground: str
    recording: str
    source: str
    count: int
    slip: Interval
    slip_low: float
    slip_high: float
    track_m: Interval


def slip_rows(results: Sequence[Result], radius_m: float, track_m: float) -> list[SlipRow]:
    """Rows by ground and recording, of the models that were trained on the same ground with wheel inputs."""
    chosen = [r for r in results if r.scheme == SAME and r.inputs == "wheels"]
    rows: list[SlipRow] = []
    for ground in sorted({r.ground for r in chosen}):
        own = [r for r in chosen if r.ground == ground]
        names = list(dict.fromkeys(r.name for r in own))
        recordings = sorted({str(name) for r in own for name in r.forks.recording})
        for recording in ["", *recordings] if len(recordings) > 1 else [""]:
            for source in [MEASURED, *(name for name in SOURCES if name in names)]:
                of = [r for r in own if r.name == (names[0] if source == MEASURED else source)]
                rows.append(_row(ground, recording, source, of, radius_m, track_m))
    return rows


def _row(
    ground: str, recording: str, source: str, results: Sequence[Result], radius_m: float, track_m: float
) -> SlipRow:
    parts: list[list[NDArray[Any]]] = []
    for r in results:
        true = r.forks.motion[:, N_PAST:]
        travel = _travel(true if source == MEASURED else r.prediction, r.forks, radius_m)
        keep = np.full(len(r.forks), True) if not recording else r.forks.recording == recording
        known = np.asarray(np.isfinite(true[..., 0]).all(axis=1))
        columns: tuple[NDArray[Any], ...] = (*travel, known, r.forks.group)
        parts.append([column[keep] for column in columns])
    way, rolled, apart, turned, known, group = (np.concatenate(c) for c in zip(*parts, strict=True))
    far = (np.abs(rolled) > ROLLED_M) & known
    slip = 1.0 - way[far] / rolled[far]
    turning = np.abs(apart) / track_m > TURNED_RAD
    low, high = np.percentile(slip, [10.0, 90.0]) if far.any() else (np.nan, np.nan)
    return SlipRow(
        ground, recording, source, int(far.sum()), _interval(lambda k: np.median(slip[k]), group[far]),
        float(low), float(high),
        _interval(lambda k: _track(apart[turning][k], turned[turning][k]), group[turning]),
    )  # fmt: skip


def _travel(motion: Array, forks: Forks, radius_m: float) -> tuple[Array, Array, Array, Array]:
    """(F,) way forward, rolled way, difference of the sides' rolled ways (m), and yaw (rad), each signed."""
    sides = forks.inputs_radps[:, N_PAST:] * radius_m
    mean, apart = sides.mean(axis=2), sides[..., 1] - sides[..., 0]
    apart = apart if not forks.given_turn else np.zeros_like(apart)
    sums = [
        0.5 * DT_S * (x[:, 1:] + x[:, :-1]).sum(axis=1) for x in (motion[..., 0], mean, apart, motion[..., 2])
    ]
    return sums[0], sums[1], sums[2], sums[3]


def _track(apart: Array, turned: Array) -> float:
    return float((apart**2).sum() / (apart * turned).sum())


def _interval(statistic: Callable[[NDArray[np.int64]], Any], group: NDArray[np.str_]) -> Interval:
    if not len(group):
        return Interval(np.nan, np.nan, np.nan)
    draws = np.array([statistic(rows) for rows in resampled_groups(group, DRAWS, SEED)])
    return interval(float(statistic(np.arange(len(group)))), draws)
