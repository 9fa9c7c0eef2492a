"""Evaluation of labelled logs, as `terrafusion terrain eval LOGS` prints it."""

import dataclasses
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import DataError
from terrafusion.fusion.training.change_detection import MIN_RUN_S, changes_seen
from terrafusion.fusion.training.cross_validation import (
    FOLDS,
    MIN_RUNS,
    LabelledRun,
    assign_folds,
    check_runs,
    cross_validate,
    labels_of,
    scores_of,
    train_on,
    window_ms,
)
from terrafusion.fusion.training.softmax import SoftmaxModel, fit_softmax
from terrafusion.fusion.training.surface_features import GROUPS, SURFACE_FEATURES

STEPS = 5 + len(GROUPS)
"""Number of calls of `tick` in `report_on`."""
ABLATION_TEMPERATURE = 8.0
"""Calibrated once with all features, not again without a group of them."""


def report_on(
    runs: Sequence[LabelledRun], others: Sequence[LabelledRun] = (), tick: Callable[[], None] = lambda: None
) -> dict[str, Any]:
    """All scores of one set of labelled runs, and of a model of it on `others`, as a JSON object.

    Raises:
        ConfigError: fewer than two grounds.
        DataError: a ground with a single run.
    """
    check_runs(runs)
    folded = cross_validate(runs)
    tick()
    held_out = [
        [(r.signals, r.label) for r, f in zip(runs, folded.fold_of, strict=True) if f == fold]
        for fold in range(FOLDS)
    ]
    changes = changes_seen(folded.models, held_out)
    report: dict[str, Any] = {
        "runs": {
            f"fold {k}": [r.name for r, f in zip(runs, folded.fold_of, strict=True) if f == k]
            for k in range(FOLDS)
        },
        "temperatures": [m.temperature for m in folded.models],
        "window by window": dataclasses.asdict(folded.scores(filtered=False)),
        "filtered": dataclasses.asdict(folded.scores()),
        "changes of ground": None if changes is None else dataclasses.asdict(changes),
        "window_ms": window_ms(folded.models[0], max(runs, key=lambda r: len(r.x))),
    }
    tick()
    report["ablation"] = ablation(runs, tick)
    report["reference"] = {
        "extra trees, by run": trees(runs, assign_folds(runs)),
        "split that leaks": leaking(runs),
    }
    tick()
    report["ground never seen"] = never_seen(runs)
    tick()
    if others:
        report["other set"] = transfer(runs, others)
    return report


def ablation(runs: Sequence[LabelledRun], tick: Callable[[], None]) -> dict[str, dict[str, float]]:
    """Macro-F1 by run without each feature group, and with it alone."""
    table: dict[str, dict[str, float]] = {}
    for name, features in {"nothing": (), **GROUPS}.items():
        rest = [f for f in SURFACE_FEATURES if f not in features]
        table[name] = {"without": _f1(runs, rest)}
        if features:
            table[name]["alone"] = _f1(runs, features)
        tick()
    return table


def trees(runs: Sequence[LabelledRun], fold_of: NDArray[np.intp]) -> float:
    """Macro-F1 of single windows, of extremely randomised trees (Geurts et al. 2006) on the same folds."""
    x, y, fold = _stacked(runs, fold_of)
    return _tree_f1(x, y, fold)


def leaking(runs: Sequence[LabelledRun]) -> dict[str, float]:
    """Macro-F1 with folds of windows instead of runs: overlapping windows leak from training into test."""
    x, y, _ = _stacked(runs, assign_folds(runs))
    fold = np.random.default_rng(0).permutation(len(x)) % FOLDS
    p = np.zeros((len(x), len(set(y.tolist()))))
    for k in range(FOLDS):
        model = fit_softmax(x[fold != k], y[fold != k].tolist())
        p[fold == k] = np.exp(model.log_probabilities(x[fold == k]))
    return {
        "softmax": scores_of(model.classes, runs, [p]).macro_f1,
        "extra trees": _tree_f1(x, y, fold),
    }


