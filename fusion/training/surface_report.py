"""Evaluation of labelled logs, as `terrafusion terrain eval LOGS` prints it."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.errors import DataError
from terrafusion.fusion.training.cross_validation import (
    FOLDS,
    LabelledRun,
    check_runs,
    cross_validate,
    scores_of,
    train_on,
    window_ms,
)
from terrafusion.fusion.training.detector_scores import confusion_lines
from terrafusion.fusion.training.softmax import SoftmaxModel
from terrafusion.fusion.training.surface_features import SURFACE_FEATURES

FIXED_TEMPERATURE = 8.0
"""Calibrated once with all features, not again with fewer of them."""


def report_on(runs: Sequence[LabelledRun], others: Sequence[LabelledRun] = ()) -> dict[str, Any]:
    """Scores of labelled runs, cross-validated by run, and of a model of them on `others`, as a JSON object.

    Raises:
        ConfigError: fewer than two grounds.
        DataError: a ground with a single run.
    """
    check_runs(runs)
    folded = cross_validate(runs)
    report: dict[str, Any] = {
        "runs": {
            f"fold {k}": [r.name for r, f in zip(runs, folded.fold_of, strict=True) if f == k]
            for k in range(FOLDS)
        },
        "temperatures": [m.temperature for m in folded.models],
        "window by window": dataclasses.asdict(folded.scores(filtered=False)),
        "filtered": dataclasses.asdict(folded.scores()),
        "window_ms": window_ms(folded.models[0], max(runs, key=lambda r: len(r.x))),
    }
    if others:
        report["other set"] = transfer(runs, others)
    return report


def transfer(runs: Sequence[LabelledRun], others: Sequence[LabelledRun]) -> dict[str, Any]:
    """A model of `runs` on another set, with the features of that set, on the grounds of both."""
    common = sorted({r.label for r in runs} & {r.label for r in others})
    test = [r for r in others if r.label in common]
    if len(common) < 2:
        return {"common grounds": common}
    x = np.vstack([r.x for r in test])
    features = [name for i, name in enumerate(SURFACE_FEATURES) if np.isfinite(x[:, i]).any()]
    result: dict[str, Any] = {"common grounds": common, "inputs": features}
    for name, train, on in (("there", runs, test), ("back", test, runs)):
        here = [r for r in train if r.label in common]
        back = [r for r in on if r.label in common]
        model = train_on(here, features, FIXED_TEMPERATURE)
        x = np.vstack([r.x for r in back])
        single = scores_of(model.classes, back, [np.exp(model.log_probabilities(x))])
        result[name] = dataclasses.asdict(single)
    result["odd"] = float(np.mean(_odd(runs, test, features)))
    return result


def score(model: SoftmaxModel, runs: Sequence[LabelledRun]) -> dict[str, Any]:
    """Scores of a model on runs that it was not trained on, as a JSON object.

    Raises:
        DataError: a ground without a class in the model.
    """
    unknown = sorted({r.label for r in runs} - set(model.classes))
    if unknown:
        raise DataError(
            f"the model does not know {', '.join(unknown)}",
            channel="terrain",
            remedy=f"give runs on {', '.join(model.classes)}",
        )
    probabilities = {
        "window by window": [np.exp(model.log_probabilities(r.x)) for r in runs],
        "filtered": [model.filtered(r.windows) for r in runs],
    }
    return {name: dataclasses.asdict(scores_of(model.classes, runs, p)) for name, p in probabilities.items()}


def figures_lines(report: dict[str, Any]) -> list[str]:
    """Scores of single windows and of the filter, as lines of text."""
    lines: list[str] = []
    for name in ("window by window", "filtered"):
        figures = report[name]
        lines += [
            "",
            f"{name}: macro-F1 {figures['macro_f1']:.3f}, accuracy {figures['accuracy']:.3f}, "
            f"ECE {figures['ece']:.3f}, {figures['windows']} windows",
            *confusion_lines(figures["classes"], figures["confusion"]),
        ]
    return lines


def lines_of(report: dict[str, Any]) -> list[str]:
    """The report as lines of text."""
    lines = [f"{fold}: {', '.join(names)}" for fold, names in report["runs"].items()]
    lines += [*figures_lines(report), "", f"one window {report['window_ms']:.2f} ms"]
    other = report.get("other set", {})
    if "there" in other:
        lines += [
            "",
            f"trained here, tested on the other set ({', '.join(other['common grounds'])}): "
            f"macro-F1 {other['there']['macro_f1']:.3f}; the other way {other['back']['macro_f1']:.3f}; "
            f"classified as unknown there {other['odd']:.3f}",
        ]
    return lines


def _odd(
    runs: Sequence[LabelledRun], others: Sequence[LabelledRun], features: Sequence[str]
) -> NDArray[np.bool_]:
    model = train_on(runs, features)
    return np.asarray(model.oddness(np.vstack([r.x for r in others])) > model.odd_distance)
