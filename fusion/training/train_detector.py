"""Training of the terrain model on simulated runs.

Three disjoint sets of seeds: for the densities, for the calibration of temperature and weight of `unknown`,
and for the scores.
"""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.yaml_file import dump_yaml
from terrafusion.fusion.terrain.classifier import SCHEMA, UNKNOWN, LikelihoodTable, Mixture, TerrainModel
from terrafusion.fusion.terrain.features import FEATURES, MIN_SPEED_MPS, SLIP, Window, extract
from terrafusion.fusion.terrain.sequence import PatchFilter
from terrafusion.fusion.terrain.spectrum import SpectrumClassifier
from terrafusion.fusion.training.detector_scores import DetectorScores, LabelledRoute, evaluate, splice
from terrafusion.fusion.training.mixture import fit_best
from terrafusion.fusion.training.simulated_runs import (
    GROUNDS,
    PAYLOADS_KG,
    SCENARIOS,
    SLOPES_DEG,
    Condition,
    Grid,
    windows_of,
)
from terrafusion.fusion.training.window_store import WindowStore
from terrafusion.twin.executors import Workers, open_workers
from terrafusion.twin.model.version import model_sha256, version

LabelledWindows = tuple[list[Window], str]

CALIBRATION_SEED, SCORING_SEED, FRESH_SEED = 1000, 2000, 3000
PATCH_LENGTH_M = 25.0
SIGMA_FLOOR = np.array([0.03] * SLIP + [0.02, 0.05])
NEVER_SEEN = 1.0
"""1 sigma of a feature that no ground shows, so that it says nothing."""
UNKNOWN_SPREAD = 3.0
"""Standard deviations of `unknown` over those of all grounds pooled."""
UNKNOWN_SHARE = 0.03
TEMPERATURES = np.round(np.geomspace(2.0, 20.0, 11), 3)
"""From 2 up: windows overlap by half."""
PATCHES = 60


@dataclass(frozen=True)
class TrainingPlan:
    """Runs of a training: `seeds` seeds for the densities, one each for calibration and scores."""

    seeds: int = 3
    scenarios: tuple[str, ...] = SCENARIOS
    slopes_deg: tuple[float, ...] = SLOPES_DEG
    payloads_kg: tuple[float, ...] = PAYLOADS_KG

    def grid(self, *seeds: int) -> Grid:
        """The runs of given seeds."""
        return Grid(self.scenarios, self.slopes_deg, self.payloads_kg, seeds, GROUNDS)

    def training(self) -> Grid:
        """The runs to which the densities are fitted."""
        return self.grid(*range(self.seeds))

    def runs(self) -> int:
        """Total number of runs."""
        return (self.seeds + 2) * len(self.grid(0).conditions())


def train(
    plan: TrainingPlan,
    tick: Callable[[], None] = lambda: None,
    *,
    jobs: int = 1,
    backend: str = "loky",
    address: str | None = None,
    parts: Path | None = None,
) -> tuple[TerrainModel, DetectorScores]:
    """Simulate, fit, calibrate and score; `tick` is called after each run.

    Args:
        jobs: processes on this machine.
        backend: "loky" (this machine) or "dask", then with the `address` of its scheduler.
        parts: folder for finished runs, from which an interrupted training continues; removed at the end.

    Raises:
        TerrafusionError: too few windows on a ground, workers died, or the folder cannot be written.
    """
    store = (
        None if parts is None else WindowStore(parts, f"{version()} {model_sha256()} {fingerprint_of(plan)}")
    )
    sets = (plan.training(), plan.grid(CALIBRATION_SEED), plan.grid(SCORING_SEED))
    conditions = [condition for grid in sets for condition in grid.conditions()]
    with open_workers(backend, min(jobs, len(conditions)), address) as workers:
        runs = run_windows(conditions, workers, store, tick)
    ends = np.cumsum([len(grid.conditions()) for grid in sets])
    training, calibration, scoring = runs[: ends[0]], runs[ends[0] : ends[1]], runs[ends[1] :]
    rows: dict[str, list[Array]] = {ground: [] for ground in GROUNDS}
    for windows, ground in training:
        rows[ground].append(features_of(windows))
    fitted = dataclasses.replace(
        draft({ground: np.vstack(features) for ground, features in rows.items()}, plan.training().vehicle),
        inputs_sha256=fingerprint_of(plan),
        made_by=f"terrafusion terrain train --seeds {plan.seeds}",
    )
    model = calibrate(fitted, splice(calibration, PATCHES, CALIBRATION_SEED))
    scores = evaluate([(model, splice(scoring, PATCHES, SCORING_SEED))])
    if store is not None:
        store.clear()
    return dataclasses.replace(model, scores=_plain(scores)), scores


