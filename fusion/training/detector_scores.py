"""Scores of the terrain detector on routes it was not trained on."""

import itertools
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.tables import text_table
from terrafusion.fusion.terrain.classifier import UNKNOWN, TerrainModel
from terrafusion.fusion.terrain.detector import TerrainDetector
from terrafusion.fusion.terrain.features import MIN_SPEED_MPS, Window
from terrafusion.fusion.training.simulated_runs import UPDATE_S, WINDOW_S

PATCH_M = (10.0, 30.0)
"""Patches of a spliced route: shortest length, and mean of the exponential length beyond it."""
MAX_PATCH_WINDOWS = 80
SETTLING_S = 3.0
"""Driving after a change of ground in which a switch of the detector does not count as false."""
MIN_SCORED_PATCH_S = 5.0
IN_TIME_S = 2.0
ECE_BINS = 10
Run = TypeVar("Run")


@dataclass(frozen=True, eq=False)
class LabelledRoute:
    """Windows in driving order, the true ground (n,) of each, and the rows where the ground changes."""

    windows: list[Window]
    labels: NDArray[Any]
    starts: list[int]


@dataclass(frozen=True)
class DetectorScores:
    """Scores of a detector over routes; only windows in which the robot or its wheels moved count.

    `unknown`, the last class, is right if no other one is.

    Attributes:
        classes: k names.
        macro_f1: mean F1 of the classes that occurred.
        accuracy: share of windows with the right class.
        ece: expected calibration error (Naeini et al. 2015) of the most probable class.
        confusion: (k, k) shares; a row is a true class and sums to one, or to zero if it did not occur.
        windows: their number.
        unknown_share: share of windows classified as unknown.
        switch_delay_s: median, 95th percentile and largest time from a change of ground to its detection.
        switches_in_time: share of patches (of `MIN_SCORED_PATCH_S` and more) whose ground was detected within
            `IN_TIME_S`; NaN without a change.
        switches_missed: share of them whose ground was never detected.
        false_switches_per_min: switches without a change of ground, per minute of driving.
        update_ms: mean processor time of one update.
    """

    classes: tuple[str, ...]
    macro_f1: float
    accuracy: float
    ece: float
    confusion: tuple[tuple[float, ...], ...]
    windows: int
    unknown_share: float
    switch_delay_s: tuple[float, float, float]
    switches_in_time: float
    switches_missed: float
    false_switches_per_min: float
    update_ms: float


def drawn_patches(runs: Sequence[tuple[Run, str]], rng: np.random.Generator) -> Iterator[tuple[str, Run]]:
    """Without end: another ground than that before, and one of its runs; the caller may draw in between."""
    grounds, last = sorted({ground for _, ground in runs}), ""
    while True:
        last = str(rng.choice([ground for ground in grounds if ground != last]))
        choices = [run for run, ground in runs if ground == last]
        yield last, choices[int(rng.integers(len(choices)))]


def long_stretches(runs: Sequence[tuple[list[Window], str]]) -> list[tuple[list[Window], str]]:
    """Those of the runs (windows, ground) in which the robot moves long enough to be part of a route."""
    return [(w, g) for w, g in runs if sum(x.ground_speed_mps() > MIN_SPEED_MPS for x in w) > 10]


def splice(runs: Sequence[tuple[list[Window], str]], patches: int, seed: int) -> LabelledRoute:
    """One long route over `patches` grounds, cut from runs (windows, ground) on one ground each."""
    rng = np.random.default_rng([seed, 11])
    windows: list[Window] = []
    labels: list[str] = []
    starts: list[int] = []
    for ground, source in itertools.islice(drawn_patches(long_stretches(runs), rng), patches):
        begin = int(rng.integers(max(len(source) - 20, 1)))
        length_m = PATCH_M[0] + rng.exponential(PATCH_M[1])
        driven = np.cumsum([w.ground_speed_mps() * UPDATE_S for w in source[begin:]])
        part = source[begin : begin + min(int(np.searchsorted(driven, length_m)) + 1, MAX_PATCH_WINDOWS)]
        starts.append(len(windows))
        windows += part
        labels += [ground] * len(part)
    return LabelledRoute(windows, np.array(labels), starts)


