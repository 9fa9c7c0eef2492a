"""Delay of detecting changes of ground, on routes spliced from the signals of held-out runs."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.training.detector_scores import drawn_patches
from terrafusion.fusion.training.softmax import SoftmaxModel
from terrafusion.fusion.training.surface_features import (
    HOP_S,
    WINDOW_S,
    Signals,
    SurfaceWindows,
    surface_windows,
)

PATCHES = 30
PATCH_S = (10.0, 30.0)
"""Shortest and longest time on one ground."""
MIN_RUN_S = PATCH_S[0] + 1.0
"""Shorter runs give no patch."""
SEEN_WITHIN_S = 2.0


@dataclass(frozen=True)
class ChangeDetection:
    """Detection of changes of ground: quantiles of the delays, s, and shares of all changes.

    A change is detected when the new ground first has the largest probability, and missed (`never`) if that
    does not happen before the next change; `right` is the share of correctly classified windows. `alarms` is
    the share of changes with an alarm within `SEEN_WITHIN_S`, `false_alarms` the number a minute elsewhere.
    """

    median_s: float
    p95_s: float
    within_2_s: float
    never: float
    right: float
    changes: int
    alarms: float
    false_alarms: float


def spliced(runs: Sequence[tuple[Signals, str]], seed: int) -> tuple[Signals, list[tuple[float, str]]]:
    """One route cut from runs of at least two grounds, and the start and name of each patch.

    The raw samples are spliced, so windows across a change contain both grounds. No run may be shorter than
    `MIN_RUN_S`.
    """
    rng = np.random.default_rng([seed, 23])
    parts: list[tuple[float, Signals]] = []
    begins: list[tuple[float, str]] = []
    at = 0.0
    for label, source in itertools.islice(drawn_patches(runs, rng), PATCHES):
        length = min(float(rng.uniform(*PATCH_S)), source.end_s() - 0.5)
        begin = float(rng.uniform(0.0, source.end_s() - length))
        parts.append((at - begin, source.between(begin, begin + length)))
        begins.append((at, label))
        at += length
    return _joined(parts), begins


def _joined(parts: Sequence[tuple[float, Signals]]) -> Signals:
    def times(name: str) -> Array:
        return np.concatenate([getattr(s, name) + shift for shift, s in parts])

    def rows(name: str) -> Array:
        return np.concatenate([getattr(s, name) for _, s in parts])

    return Signals(
        times("imu_s"), rows("gyro_radps"), rows("accel_mps2"), times("wheels_s"), rows("sides_mps"),
        parts[0][1].track_m, times("current_s"), rows("current_a"),
    )  # fmt: skip


def delays(
    model: SoftmaxModel, windows: SurfaceWindows, begins: Sequence[tuple[float, str]]
) -> tuple[list[float], float]:
    """Delay of each change, s (inf: missed), and the share of correctly classified windows."""
    ends = windows.end_s
    winner = np.array(model.classes)[model.filtered(windows).argmax(axis=1)]
    found: list[float] = []
    right = 0
    for k, (begin, label) in enumerate(begins):
        until = begins[k + 1][0] if k + 1 < len(begins) else np.inf
        rows = np.flatnonzero((ends > begin) & (ends <= until))
        hits = rows[winner[rows] == label]
        right += len(hits)
        if k:
            found.append(float(ends[hits[0]] - begin) if len(hits) else np.inf)
    return found, right / max(len(ends), 1)


def alarms(
    model: SoftmaxModel, windows: SurfaceWindows, begins: Sequence[tuple[float, str]]
) -> tuple[list[bool], int, float]:
    """Whether each change raises an alarm in time; the number of other alarms, and their minutes."""
    raised, ends = model.changes(windows), windows.end_s
    elsewhere = np.ones(len(ends), dtype=bool)
    in_time = []
    for begin, _ in begins[1:]:
        in_time.append(bool(raised[(ends > begin) & (ends <= begin + SEEN_WITHIN_S)].any()))
        elsewhere &= ~((ends > begin) & (ends <= begin + WINDOW_S + 1.0))
    return in_time, int(raised[elsewhere].sum()), float(elsewhere.sum()) * HOP_S / 60.0


def changes_seen(
    models: Sequence[SoftmaxModel], held_out: Sequence[Sequence[tuple[Signals, str]]], first_seed: int = 0
) -> ChangeDetection | None:
    """Each model on two routes over its held-out runs (signals, label), with seeds from `first_seed`.

    None if no model has long enough runs of two grounds.
    """
    found: list[float] = []
    right: list[float] = []
    raised: list[bool] = []
    false, minutes = 0, 0.0
    for fold, (model, given) in enumerate(zip(models, held_out, strict=True)):
        runs = [(signals, label) for signals, label in given if signals.end_s() > MIN_RUN_S]
        if len({label for _, label in runs}) < 2:
            continue
        for seed in (first_seed + 2 * fold, first_seed + 2 * fold + 1):
            route, begins = spliced(runs, seed)
            windows = surface_windows(route)
            here, share = delays(model, windows, begins)
            found += here
            right.append(share)
            in_time, others, spent = alarms(model, windows, begins)
            raised += in_time
            false += others
            minutes += spent
    if not found:
        return None
    seen = np.array([d for d in found if np.isfinite(d)])
    return ChangeDetection(
        median_s=float(np.median(seen)) if len(seen) else np.inf,
        p95_s=float(np.quantile(seen, 0.95)) if len(seen) else np.inf,
        within_2_s=float(np.mean(np.array(found) <= SEEN_WITHIN_S)),
        never=float(np.mean(~np.isfinite(found))),
        right=float(np.mean(right)),
        changes=len(found),
        alarms=float(np.mean(raised)),
        false_alarms=false / minutes if minutes else 0.0,
    )