def draft(rows: dict[str, Array], vehicle: str) -> TerrainModel:
    """Densities of the features (n, 7) of each ground, not yet calibrated. A feature that no ground shows
    has the same wide density on all of them.

    Raises:
        TerrafusionError: too few windows on a ground.
    """
    seen = np.any([np.isfinite(x).any(axis=0) for x in rows.values()], axis=0)
    floor = np.where(seen, SIGMA_FLOOR, NEVER_SEEN)
    mixtures = {}
    for ground, x in rows.items():
        try:
            mixtures[ground] = fit_best(x, floor, SLIP)
        except ValueError as error:
            raise TerrafusionError(
                str(error), channel=ground, remedy="train with more drives on that ground"
            ) from None
    return TerrainModel(mixtures, _broad(mixtures), 1.0, PATCH_LENGTH_M, (vehicle,))


def fresh_routes(seeds: int, tick: Callable[[], None] = lambda: None) -> list[LabelledRoute]:
    """Routes spliced from simulated runs of new seeds."""
    return [
        splice(run_windows(TrainingPlan().grid(seed).conditions(), Workers(None), None, tick), PATCHES, seed)
        for seed in range(FRESH_SEED, FRESH_SEED + seeds)
    ]


def run_windows(
    conditions: Sequence[Condition], workers: Workers, store: WindowStore | None, tick: Callable[[], None]
) -> list[LabelledWindows]:
    """The windows and ground of every run, in order; `store` keeps those of finished ones."""
    windows = [None if store is None else store.read(number) for number in range(len(conditions))]
    missing = [number for number, stored in enumerate(windows) if stored is None]
    for _ in range(len(conditions) - len(missing)):
        tick()
    for number, made in workers.results(_numbered, ((number, conditions[number]) for number in missing)):
        windows[number] = made
        if store is not None:
            store.write(number, made)
        tick()
    return [(made or [], one.terrain) for made, one in zip(windows, conditions, strict=True)]


def _numbered(number: int, condition: Condition) -> tuple[int, list[Window]]:
    """Simulates one run, on a worker."""
    return number, windows_of(condition.run(), condition.stream("estimator"))[0]


def features_of(windows: list[Window]) -> Array:
    """Features (n, 7) of the moving windows with any observed feature."""
    x = np.array([extract(w)[0] for w in windows if w.ground_speed_mps() > MIN_SPEED_MPS])
    if not len(x):
        return np.empty((0, len(FEATURES)))
    return np.asarray(x[np.isfinite(x).any(axis=1)])


def calibrate(model: TerrainModel, route: LabelledRoute) -> TerrainModel:
    """Temperature by the filtered log score of the true ground, then the weight of `unknown`.

    The weight is the largest power of ten for which at most `UNKNOWN_SHARE` of the windows become unknown.
    """
    evidence = _evidence(model, route)
    temperature = min((float(t) for t in TEMPERATURES), key=lambda t: _log_loss(model, evidence, t, 0.0)[0])
    for exponent in range(0, -13, -1):
        log_weight = np.log(10.0) * exponent
        if _log_loss(model, evidence, temperature, log_weight)[1] <= UNKNOWN_SHARE:
            break
    weighted = dataclasses.replace(model.unknown, log_weight=np.array([log_weight]))
    return dataclasses.replace(model, unknown=weighted, temperature=temperature)


def _evidence(model: TerrainModel, route: LabelledRoute) -> list[tuple[float, Array, int]]:
    """Distance driven, untempered log-likelihoods (k,) and true class of every moving window."""
    classes = (*model.classes, UNKNOWN)
    table, spectrum = LikelihoodTable(dataclasses.replace(model, temperature=1.0), classes), model.spectrum
    return [
        (
            w.ground_speed_mps() * w.dt_s,
            table.of_window(w, None if spectrum is None else spectrum.log_odds(w)),
            classes.index(str(label)),
        )
        for w, label in zip(route.windows, route.labels, strict=True)
        if w.ground_speed_mps() > MIN_SPEED_MPS
    ]


