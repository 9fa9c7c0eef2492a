"""Training of the terrain model on labelled logs of one robot, and its cross-validation by run.

Temperature, weight of `unknown`, doubt and alarm of a change are calibrated on runs that the densities were
not fitted to; for the first two they are spliced to routes over several grounds.
"""

import dataclasses
from collections import Counter
from collections.abc import Sequence

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.printable import counted
from terrafusion.fusion.terrain.classifier import UNKNOWN, TerrainModel
from terrafusion.fusion.terrain.detector import TerrainDetector
from terrafusion.fusion.terrain.features import Window
from terrafusion.fusion.training.detector_scores import (
    DetectorScores,
    LabelledRoute,
    evaluate,
    long_stretches,
    splice,
)
from terrafusion.fusion.training.logged_runs import LoggedRun
from terrafusion.fusion.training.spectrum_fit import alarm_precision, fit_spectrum
from terrafusion.fusion.training.train_detector import PATCHES, calibrate, draft, features_of

FOLDS = 5
DOUBTS = (0.0, 0.01, 0.02, 0.03, 0.05, 0.08, 0.12, 0.17, 0.25, 0.35)
"""Values of `TerrainModel.doubt` that are tried."""
MIN_RUNS = 2
"""Of a ground: one to fit to, one to calibrate or to test on."""


def train_on(runs: Sequence[LoggedRun], inputs: dict[str, str], made_by: str = "") -> TerrainModel:
    """A model of the robot of `runs`; `inputs` are the SHA-256 of the files of the logs by name.

    Raises:
        DataError: fewer than two grounds, a ground with a single run, or too little of one.
    """
    check_runs(runs)
    half = assign_folds(runs, 2)
    fitted_to, held_out = ([run for run, f in zip(runs, half, strict=True) if f == fold] for fold in (0, 1))
    stretches = [piece for run in held_out for piece in pieces(run)]
    _check_halves(fitted_to, stretches)
    part = _fitted(fitted_to)
    part = _with_alarm(calibrate(part, splice(stretches, PATCHES, 0)), stretches)
    model = _fitted(runs)
    spectrum = model.spectrum
    if spectrum is not None and part.spectrum is not None:
        spectrum = dataclasses.replace(spectrum, alarm=part.spectrum.alarm)
    return dataclasses.replace(
        model,
        unknown=dataclasses.replace(model.unknown, log_weight=part.unknown.log_weight),
        temperature=part.temperature,
        doubt=_doubt(part, held_out),
        spectrum=spectrum,
        inputs=inputs,
        made_by=made_by,
    )


def _with_alarm(model: TerrainModel, stretches: Sequence[tuple[list[Window], str]]) -> TerrainModel:
    """The model with the alarm of a change, by stretches that it was not fitted to."""
    spectrum = model.spectrum
    if spectrum is not None:
        alarm = alarm_precision(spectrum, [windows for windows, _ in stretches])
        spectrum = dataclasses.replace(spectrum, alarm=alarm)
    return dataclasses.replace(model, spectrum=spectrum)


def _doubt(model: TerrainModel, runs: Sequence[LoggedRun]) -> float:
    """The doubt of a model by which runs that it was not fitted to are most likely."""
    classes, true = (*model.classes, UNKNOWN), list[float]()
    for run in runs:
        detector = TerrainDetector(model, classes)
        for window, ground in zip(run.route.windows, run.route.labels, strict=True):
            true.append(float(detector.update(window)[classes.index(str(ground))]))
    p = np.array(true)
    return max(DOUBTS, key=lambda doubt: float(np.log((1.0 - doubt) * p + doubt / len(classes)).sum()))


def cross_validated(runs: Sequence[LoggedRun]) -> tuple[DetectorScores, DetectorScores | None]:
    """Scores of every run by a model of the other folds; and along routes over several grounds, spliced from
    the runs of each fold: None where no fold has two grounds.

    Raises:
        DataError: as `train_on`, also where a fold leaves a ground with a single run.
    """
    check_runs(runs, MIN_RUNS + 1)
    fold_of = assign_folds(runs, FOLDS)
    tried: list[tuple[TerrainModel, LabelledRoute]] = []
    spliced: list[tuple[TerrainModel, LabelledRoute]] = []
    for fold in sorted(set(fold_of)):
        model = train_on([run for run, f in zip(runs, fold_of, strict=True) if f != fold], {})
        held_out = [run for run, f in zip(runs, fold_of, strict=True) if f == fold]
        tried += [(model, run.route) for run in held_out]
        stretches = [piece for run in held_out for piece in pieces(run)]
        if len({ground for _, ground in long_stretches(stretches)}) > 1:
            spliced.append((model, splice(stretches, PATCHES, fold)))
    return evaluate(tried), evaluate(spliced) if spliced else None


