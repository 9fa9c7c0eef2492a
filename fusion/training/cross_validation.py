"""Labelled drives: folds by run, training with calibration, and scores no run of which was trained on."""

from __future__ import annotations

import dataclasses
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.catalog.catalog import sha256_of
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.readers import files_of
from terrafusion.fusion.training.detector_scores import calibration_error
from terrafusion.fusion.training.softmax import (
    UNKNOWN_SHARE,
    SoftmaxModel,
    fit_softmax,
)
from terrafusion.fusion.training.surface_features import (
    SURFACE_FEATURES,
    Signals,
    SurfaceWindows,
    signals_of,
    surface_windows,
)

Array = NDArray[np.float64]

FOLDS = 5
INNER_FOLDS = 4
LEAST_RUNS = 2
"""Of a ground: one to learn from, another to answer for."""
TEMPERATURES = (1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0)
"""Windows of 2 s every 0.5 s see each moment four times, and those of one run err alike. The calibration has
only runs on one ground, so it would go further, at the cost of every change of ground (docs/detector.md)."""


@dataclass(frozen=True, eq=False)
class LabelledRun:
    """One drive on one ground: its signals, and what its n windows show."""

    name: str
    label: str
    signals: Signals
    windows: SurfaceWindows

    @property
    def x(self) -> Array:
        """Features (n, d) of the windows."""
        return self.windows.x


