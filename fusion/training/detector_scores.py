"""How well the detector tells the grounds: scores on drives it was not trained on."""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.fusion.terrain.classifier import UNKNOWN, TerrainModel
from terrafusion.fusion.terrain.detector import TerrainDetector
from terrafusion.fusion.terrain.features import MIN_SPEED_MPS, Window
from terrafusion.fusion.training.simulated_runs import UPDATE_S, WINDOW_S

Array = NDArray[np.float64]

PATCH_M = (10.0, 30.0)
"""Spliced patches: shortest length, and mean of the exponential length beyond it."""
LONGEST_PATCH = 80
SETTLING_S = 3.0
ECE_BINS = 10


@dataclass(frozen=True, eq=False)
class LabelledRoute:
    """Windows in driving order, the true ground (n,) of each, and the rows where the ground changes."""

    windows: list[Window]
    labels: NDArray[Any]
    starts: list[int]


@dataclass(frozen=True)
class DetectorScores:
    """Figures of a detector over sequences; only windows in which the robot or its wheels moved count.

    Attributes:
        classes: names of the rows and columns of `confusion`, `unknown` last.
        confusion: shares of each true ground that were named so, rows sum to one (0 where it did not occur).
        macro_f1: mean F1 of the grounds that occurred; `unknown` is one where none of the others is right.
        ece: expected calibration error of the winner's probability, ten bins (Naeini et al. 2015).
        unknown_share: share of windows called unknown.
        switch_delay_s: median, 95th percentile and largest time from a change of ground to its detection.
        switches_missed: share of patches (of 5 s and more) whose ground was never named.
        false_switches_per_min: changes of the winner that no change of ground explains, a minute of driving.
        update_ms: mean processor time of one update.
        windows: number of windows counted.
    """

    classes: tuple[str, ...]
    confusion: tuple[tuple[float, ...], ...]
    macro_f1: float
    ece: float
    unknown_share: float
    switch_delay_s: tuple[float, float, float]
    switches_missed: float
    false_switches_per_min: float
    update_ms: float
    windows: int


def splice(drives: Sequence[tuple[list[Window], str]], patches: int, seed: int) -> LabelledRoute:
    """One long drive over `patches` grounds, cut from drives (windows, ground) on one ground each."""
    rng = np.random.default_rng([seed, 11])
    grounds = sorted({ground for _, ground in drives})
    moving = [(w, g) for w, g in drives if sum(x.ground_speed_mps() > MIN_SPEED_MPS for x in w) > 10]
    windows: list[Window] = []
    labels: list[str] = []
    starts: list[int] = []
    last = ""
    for _ in range(patches):
        ground = str(rng.choice([g for g in grounds if g != last]))
        choices = [w for w, g in moving if g == ground]
        source = choices[int(rng.integers(len(choices)))]
        begin = int(rng.integers(max(len(source) - 20, 1)))
        length_m = PATCH_M[0] + rng.exponential(PATCH_M[1])
        driven = np.cumsum([w.ground_speed_mps() * UPDATE_S for w in source[begin:]])
        end = begin + min(int(np.searchsorted(driven, length_m)) + 1, LONGEST_PATCH)
        starts.append(len(windows))
        windows += source[begin:end]
        labels += [ground] * len(source[begin:end])
        last = ground
    return LabelledRoute(windows, np.array(labels), starts)


def changes_in(windows: list[Window], labels: NDArray[Any]) -> LabelledRoute:
    """A drive of the twin over several grounds as a sequence."""
    return LabelledRoute(windows, labels, [0, *(np.flatnonzero(labels[1:] != labels[:-1]) + 1).tolist()])


def evaluate(model: TerrainModel, sequences: Sequence[LabelledRoute]) -> DetectorScores:
    """Run a fresh detector along each sequence and score it."""
    classes = (*model.classes, UNKNOWN)
    named, sure, truth = [], [], []
    delays: list[float] = []
    missed = long_patches = false = 0
    seconds = updates = 0.0
    for sequence in sequences:
        detector = TerrainDetector(model, classes)
        begin = time.process_time()
        p = np.array([detector.update(window) for window in sequence.windows])
        seconds += time.process_time() - begin
        updates += len(p)
        winner = p.argmax(axis=1)
        moving = np.array([w.ground_speed_mps() > MIN_SPEED_MPS for w in sequence.windows])
        true = np.array([classes.index(label) for label in sequence.labels])
        named.append(winner[moving])
        sure.append(p.max(axis=1)[moving])
        truth.append(true[moving])
        found, lost, false_here = _switches(sequence, winner, true, moving)
        delays += found
        missed += lost
        long_patches += len(found) + lost
        false += false_here
    winner, top, true = np.concatenate(named), np.concatenate(sure), np.concatenate(truth)
    k = len(classes)
    counts = np.bincount(true * k + winner, minlength=k * k).reshape(k, k).astype(float)
    hits = np.diag(counts)
    f1 = 2.0 * hits / np.maximum(counts.sum(axis=0) + counts.sum(axis=1), 1.0)
    shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1.0)
    present = counts.sum(axis=1) > 0
    quantiles = np.quantile(delays, [0.5, 0.95, 1.0]) if delays else np.full(3, np.nan)
    return DetectorScores(
        classes=classes,
        confusion=tuple(tuple(row) for row in shares.tolist()),
        macro_f1=float(f1[present].mean()),
        ece=calibration_error(top, winner == true),
        unknown_share=float((winner == k - 1).mean()),
        switch_delay_s=(float(quantiles[0]), float(quantiles[1]), float(quantiles[2])),
        switches_missed=missed / max(long_patches, 1),
        false_switches_per_min=false / max(len(top) * UPDATE_S / 60.0, 1e-9),
        update_ms=1e3 * seconds / max(updates, 1.0),
        windows=len(top),
    )


def calibration_error(confidence: Array, correct: NDArray[np.bool_]) -> float:
    """Expected calibration error of winners' probabilities (n,) and whether they were right (n,)."""
    bins = np.minimum((confidence * ECE_BINS).astype(int), ECE_BINS - 1)
    gap = np.bincount(bins, weights=confidence - correct, minlength=ECE_BINS)
    return float(np.abs(gap).sum() / len(confidence))


def _switches(
    sequence: LabelledRoute, winner: NDArray[Any], true: NDArray[Any], moving: NDArray[np.bool_]
) -> tuple[list[float], int, int]:
    """Delays (s of driving) of the changes of ground, how many were missed, how many were false."""
    delays, missed = [], 0
    settled = np.ones(len(winner), dtype=bool)
    bounds = [*sequence.starts, len(winner)]
    for first, end in itertools.pairwise(bounds):
        rows = first + np.flatnonzero(moving[first:end])
        settled[rows[: round(SETTLING_S / UPDATE_S)]] = False
        settled[first : first + 1] = False
        if first == 0 or len(rows) * UPDATE_S < 5.0:
            continue
        right = np.flatnonzero(winner[rows] == true[rows])
        if right.size:
            delays.append(WINDOW_S + UPDATE_S * int(right[0]))
        else:
            missed += 1
    false = int((settled[1:] & (winner[1:] != winner[:-1])).sum())
    return delays, missed, false