def _log_loss(
    model: TerrainModel,
    evidence: list[tuple[float, Array, int]],
    temperature: float,
    unknown_log_weight: float,
) -> tuple[float, float]:
    """Mean -log posterior of the true ground along a route, and the share of windows called unknown."""
    patch = PatchFilter(len(model.classes) + 1, model.patch_length_m)
    weight = np.append(np.zeros(len(model.classes)), unknown_log_weight)
    loss, unknown = 0.0, 0
    for distance, log_likelihood, true in evidence:
        patch.predict(distance)
        p = patch.update((log_likelihood + weight) / temperature)
        loss -= float(np.log(p[true]))
        unknown += int(p.argmax() == len(p) - 1)
    return loss / len(evidence), unknown / len(evidence)


def _broad(mixtures: dict[str, Mixture]) -> Mixture:
    """Moment match of all grounds with equal weight, `UNKNOWN_SPREAD` times wider."""
    weight = np.concatenate([np.exp(m.log_weight) for m in mixtures.values()]) / len(mixtures)
    means = np.concatenate([m.mean for m in mixtures.values()])
    covariances = np.concatenate([m.covariance for m in mixtures.values()])
    mean = weight @ means
    centred = means - mean
    covariance = np.tensordot(weight, covariances, 1) + (weight[:, None] * centred).T @ centred
    return Mixture(np.zeros(1), mean[None], UNKNOWN_SPREAD**2 * covariance[None])


def fingerprint_of(plan: TrainingPlan) -> str:
    """SHA-256 of the parameter files and settings that a model of `plan` depends on."""
    settings = {
        "plan": dataclasses.asdict(plan),
        "features": list(FEATURES),
        "sigma_floor": SIGMA_FLOOR.tolist(),
        "unknown": [UNKNOWN_SPREAD, UNKNOWN_SHARE],
        "patch_length_m": PATCH_LENGTH_M,
    }
    return plan.training().fingerprint(settings=settings)


def _plain(scores: DetectorScores) -> dict[str, Any]:
    """Scores that are equal on every machine, rounded."""
    median, p95, largest = scores.switch_delay_s
    return {
        "held_out_windows": scores.windows,
        "macro_f1": round(scores.macro_f1, 4),
        "ece": round(scores.ece, 4),
        "unknown_share": round(scores.unknown_share, 4),
        "switch_delay_s": {"median": median, "p95": round(p95, 3), "max": largest},
        "switches_missed": round(scores.switches_missed, 4),
        "false_switches_per_min": round(scores.false_switches_per_min, 3),
    }


def write_model(model: TerrainModel, path: Path) -> None:
    """Write the model as YAML, six significant digits, byte for byte repeatable."""
    content = {
        "schema": SCHEMA,
        "made_by": model.made_by,
        "inputs_sha256": model.inputs_sha256,
        "vehicles": list(model.vehicles),
        "features": list(FEATURES),
        "temperature": model.temperature,
        "patch_length_m": model.patch_length_m,
        "classes": {name: _listed(mixture) for name, mixture in model.classes.items()},
        "unknown": _listed(model.unknown),
        "scores": model.scores,
        **({"doubt": model.doubt} if model.doubt else {}),
        **({} if model.spectrum is None else {"spectrum": _spectrum(model.spectrum)}),
        **({"inputs": model.inputs} if model.inputs else {}),
    }
    dump_yaml(path, content, default_flow_style=None, width=110)


def _digits(x: Any) -> Any:
    return [_digits(v) for v in x] if isinstance(x, list) else float(f"{x:.6g}")


def _spectrum(classifier: SpectrumClassifier) -> dict[str, Any]:
    def by_ground(rows: Array) -> dict[str, Any]:
        return dict(zip(classifier.grounds, _digits(rows.tolist()), strict=True))

    return {
        "mean": _digits(classifier.mean.tolist()),
        "scale": _digits(classifier.scale.tolist()),
        "weights": by_ground(classifier.weights),
        "offsets": by_ground(classifier.offsets),
        "alarm": by_ground(classifier.alarm),
    }


def _listed(mixture: Mixture) -> list[dict[str, Any]]:
    return [
        {"weight": _digits(float(np.exp(w))), "mean": _digits(m.tolist()), "covariance": _digits(c.tolist())}
        for w, m, c in zip(mixture.log_weight, mixture.mean, mixture.covariance, strict=True)
    ]