@dataclass(frozen=True)
class LearnerScores:
    """Scores over windows: rows of `confusion` are true grounds, as shares; `ece` of the winner."""

    classes: tuple[str, ...]
    macro_f1: float
    accuracy: float
    ece: float
    confusion: tuple[tuple[float, ...], ...]
    windows: int


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Answers (n, k) of the windows of all runs, each by the model that has not seen its fold."""

    classes: tuple[str, ...]
    runs: tuple[LabelledRun, ...]
    fold_of: NDArray[np.intp]
    models: tuple[SoftmaxModel, ...]
    single: tuple[Array, ...]
    filtered: tuple[Array, ...]

    def figures(self, filtered: bool = True) -> LearnerScores:
        """Scores of the filtered answers, or of each window by itself."""
        return learner_scores(self.classes, self.runs, self.filtered if filtered else self.single)


def open_runs(logs: Sequence[str]) -> list[LabelledRun]:
    """The labelled runs of logs: files, folders of them, or names of the catalogue.

    Raises:
        DataError: a run has no one ground label, or no windows at all were found.
        TerrafusionError: a log cannot be read.
    """
    from terrafusion.datasets.readers import open_recordings

    runs = []
    for log in logs:
        for recording in open_recordings(log):
            if not recording.terrain_name:
                raise DataError(f"{recording.name}: no ground label for the whole drive", channel="terrain")
            signals = signals_of(recording)
            windows = surface_windows(signals)
            if len(windows):
                runs.append(LabelledRun(recording.name, recording.terrain_name, signals, windows))
    if not runs:
        raise DataError("no labelled windows in the logs given", channel="terrain")
    return runs


def hashes_of(logs: Sequence[str]) -> dict[str, str]:
    """SHA-256 of every file that is read of the logs: what was learnt from.

    Files are named by folder and name, by more folders where two would be called the same.

    Raises:
        DataError: there is no such log.
    """
    files = sorted({file.resolve() for log in logs for file in files_of(log)})
    longest = max((len(file.parts) for file in files), default=0)
    names: list[str] = []
    for parts in range(2, longest + 1):
        names = ["/".join(file.parts[-parts:]) for file in files]
        if len(set(names)) == len(files):
            break
    return {name: sha256_of(file) for name, file in zip(names, files, strict=True)}


def check_runs(runs: Sequence[LabelledRun]) -> None:
    """Refuse what no run can be left out of.

    Raises:
        DataError: a ground has fewer than `LEAST_RUNS` runs.
    """
    for label, count in sorted(Counter(r.label for r in runs).items()):
        if count < LEAST_RUNS:
            raise DataError(
                f"ground '{label}' has {count} run, {LEAST_RUNS} are needed to leave one out",
                channel="terrain",
                remedy="give more runs of it, or none",
            )


def assign_folds(runs: Sequence[LabelledRun], folds: int = FOLDS) -> NDArray[np.intp]:
    """The fold (n,) of each run: by ground, the longest first, each to the fold with least of that ground."""
    fold_of = np.zeros(len(runs), dtype=np.intp)
    total = np.zeros(folds)
    for label in sorted({r.label for r in runs}):
        load = np.zeros(folds)
        for i in sorted((i for i, r in enumerate(runs) if r.label == label), key=lambda i: -len(runs[i].x)):
            least = np.lexsort((total, load))[0]
            fold_of[i] = least
            load[least] += len(runs[i].x)
            total[least] += len(runs[i].x)
    return fold_of


def train_on(
    runs: Sequence[LabelledRun],
    features: Sequence[str] = SURFACE_FEATURES,
    temperature: float | None = None,
) -> SoftmaxModel:
    """Fit, and calibrate on inner folds by run: the temperature by the filtered log-score, and what is odd.

    A given `temperature` skips the calibration.

    Raises:
        ConfigError: fewer than two grounds, or no scikit-learn.
        DataError: no ground has a run to leave out.
    """
    model = fit_softmax(np.vstack([r.x for r in runs]), labels_of(runs), features)
    if temperature is not None:
        return dataclasses.replace(model, temperature=temperature)
    fold_of = assign_folds(runs, INNER_FOLDS)
    held: list[tuple[SoftmaxModel, LabelledRun]] = []
    for fold in range(INNER_FOLDS):
        inner = [r for r, f in zip(runs, fold_of, strict=True) if f != fold]
        if {r.label for r in inner} != set(model.classes):
            continue
        part = fit_softmax(np.vstack([r.x for r in inner]), labels_of(inner), features)
        held += [(part, r) for r, f in zip(runs, fold_of, strict=True) if f == fold]
    if not held:
        raise DataError(
            "no ground has a second run: nothing to calibrate on", channel="terrain", remedy="give more runs"
        )

    def loss(t: float) -> float:
        scores = [
            -np.log(dataclasses.replace(m, temperature=t).filtered(r.windows)[:, m.classes.index(r.label)])
            for m, r in held
        ]
        return float(np.concatenate(scores).mean())

    odd = np.quantile(np.concatenate([m.oddness(r.x) for m, r in held]), 1.0 - UNKNOWN_SHARE)
    return dataclasses.replace(model, temperature=min(TEMPERATURES, key=loss), odd_distance=float(odd))


def labels_of(runs: Sequence[LabelledRun]) -> list[str]:
    """The label of each window of the runs."""
    return [label for r in runs for label in [r.label] * len(r.x)]


def cross_validate(
    runs: Sequence[LabelledRun], features: Sequence[str] = SURFACE_FEATURES, temperature: float | None = None
) -> CrossValidation:
    """Train on four fifths of the runs and answer for the others, for each fifth."""
    fold_of = assign_folds(runs)
    models = tuple(
        train_on([r for r, f in zip(runs, fold_of, strict=True) if f != fold], features, temperature)
        for fold in range(FOLDS)
    )
    chosen = [models[f] for f in fold_of]
    return CrossValidation(
        classes=models[0].classes,
        runs=tuple(runs),
        fold_of=fold_of,
        models=models,
        single=tuple(np.exp(m.log_probabilities(r.x)) for m, r in zip(chosen, runs, strict=True)),
        filtered=tuple(m.filtered(r.windows) for m, r in zip(chosen, runs, strict=True)),
    )


def learner_scores(
    classes: tuple[str, ...], runs: Sequence[LabelledRun], answers: Sequence[Array]
) -> LearnerScores:
    """Scores of probabilities (n, k) for the windows of each run."""
    k = len(classes)
    p = np.vstack(list(answers))
    true = np.array([classes.index(label) for label in labels_of(runs)])
    winner = p.argmax(axis=1)
    counts = np.bincount(true * k + winner, minlength=k * k).reshape(k, k).astype(float)
    present = counts.sum(axis=1) > 0
    f1 = 2.0 * np.diag(counts) / np.maximum(counts.sum(axis=0) + counts.sum(axis=1), 1.0)
    shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1.0)
    return LearnerScores(
        classes=classes,
        macro_f1=float(f1[present].mean()),
        accuracy=float((winner == true).mean()),
        ece=calibration_error(p.max(axis=1), winner == true),
        confusion=tuple(tuple(row) for row in shares.tolist()),
        windows=len(true),
    )


def window_ms(model: SoftmaxModel, run: LabelledRun, windows: int = 200) -> float:
    """Mean computing time of one window, features and answers, ms."""
    from terrafusion.fusion.training.surface_features import HOP_S, RECENT_S, WINDOW_S, window_features

    first, times = float(run.signals.imu_s[0]) + WINDOW_S, []
    for i in range(min(windows, len(run.x))):
        begin = time.process_time()
        end = first + i * HOP_S
        for length in (WINDOW_S, RECENT_S):
            model.log_probabilities(window_features(run.signals.between(end - length, end), length))
        times.append(time.process_time() - begin)
    return 1e3 * float(np.mean(times))
