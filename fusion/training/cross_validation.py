"""Cross-validation by run over labelled logs: folds, training with calibration, scores on held-out runs."""

import dataclasses
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.catalog.catalog import sha256_of
from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.readers import files_of
from terrafusion.fusion.metrics.classification import ClassificationScores, classification_scores
from terrafusion.fusion.training.softmax import (
    UNKNOWN_SHARE,
    SoftmaxModel,
    fit_softmax,
    precision_of,
)
from terrafusion.fusion.training.surface_features import (
    SURFACE_FEATURES,
    Signals,
    SurfaceWindows,
    signals_of,
    surface_windows,
)

FOLDS = 5
INNER_FOLDS = 4
MIN_RUNS = 2
"""Of a ground: one to train on, one to test."""
TEMPERATURES = (1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0, 11.0)
"""Windows of 2 s every 0.5 s overlap fourfold, and errors within a run are correlated. Calibrated on runs of
one ground, the temperature would be higher and changes of ground be detected later
(docs/explanation/terrain.md)."""


@dataclass(frozen=True, eq=False)
class LabelledRun:
    """One run on one ground: its signals and its n windows."""

    name: str
    label: str
    signals: Signals
    windows: SurfaceWindows

    @property
    def x(self) -> Array:
        """Features (n, d) of the windows."""
        return self.windows.x


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Probabilities (n, k) of the windows of all runs, each by the model trained without its fold."""

    classes: tuple[str, ...]
    runs: tuple[LabelledRun, ...]
    fold_of: NDArray[np.intp]
    models: tuple[SoftmaxModel, ...]
    single: tuple[Array, ...]
    filtered: tuple[Array, ...]

    def scores(self, filtered: bool = True) -> ClassificationScores:
        """Scores of the filtered probabilities, or of single windows."""
        return scores_of(self.classes, self.runs, self.filtered if filtered else self.single)


def open_runs(logs: Sequence[str]) -> list[LabelledRun]:
    """The labelled runs of logs: files, folders of them, or names of the catalogue.

    Raises:
        DataError: a run has no ground label, or there are no windows.
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
    """SHA-256 of every file of the logs, by folder and name, with more folders where names coincide.

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
    """Check that every ground has enough runs to leave one out.

    Raises:
        DataError: a ground has fewer than `MIN_RUNS` runs.
    """
    for label, count in sorted(Counter(r.label for r in runs).items()):
        if count < MIN_RUNS:
            raise DataError(
                f"ground '{label}' has {count} run, {MIN_RUNS} are needed to leave one out",
                channel="terrain",
                remedy="give more runs of it, or none",
            )


def assign_folds(runs: Sequence[LabelledRun], folds: int = FOLDS) -> NDArray[np.intp]:
    """The fold (n,) of each run: by ground, longest first, each to the fold with the least of that ground."""
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
    """Fit, and calibrate temperature (by the filtered log score) and novelty threshold on inner folds by run.

    A given `temperature` skips the calibration.

    Raises:
        ConfigError: fewer than two grounds.
        DataError: no ground has a second run.
    """
    model = _fitted(runs, features)
    if temperature is not None:
        return dataclasses.replace(model, temperature=temperature)
    fold_of = assign_folds(runs, INNER_FOLDS)
    held_out: list[tuple[SoftmaxModel, LabelledRun]] = []
    for fold in range(INNER_FOLDS):
        inner = [r for r, f in zip(runs, fold_of, strict=True) if f != fold]
        if {r.label for r in inner} != set(model.classes):
            continue
        part = _fitted(inner, features)
        held_out += [(part, r) for r, f in zip(runs, fold_of, strict=True) if f == fold]
    if not held_out:
        raise DataError(
            "no ground has a second run: nothing to calibrate on", channel="terrain", remedy="give more runs"
        )

    def loss(t: float) -> float:
        scores = [
            -np.log(dataclasses.replace(m, temperature=t).filtered(r.windows)[:, m.classes.index(r.label)])
            for m, r in held_out
        ]
        return float(np.concatenate(scores).mean())

    odd = np.quantile(np.concatenate([m.oddness(r.x) for m, r in held_out]), 1.0 - UNKNOWN_SHARE)
    return dataclasses.replace(model, temperature=min(TEMPERATURES, key=loss), odd_distance=float(odd))


def _fitted(runs: Sequence[LabelledRun], features: Sequence[str]) -> SoftmaxModel:
    """A model with the alarm of changes, not yet calibrated."""
    model = fit_softmax(np.vstack([r.x for r in runs]), labels_of(runs), features)
    return dataclasses.replace(model, alarm=precision_of([model.log_odds(r.windows.recent) for r in runs]))


def labels_of(runs: Sequence[LabelledRun]) -> list[str]:
    """The label of each window of the runs."""
    return [label for r in runs for label in [r.label] * len(r.x)]


def cross_validate(
    runs: Sequence[LabelledRun], features: Sequence[str] = SURFACE_FEATURES, temperature: float | None = None
) -> CrossValidation:
    """Train on all folds but one and predict that one, for each fold."""
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


def scores_of(
    classes: tuple[str, ...], runs: Sequence[LabelledRun], probabilities: Sequence[Array]
) -> ClassificationScores:
    """Scores of probabilities (n, k) for the windows of each run."""
    p = np.vstack(list(probabilities))
    true = np.array([classes.index(label) for label in labels_of(runs)])
    return classification_scores(classes, true, p.argmax(axis=1), p.max(axis=1))


def window_ms(model: SoftmaxModel, run: LabelledRun, windows: int = 200) -> float:
    """Mean processor time of one window, features and probabilities, ms."""
    from terrafusion.fusion.training.surface_features import HOP_S, RECENT_S, WINDOW_S, window_features

    first, times = float(run.signals.imu_s[0]) + WINDOW_S, []
    for i in range(min(windows, len(run.x))):
        begin = time.process_time()
        end = first + i * HOP_S
        for length in (WINDOW_S, RECENT_S):
            model.log_probabilities(window_features(run.signals.between(end - length, end), length))
        times.append(time.process_time() - begin)
    return 1e3 * float(np.mean(times))
