"""Can wheels and IMU alone predict slip on a robot, soil or data set that nothing was fitted to?

    python -m tests.studies.slip_model.study [--drives N]

A model is fitted to a population of twin drives (`population`) and judged as `ground_split.yaml` says.
Printed for each test: windows, RMSE of the prediction, of the best constant of the fit, and of the mean slip
earlier in the same run (which the estimator has anyway, from fixes), share of windows inside the 50 and 95 %
intervals, and of intervals whose width follows the errors earlier in the run; then balanced accuracy of
slippery against firm, of real logs by their ground, of the twin by slip.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.yaml_file import read_yaml
from terrafusion.twin.model.choose import choose_vehicle
from terrafusion.twin.model.vehicle import load_vehicle
from tests.studies.field_runs import catalogued, read_runs
from tests.studies.slip_model.features import LEAST_ROLLED_M, SlipWindows, windows_of
from tests.studies.slip_model.model import SHARES, SlipModel, fit
from tests.studies.slip_model.population import drive

Array = NDArray[np.float64]

SPLIT = read_yaml(Path(__file__).parents[1] / "ground_split.yaml")
SLIPS = 0.15
"""Slip above which a window of the twin counts as slippery."""
SLIPPERY = ("medium_sand", "loose_sand", "sandy_loam", "mud", "ploughed_soil", "snow", "ice")
STEP = 0.4
"""Of the logarithm of a width that follows the run, a window (chosen on the drives of the fit)."""
PRIOR_WINDOWS = 10.0
"""Windows that the constant counts for in the mean of a run so far."""


@dataclass(frozen=True, eq=False)
class Run:
    """One run: data set or "twin", robot, soil, name, windows."""

    source: str
    robot: str
    soil: str
    name: str
    windows: SlipWindows

    @property
    def known(self) -> NDArray[np.bool_]:
        """Windows (n,) whose slip is known."""
        return np.isfinite(self.windows.slip)


def twin_runs(first: int, count: int) -> Iterator[Run]:
    """Drives of the population."""
    for seed in range(first, first + count):
        made = drive(seed)
        if made is None:
            continue
        rig = load_vehicle(made.robot).rig()
        rig = dataclasses.replace(rig, wheel_radius_m=made.wheel_radius_m, track_m=made.track_m)
        windows = windows_of(made.recording, rig)
        if windows is not None:
            yield Run("twin", made.robot, made.soil, f"seed {seed}", windows)


def real_runs() -> Iterator[Run]:
    """Real logs: those whose slip is known, then those whose ground alone is."""
    part = SPLIT["slip_model"]
    named = [(robot, name) for robot, names in part["logs_with_slip"].items() for name in names]
    for robot, prefix in part["logs_with_ground"].items():
        named += [(robot, name) for name in catalogued() if name.startswith(f"{prefix}/")]
    for robot, name in named:
        for k, recording in enumerate(read_runs(name)[0]):
            windows = windows_of(recording, choose_vehicle(recording, None)[0].rig())
            if windows is not None:
                yield Run(name.partition("/")[0], robot, recording.terrain_name, f"{name}#{k}", windows)


def stacked(runs: list[Run]) -> tuple[Array, Array]:
    """Features (n, d) and slip (n,) of all windows whose slip is known."""
    return (
        np.vstack([run.windows.x[run.known] for run in runs]),
        np.concatenate([run.windows.slip[run.known] for run in runs]),
    )


def fitted(runs: list[Run], by: str = "robot") -> SlipModel:
    """A model of runs, with the groups `by` ("robot" or "soil") left out in turn for its spread."""
    x, slip = stacked(runs)
    groups = np.concatenate([np.full(int(run.known.sum()), getattr(run, by)) for run in runs])
    return fit(x, slip, groups.tolist())


def so_far(slip: Array, constant: float) -> Array:
    """Mean slip (n,) of the windows before each, shrunk to a constant."""
    before = np.concatenate([[0.0], np.cumsum(slip)[:-1]])
    return np.asarray((before + PRIOR_WINDOWS * constant) / (np.arange(len(slip)) + PRIOR_WINDOWS))


def slip_line(name: str, model: SlipModel, constant: float, runs: list[Run]) -> str:
    """One line: how well the slip of runs is predicted."""
    runs = [run for run in runs if run.known.any()]
    x, slip = stacked(runs)
    own = np.concatenate([so_far(run.windows.slip[run.known], constant) for run in runs])
    mean, sigma = model.predict(x)
    off = np.abs(slip - mean) / sigma
    runs_off = np.split(off, np.cumsum([int(run.known.sum()) for run in runs])[:-1])
    kept = [
        np.concatenate([inside(one, factor, share) for one in runs_off])
        for factor, share in zip(model.factors, SHARES, strict=True)
    ]
    shares = [100.0 * float(np.mean(x)) for x in (*(off < f for f in model.factors), *kept)]
    rmse = [float(np.sqrt(np.mean((slip - other) ** 2))) for other in (mean, constant, own)]
    errors = f"{rmse[0]:8.3f} {rmse[1]:9.3f} {rmse[2]:8.3f}"
    return f"{name:34s} {len(slip):6d} {errors}" + "".join(f" {share:7.0f}" for share in shares)


def inside(off: Array, factor: float, share: float) -> NDArray[np.bool_]:
    """Which errors (n,) of a run, in predicted sigmas, an interval of a `share` holds.

    It is `factor` sigmas wide at first, and follows the errors before (adaptive conformal inference: Gibbs
    and Candes 2021, here on the logarithm of the width).
    """
    found, width = np.empty(len(off), dtype=bool), factor
    for i, one in enumerate(off.tolist()):
        found[i] = one < width
        width *= math.exp(STEP * (share - float(found[i])))
    return found


def slippery_line(name: str, weights: tuple[Array, Array, Array], runs: list[Run]) -> str:
    """One line: slippery against firm, by window and by run."""
    mean, scale, weight = weights
    score, true = [], []
    for run in runs:
        z = np.clip((run.windows.x - mean) / scale, -3.0, 3.0)
        used = run.known if run.source == "twin" else np.abs(run.windows.rolled_m) > LEAST_ROLLED_M
        if used.any():
            score.append((np.hstack([np.ones((len(z), 1)), z]) @ weight)[used])
            slips = run.windows.slip[used] > SLIPS
            true.append(slips if run.source == "twin" else np.full(len(slips), run.soil in SLIPPERY))
    single = balanced(np.concatenate(score) > 0.0, np.concatenate(true))
    majority = [
        np.array([np.mean(one) > limit for one in found]) for found, limit in ((score, 0.0), (true, 0.5))
    ]
    whole = balanced(*majority)
    return f"{name:34s} {len(true):4d} runs: balanced accuracy {single:.2f} by window, {whole:.2f} by run"


def balanced(said: NDArray[np.bool_], true: NDArray[np.bool_]) -> float:
    """Mean of the shares found of both classes; NaN where one is missing."""
    if true.all() or not true.any():
        return float("nan")
    return 0.5 * float(said[true].mean() + (~said[~true]).mean())


def slippery_weights(runs: list[Run]) -> tuple[Array, Array, Array]:
    """Mean, scale (d,) of features and weights (1 + d,) of a logistic regression for slip above `SLIPS`."""
    from sklearn.linear_model import LogisticRegression

    x, slip = stacked(runs)
    y = slip > SLIPS
    mean, scale = x.mean(axis=0), x.std(axis=0) + 1e-6
    z = np.clip((x - mean) / scale, -3.0, 3.0)
    regression = LogisticRegression(C=0.1, max_iter=1000, class_weight="balanced").fit(z, y)
    return mean, scale, np.concatenate([regression.intercept_, regression.coef_[0]])


def learned_before(run: Run) -> bool:
    """Whether a run of the Warthog is one of its learn runs."""
    names = [str(n) for runs in SPLIT["warthog"]["learn"].values() for n in runs]
    return any(run.name == n or run.name.partition("#")[0] == n for n in names)


def main() -> int:
    """Simulate, fit, judge, print."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.slip_model.study", description=__doc__)
    parser.add_argument("--drives", type=int, help="fewer drives of the population, to try it out")
    given = parser.parse_args()
    part, begun = SPLIT["slip_model"], time.process_time()
    count = given.drives or int(part["fit"]["drives"])
    runs = list(twin_runs(int(part["fit"]["first_seed"]), count))
    model = fitted(runs)
    spent_s = time.process_time() - begun
    print(f"{len(runs)} drives of the twin, simulated and fitted in {spent_s:.0f} s: {model.sha256()[:12]}")
    fresh = list(twin_runs(int(part["judge"]["first_seed"]), min(count, int(part["judge"]["drives"]))))
    real = list(real_runs())
    constant = float(np.mean(stacked(runs)[1]))
    print(f"{'':34s} windows  RMSE of: constant own past  50 % in  95 % in  following the run")
    print(slip_line("twin, fresh drives", model, constant, fresh))
    for by in ("robot", "soil"):
        for name in sorted({getattr(run, by) for run in runs}):
            others = [run for run in runs if getattr(run, by) != name]
            own = [run for run in [*runs, *fresh] if getattr(run, by) == name]
            mean = float(stacked(others)[1].mean())
            print(slip_line(f"twin, without {name}", fitted(others), mean, own), flush=True)
    for robot in part["logs_with_slip"]:
        print(slip_line(f"real, {robot}", model, constant, [r for r in real if r.robot == robot]))
    warthog = [run for run in real if run.robot == "warthog"]
    for soil in sorted({run.soil for run in warthog}):
        print(slip_line(f"real, warthog, {soil}", model, constant, [r for r in warthog if r.soil == soil]))
    learn = [run for run in warthog if learned_before(run)]
    judge = [run for run in warthog if not learned_before(run)]
    own_model, own_constant = fitted(learn, by="soil"), float(np.mean(stacked(learn)[1]))
    print(slip_line("own past, warthog", own_model, own_constant, judge))
    for soil in sorted({run.soil for run in judge}):
        own = [run for run in judge if run.soil == soil]
        print(slip_line(f"own past, warthog, {soil}", own_model, own_constant, own))
    weights = slippery_weights(runs)
    print(slippery_line("twin, fresh drives", weights, fresh))
    for source in ("norlab_drive", "borealtc"):
        print(slippery_line(f"twin to {source}", weights, [run for run in real if run.source == source]))
    print(slippery_line("own past, warthog", slippery_weights(learn), judge))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