def changes_in(windows: list[Window], labels: NDArray[Any]) -> LabelledRoute:
    """The route of one simulated run over several grounds."""
    return LabelledRoute(windows, labels, [0, *(np.flatnonzero(labels[1:] != labels[:-1]) + 1).tolist()])


def evaluate(trials: Sequence[tuple[TerrainModel, LabelledRoute]]) -> DetectorScores:
    """Run a new detector along each route, by the model beside it, and score them all.

    The models have the same classes.
    """
    classes = (*trials[0][0].classes, UNKNOWN)
    winners, confidences, truths = [], [], []
    delays: list[float] = []
    missed = false = 0
    seconds = updates = 0.0
    for model, route in trials:
        detector = TerrainDetector(model, classes)
        begin = time.process_time()
        p = np.array([detector.update(window) for window in route.windows])
        seconds += time.process_time() - begin
        updates += len(p)
        winner = p.argmax(axis=1)
        moving = np.array([w.ground_speed_mps() > MIN_SPEED_MPS for w in route.windows])
        true = np.array([classes.index(label) for label in route.labels])
        winners.append(winner[moving])
        confidences.append(p.max(axis=1)[moving])
        truths.append(true[moving])
        delays_here, missed_here, false_here = _switches(route, winner, true, moving)
        delays += delays_here
        missed += missed_here
        false += false_here
    winner, true, confidence = map(np.concatenate, (winners, truths, confidences))
    k, right = len(classes), winner == true
    counts = np.bincount(true * k + winner, minlength=k * k).reshape(k, k)
    of_class = counts.sum(axis=1)
    f1 = 2.0 * np.diag(counts) / np.maximum(of_class + counts.sum(axis=0), 1)
    bins = np.minimum((confidence * ECE_BINS).astype(int), ECE_BINS - 1)
    gap = np.bincount(bins, weights=confidence - right, minlength=ECE_BINS)
    quantiles = np.quantile(delays, [0.5, 0.95, 1.0]) if delays else np.full(3, np.nan)
    in_time, changes = sum(delay <= IN_TIME_S for delay in delays), len(delays) + missed
    return DetectorScores(
        classes=classes,
        macro_f1=float(f1[of_class > 0].mean()),
        accuracy=float(right.mean()),
        ece=float(np.abs(gap).sum() / len(winner)),
        confusion=tuple(map(tuple, (counts / np.maximum(of_class, 1)[:, None]).tolist())),
        windows=len(winner),
        unknown_share=float((winner == k - 1).mean()),
        switch_delay_s=(float(quantiles[0]), float(quantiles[1]), float(quantiles[2])),
        switches_in_time=in_time / changes if changes else float("nan"),
        switches_missed=missed / max(changes, 1),
        false_switches_per_min=false / max(len(winner) * UPDATE_S / 60.0, 1e-9),
        update_ms=1e3 * seconds / max(updates, 1.0),
    )


def _switches(
    route: LabelledRoute, winner: NDArray[Any], true: NDArray[Any], moving: NDArray[np.bool_]
) -> tuple[list[float], int, int]:
    """Delays of the detected changes of ground, s of driving; number of missed and of false switches."""
    delays, missed = [], 0
    settled = np.ones(len(winner), dtype=bool)
    for first, end in itertools.pairwise([*route.starts, len(winner)]):
        rows = first + np.flatnonzero(moving[first:end])
        settled[rows[: round(SETTLING_S / UPDATE_S)]] = False
        settled[first : first + 1] = False
        if first == 0 or len(rows) * UPDATE_S < MIN_SCORED_PATCH_S:
            continue
        right = np.flatnonzero(winner[rows] == true[rows])
        if right.size:
            delays.append(WINDOW_S + UPDATE_S * int(right[0]))
        else:
            missed += 1
    false = int((settled[1:] & (winner[1:] != winner[:-1])).sum())
    return delays, missed, false


def confusion_lines(classes: Sequence[str], confusion: Sequence[Sequence[float]]) -> list[str]:
    """A row a true class with the shares of what was recognised; classes that did not occur are left out."""
    rows = [
        [truth, *(f"{share:.3f}" for share in row)]
        for truth, row in zip(classes, confusion, strict=True)
        if any(row)
    ]
    return text_table(["true ground", *classes], rows, right=range(1, len(classes) + 1))
