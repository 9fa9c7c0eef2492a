"""`python -m tests.studies.twin_field.single_wheel DATA --out DIR`: the wheel model on a measured wheel.

Fits soil numbers on half of the trials and predicts the other half (split by condition with a seed, and
by side-slip), beside a Coulomb wheel, a linear one, and the published numbers of the same sand. Writes
`scores.json`, `trials.csv` (measured and predicted) and `single_wheel.png`.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.errors import ConfigError, DataError, TerrafusionError
from terrafusion.datasets.core.files import unwritable
from tests.studies.twin_field import single_wheel_scores as judge
from tests.studies.twin_field.single_wheel_fit import FREE, OUTPUTS, Fit, fit, measured
from tests.studies.twin_field.wheel_trials import WheelTrials, read_wheel_trials

Array = NDArray[np.float64]


def evaluate(trials: WheelTrials, seed: int = 0) -> tuple[dict[str, Any], dict[str, Array]]:
    """Scores as written to `scores.json`, and each split's predictions (N, 3) of the fitted model.

    Args:
        trials: of one wheel.
        seed: of the split into halves and of the bootstrap.

    Raises:
        DataError: too few trials on one side of a split.
    """
    splits: dict[str, Any] = {}
    predictions: dict[str, Array] = {}
    for name, split in judge.SPLITS.items():
        rows = split(trials, seed)
        if min(rows.sum(), (~rows).sum()) < 2 * len(FREE):
            raise DataError(
                f"too few trials to split by {name}: {rows.sum()} and {(~rows).sum()}",
                remedy=f"give at least {2 * len(FREE)} on either side; 'angle' splits at 50 deg of side-slip",
            )
        found = fit(trials, rows)
        outputs = {model: function(trials, rows) for model, function in judge.MODELS.items()}
        predictions[name] = outputs["fitted"]
        splits[name] = {
            "fitted_on": int(rows.sum()),
            "scored_on": int((~rows).sum()),
            "soil": _soil(found),
            "models": {m: judge.score(trials, out, ~rows, seed) for m, out in outputs.items()},
            "in_sample": judge.score(trials, outputs["fitted"], rows, seed),
            "regions": judge.errors_by_region(trials, outputs["fitted"], ~rows),
        }
    scatter = [value if math.isfinite(value) else None for value in judge.noise_floor(trials).tolist()]
    floor = dict(zip(OUTPUTS, scatter, strict=True))
    halves = judge.repeated_halves(trials, seed)
    scores = {"trials": len(trials), "seed": seed, "noise_floor": floor, "splits": splits, "halves": halves}
    return scores, predictions


def _soil(found: Fit) -> dict[str, Any]:
    """Fitted numbers with standard errors, and the pairs that cannot be told apart."""
    names, close = list(FREE), []
    for i, j in zip(*np.triu_indices(len(names), 1), strict=True):
        if abs(found.correlation[i, j]) > 0.8:
            close.append([names[i], names[j], round(float(found.correlation[i, j]), 3)])
    rows = zip(names, found.values, found.sigma, strict=True)
    return {
        "numbers": {name: {"value": float(v), "sigma": float(s)} for name, v, s in rows},
        "correlated": close,
    }


def write(trials: WheelTrials, scores: dict[str, Any], predictions: dict[str, Array], folder: Path) -> None:
    """`scores.json`, `trials.csv` and `single_wheel.png` in `folder`.

    Raises:
        TerrafusionError: the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "scores.json").write_text(json.dumps(scores, indent=1) + "\n", encoding="utf-8")
        with (folder / "trials.csv").open("w", encoding="utf-8", newline="") as file:
            _write_rows(csv.writer(file, lineterminator="\n"), trials, predictions)
    except OSError as error:
        raise unwritable(folder, error) from None
    from tests.studies.twin_field.single_wheel_plot import plot

    figure = plot(trials, predictions["half"], judge.half_split(trials, scores["seed"]))
    figure.savefig(folder / "single_wheel.png", dpi=120)


def _write_rows(writer: Any, trials: WheelTrials, predictions: dict[str, Array]) -> None:
    head = ["slip", "side_slip_rad", "load_n", *OUTPUTS]
    writer.writerow([*head, *(f"{split}_{name}" for split in predictions for name in OUTPUTS)])
    told = np.column_stack([trials.slip, trials.side_slip_rad, trials.load_n, measured(trials)])
    for row in np.column_stack([told, *predictions.values()]):
        writer.writerow([f"{value:.6g}" for value in row])


def table(scores: dict[str, Any]) -> str:
    """The scores as text: one line a split and model, then medians and ranges over repeated halves."""
    lines = [f"{'split':6} {'model':10} " + " ".join(f"{name:>32}" for name in OUTPUTS)]
    for split, found in scores["splits"].items():
        for model, by_output in found["models"].items():
            cells = [_cell(by_output[name]) for name in OUTPUTS]
            lines.append(f"{split:6} {model:10} " + " ".join(f"{cell:>32}" for cell in cells))
    for model, spread in scores["halves"].items():
        told = [f"R2 {r[0]:.2f} from {r[1]:.2f} to {r[2]:.2f}" if r else "-" for r in spread.values()]
        lines.append(f"{'halves':6} {model:10} " + " ".join(f"{cell:>32}" for cell in told))
    floor = " ".join(f"{'-' if v is None else f'rmse {v:.3g}':>32}" for v in scores["noise_floor"].values())
    return "\n".join([*lines, f"{'noise floor':17} {floor}"])


def _cell(score: dict[str, Any]) -> str:
    if score["r2"] is None:
        return "-"
    low, high = score["r2_ci"]
    return f"R2 {score['r2']:.2f} [{low:.2f}, {high:.2f}] rmse {score['rmse']:.3g}"


def main(arguments: list[str] | None = None) -> int:
    """Runs the command; 0 when done, 1 with one line where an input is wrong."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.twin_field.single_wheel", description=__doc__
    )
    parser.add_argument("data", type=Path, help="file of trials (MATLAB v5), e.g. all_smooth_data.mat")
    parser.add_argument("--out", type=Path, required=True, help="folder for json, csv and png")
    parser.add_argument("--seed", type=int, default=0, help="of the split and of the bootstrap")
    told = parser.parse_args(arguments)
    try:
        if told.seed < 0:
            raise ConfigError(f"seed {told.seed} is negative", remedy="give a whole number from 0")
        trials = read_wheel_trials(told.data)
        scores, predictions = evaluate(trials, told.seed)
        write(trials, scores, predictions, told.out)
    except TerrafusionError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(table(scores))
    return 0


if __name__ == "__main__":
    sys.exit(main())
