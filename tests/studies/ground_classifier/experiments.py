"""What carries the classification of a robot's own grounds, and is a ground never seen recognised as new?

    python -m tests.studies.ground_classifier.experiments

BorealTC by run, in five folds: feature groups left out and alone, extremely randomised trees, a split that
leaks, and the share of windows beyond the novelty threshold on a ground left out of the training.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.training.cross_validation import (
    FOLDS,
    MIN_RUNS,
    LabelledRun,
    assign_folds,
    cross_validate,
    labels_of,
    scores_of,
    train_on,
)
from terrafusion.fusion.training.softmax import fit_softmax
from terrafusion.fusion.training.surface_features import GROUPS, SURFACE_FEATURES
from terrafusion.fusion.training.surface_report import FIXED_TEMPERATURE
from tests.studies.ground_changes import labelled_runs


def main() -> int:
    """Print all tables."""
    print("\n".join(lines_of(labelled_runs())))
    return 0


def lines_of(runs: Sequence[LabelledRun]) -> list[str]:
    """All tables as lines of text."""
    table, leak = ablation(runs), leaking(runs)
    return [
        "macro-F1 without a feature group, and with it alone:",
        *(f"{name:26s} " + " ".join(f"{f1:.3f}" for f1 in row.values()) for name, row in table.items()),
        "",
        f"extra trees, window by window, by run {trees(runs, assign_folds(runs)):.3f}",
        "windows of one run in training and test: "
        f"softmax {leak['softmax']:.3f}, extra trees {leak['extra trees']:.3f}",
        "",
        "classified as unknown, of a ground left out of the training and of known ground:",
        *(
            f"{ground:14s} {share['left out']:.3f} {share['known']:.3f}"
            for ground, share in never_seen(runs).items()
        ),
    ]


def ablation(runs: Sequence[LabelledRun]) -> dict[str, dict[str, float]]:
    """Macro-F1 by run without each feature group, and with it alone."""
    table: dict[str, dict[str, float]] = {}
    for name, features in {"nothing": (), **GROUPS}.items():
        rest = [f for f in SURFACE_FEATURES if f not in features]
        table[name] = {"without": _f1(runs, rest)}
        if features:
            table[name]["alone"] = _f1(runs, features)
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


def _f1(runs: Sequence[LabelledRun], features: Sequence[str]) -> float:
    return cross_validate(runs, features, FIXED_TEMPERATURE).scores().macro_f1


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


if __name__ == "__main__":
    raise SystemExit(main())