def scores_on(model: TerrainModel, runs: Sequence[LoggedRun]) -> DetectorScores:
    """Scores of a model on runs that it was not trained on.

    Raises:
        DataError: a ground without a class in the model, or another vehicle.
    """
    strange = sorted(set().union(*(run.grounds() for run in runs)) - set(model.classes))
    if strange:
        raise DataError(
            f"the model does not know {', '.join(strange)}",
            channel="terrain",
            remedy=f"give runs on {', '.join(model.classes)}",
        )
    return evaluate([(model, run.route) for run in runs])


def check_runs(runs: Sequence[LoggedRun], least: int = MIN_RUNS) -> None:
    """Refuse fewer than two grounds, or one with fewer than `least` runs (DataError)."""
    counts = Counter(ground for run in runs for ground in run.grounds())
    spelt: dict[str, str] = {}
    for ground in sorted(counts):
        like = spelt.setdefault(
            "_".join(ground.replace("-", " ").replace("_", " ").casefold().split()), ground
        )
        if like != ground:
            raise DataError(
                f"grounds '{like}' and '{ground}' differ in spelling alone",
                channel="terrain",
                remedy="give them one name in the logs",
            )
    if len(counts) < 2:
        raise DataError("training needs at least two grounds", channel="terrain", remedy="give more logs")
    for ground, count in sorted(counts.items()):
        if count < least:
            raise DataError(
                f"ground '{ground}' has {counted(count, 'run')}, {least} are needed to leave one out",
                channel="terrain",
                remedy="give more runs of it, or none",
            )


def _check_halves(fitted_to: Sequence[LoggedRun], stretches: Sequence[tuple[list[Window], str]]) -> None:
    """Refuse a half to fit to that lacks a ground of the other, or one to calibrate on without a change."""
    lacking = {ground for _, ground in stretches}.difference(*(run.grounds() for run in fitted_to))
    if lacking:
        raise DataError(
            f"no two halves of the runs both have {', '.join(sorted(lacking))}",
            channel="terrain",
            remedy="give more runs of it, or runs on one ground each",
        )
    if len({ground for _, ground in long_stretches(stretches)}) < 2:
        raise DataError(
            "half of the runs lack two grounds with over 5 s of driving at a stretch",
            channel="terrain",
            remedy="give longer runs, or labels that change less often",
        )


def assign_folds(runs: Sequence[LoggedRun], folds: int) -> list[int]:
    """The fold of each run: the runs of a ground, longest first, are dealt out in turn.

    A run over several grounds goes where they are rarest, so that every fold has of each.
    """
    order = sorted(range(len(runs)), key=lambda i: (min(runs[i].grounds()), -len(runs[i].route.windows)))
    total = Counter(ground for run in runs for ground in run.grounds())
    dealt = [Counter[str]() for _ in range(folds)]
    fold_of = [0] * len(runs)
    for place, i in enumerate(order):
        grounds = sorted(runs[i].grounds())
        fold_of[i] = min(
            range(folds),
            key=lambda f: (sum(dealt[f][g] / total[g] for g in grounds), (f - place) % folds),
        )
        dealt[fold_of[i]].update(grounds)
    return fold_of


def pieces(run: LoggedRun) -> list[tuple[list[Window], str]]:
    """The windows of each stretch of a run on one ground."""
    route, ends = run.route, [*run.route.starts[1:], len(run.route.windows)]
    return [
        (route.windows[a:b], str(route.labels[a])) for a, b in zip(route.starts, ends, strict=True) if b > a
    ]


def _fitted(runs: Sequence[LoggedRun]) -> TerrainModel:
    rows: dict[str, list[Array]] = {}
    spectra: dict[str, list[Array]] = {}
    for windows, ground in (piece for run in runs for piece in pieces(run)):
        rows.setdefault(ground, []).append(features_of(windows))
        spectra.setdefault(ground, []).extend(window.bands for window in windows)
    x = {ground: np.vstack(parts) for ground, parts in sorted(rows.items())}
    everywhere = np.all([np.isfinite(one).any(axis=0) for one in x.values()], axis=0)
    model = draft({ground: np.where(everywhere, one, np.nan) for ground, one in x.items()}, runs[0].vehicle)
    levels = {ground: np.array(spectra[ground]) for ground in x}
    return dataclasses.replace(model, spectrum=fit_spectrum(levels))