def never_seen(runs: Sequence[LabelledRun]) -> dict[str, dict[str, float]]:
    """Share of windows beyond the novelty threshold, of a ground left out of training and of known ones."""
    shares: dict[str, dict[str, float]] = {}
    fold_of = assign_folds(runs)
    for ground in sorted({r.label for r in runs}):
        known = [r for r, f in zip(runs, fold_of, strict=True) if r.label != ground and f != 0]
        test = [r for r, f in zip(runs, fold_of, strict=True) if r.label != ground and f == 0]
        counts = Counter(r.label for r in known)
        if len(counts) < 2 or max(counts.values()) < MIN_RUNS or not test:
            continue
        model = train_on(known)
        odd = {
            name: float(np.mean(model.oddness(np.vstack([r.x for r in part])) > model.odd_distance))
            for name, part in (("left out", [r for r in runs if r.label == ground]), ("known", test))
        }
        shares[ground] = odd
    return shares


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
        model = train_on(here, features, ABLATION_TEMPERATURE)
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
            *_table(figures),
        ]
    return lines


def lines_of(report: dict[str, Any]) -> list[str]:
    """The report as lines of text."""
    lines = [f"{fold}: {', '.join(names)}" for fold, names in report["runs"].items()]
    lines += figures_lines(report)
    lines += [
        "",
        _change(report["changes of ground"]),
        f"one window {report['window_ms']:.2f} ms",
        "",
        "macro-F1 without a feature group, and with it alone:",
    ]
    for name, row in report["ablation"].items():
        alone = f"{row['alone']:.3f}" if "alone" in row else ""
        lines.append(f"{name:26s} {row['without']:.3f} {alone}")
    reference = report["reference"]
    leak = reference["split that leaks"]
    lines += [
        "",
        f"extra trees, window by window, by run {reference['extra trees, by run']:.3f}; "
        "windows of one run in training and test: "
        f"softmax {leak['softmax']:.3f}, extra trees {leak['extra trees']:.3f}",
        "",
        "classified as unknown, of a ground left out of the training and of known ground:",
        *(
            f"{ground:14s} {s['left out']:.3f} {s['known']:.3f}"
            for ground, s in report["ground never seen"].items()
        ),
    ]
    other = report.get("other set", {})
    if "there" in other:
        lines += [
            "",
            f"trained here, tested on the other set ({', '.join(other['common grounds'])}): "
            f"macro-F1 {other['there']['macro_f1']:.3f}; the other way {other['back']['macro_f1']:.3f}; "
            f"classified as unknown there {other['odd']:.3f}",
        ]
    return lines


def _change(change: dict[str, Any] | None) -> str:
    if change is None:
        return f"change of ground: not measured, no fold has two grounds with runs above {MIN_RUN_S:g} s"
    return (
        f"change of ground detected after {change['median_s']:.1f} s (median), "
        f"{change['p95_s']:.1f} s (95 %); within 2 s "
        f"{change['within_2_s']:.0%}, missed {change['never']:.0%} of {change['changes']}; alarm within 2 s "
        f"{change['alarms']:.0%}, false alarms {change['false_alarms']:.2f} a minute"
    )


def _table(figures: dict[str, Any]) -> list[str]:
    head = " " * 14 + " ".join(f"{c:>12s}" for c in figures["classes"])
    rows = zip(figures["classes"], figures["confusion"], strict=True)
    return [head, *(f"{c:14s}" + " ".join(f"{share:12.3f}" for share in row) for c, row in rows)]


def _odd(
    runs: Sequence[LabelledRun], others: Sequence[LabelledRun], features: Sequence[str]
) -> NDArray[np.bool_]:
    model = train_on(runs, features)
    return np.asarray(model.oddness(np.vstack([r.x for r in others])) > model.odd_distance)


def _f1(runs: Sequence[LabelledRun], features: Sequence[str]) -> float:
    return cross_validate(runs, features, ABLATION_TEMPERATURE).scores().macro_f1


def _stacked(
    runs: Sequence[LabelledRun], fold_of: NDArray[np.intp]
) -> tuple[Array, NDArray[Any], NDArray[np.intp]]:
    x = np.vstack([r.x for r in runs])
    return x, np.array(labels_of(runs)), np.repeat(fold_of, [len(r.x) for r in runs])


def _tree_f1(x: Array, y: NDArray[Any], fold: NDArray[np.intp]) -> float:
    from sklearn.ensemble import ExtraTreesClassifier
    from sklearn.metrics import f1_score

    filled = np.where(np.isfinite(x), x, 0.0)
    named = np.empty(len(y), dtype=object)
    for k in np.unique(fold):
        forest = ExtraTreesClassifier(200, min_samples_leaf=2, class_weight="balanced", random_state=0)
        named[fold == k] = forest.fit(filled[fold != k], y[fold != k]).predict(filled[fold == k])
    return float(f1_score(y, named.astype(str), average="macro"))
