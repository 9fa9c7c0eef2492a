"""From recordings to evidence: one twin, set to the references, and what each run says against it."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.calibrate.log import PreparedLog, grounds, prepare
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.calibrate.noise import ResidualNoise
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.null.channel_noise import learnt_noise
from terrafusion.twin.gap.rollout.batch import in_threads
from terrafusion.twin.gap.rollout.outliers import bounded
from terrafusion.twin.gap.rollout.residuals import (
    SOIL_STATE,
    Drives,
    Evidence,
    Raw,
    at_own_ground,
    raw,
    reach,
    state_sigmas,
    whitened,
    whitened_error,
    without_probes,
)
from terrafusion.twin.gap.rollout.sensitivities import Ask, Drive, settled_predictions
from terrafusion.twin.model.soil import SoilParams, load_soil
from terrafusion.twin.model.vehicle import VehicleParams, geometry_notes, reported_geometry, with_overrides

Array = NDArray[np.float64]
Soils = str | Path | SoilParams | Mapping[str, str | Path | SoilParams] | None

WINDOW_S = 10.0
"""The pose starts anew after so long."""
BASE_RUNS, BASE_STEPS = 3, 5
"""References by which the ground is set, and steps of that search at most."""
BASE_MOVED, MOST_STEP = 0.1, 1.0
"""The search ends with a step shorter than the first, and takes none longer than the second (typical
sizes)."""
GENERIC_GROUND = "medium_sand"
"""Stands in where a log says no ground that is known; the references then set its strength."""


@dataclass(frozen=True, eq=False)
class Bench:
    """Everything that a diagnosis compares.

    Attributes:
        model: the twin, its ground set to the references.
        candidates: effects.
        channels: observed channels, those of the probes.
        noise: of each channel.
        runs, references: evidence of each.
        reach: (S,) how far a judged run's ground may lie from the model's, typical sizes.
        drives: signatures, shared by runs that were told the same.
        notes: what was assumed, in sentences.
        jobs: threads.
    """

    model: Model
    candidates: Candidates
    channels: tuple[str, ...]
    noise: dict[str, ResidualNoise]
    runs: list[Evidence]
    references: list[Evidence]
    raws: list[Raw]
    reach: Array
    drives: Drives
    notes: tuple[str, ...]
    jobs: int = 1


def starting_model(
    recordings: Sequence[Recording], vehicle: VehicleParams, soils: Soils
) -> tuple[Model, str | None, list[str]]:
    """The twin before anything is learnt, the one ground of all logs where one is given, and notes.

    Raises:
        ConfigError: a soil that was named is not known.
        DataError: the logs tell different geometries.
    """
    told = reported_geometry(recordings)
    loaded, notes = with_overrides(vehicle, told), list(geometry_notes(vehicle, told))
    if soils is not None and not isinstance(soils, Mapping):
        soil = soils if isinstance(soils, SoilParams) else load_soil(soils)
        return Model(loaded, {soil.name: soil}, loaded.effects), soil.name, notes
    given, found = dict(soils or {}), dict[str, SoilParams]()
    for recording in recordings:
        for label in dict.fromkeys(grounds(recording, recording.start_ns)[0]):
            if label in found:
                continue
            try:
                named = given.get(label, label)
                found[label] = named if isinstance(named, SoilParams) else load_soil(named)
            except ConfigError:
                if label in given:
                    raise
                found[label] = load_soil(GENERIC_GROUND)
                notes.append(f"the ground '{label}' is not in the library: {GENERIC_GROUND} stands in")
    return Model(loaded, found, loaded.effects), None, notes


def prepared(
    recordings: Sequence[Recording], model: Model, ground: str | None, source: str
) -> list[PreparedLog]:
    """Logs of the recordings."""
    return [prepare(r, model, source=source, window_s=WINDOW_S, ground=ground) for r in recordings]


def common_channels(logs: Sequence[PreparedLog]) -> tuple[str, ...]:
    """Channels that every log has.

    Raises:
        DataError: there is none.
    """
    shared = [o.channel for o in logs[0].observed if all(o.channel in _names(log) for log in logs)]
    if not shared:
        raise DataError("the logs have no channel in common", remedy="diagnose logs of one robot")
    return tuple(shared)


def _names(log: PreparedLog) -> set[str]:
    return {o.channel for o in log.observed}


def restricted(log: PreparedLog, channels: Sequence[str]) -> PreparedLog:
    """The log with these channels only."""
    by_name = {o.channel: o for o in log.observed}
    return dataclasses.replace(log, observed=tuple(by_name[c] for c in channels))


def raws_of(
    logs: Sequence[PreparedLog], drives: Drives, channels: Sequence[str], jobs: int, told: Callable[[], None]
) -> list[Raw]:
    """Errors and derivatives of each run. The first run of each drive makes its signature, whichever thread
    is faster."""

    def one(log: PreparedLog) -> Raw:
        found = raw(log, drives, channels)
        told()
        return found

    first = list({drives.name(log): log for log in reversed(logs)}.values())[::-1]
    made = dict[int, Raw]()
    with ThreadPoolExecutor(jobs) as pool:
        for part in (first, [log for log in logs if not any(log is other for other in first)]):
            made.update(zip(map(id, part), pool.map(one, part), strict=True))
    return [made[id(log)] for log in logs]


def set_ground(logs: Sequence[PreparedLog], drives: Drives, channels: Sequence[str], jobs: int) -> Model:
    """The twin with its ground's strength, bearing and rolling resistance set to the references.

    The other columns take part as nuisances of typical size, so that a commissioning error does not pass
    for soil.
    """
    model, candidates = drives.model, drives.candidates
    keys = candidates.keys
    names = [name for name in SOIL_STATE if name in keys]
    soil = [keys.index(name) for name in names]
    raws = raws_of(logs[:BASE_RUNS], drives, channels, jobs, lambda: None)
    noise = learnt_noise(raws, [], candidates, jobs)
    white = [whitened(without_probes(run), noise) for run in raws]
    at, errors = (
        np.zeros(len(soil)),
        [whitened_error(r, w, noise, r.error) for r, w in zip(raws, white, strict=True)],
    )
    step = np.clip(_common_step(white, errors, candidates, soil), -MOST_STEP, MOST_STEP)

    for _ in range(BASE_STEPS):
        if np.abs(step).max(initial=0.0) < BASE_MOVED:
            break
        asks = [Ask(run.log, _ground(at + step, names, candidates, model)) for run in raws]
        moved = settled_predictions(asks, model, candidates, jobs)
        now = [
            whitened_error(run, w, noise, [o.value - y for o, y in zip(run.log.observed, told, strict=True)])
            for run, w, told in zip(raws, white, moved, strict=True)
            if told is not None
        ]
        if len(now) == len(raws) and _square(now) < _square(errors):
            at, errors = at + step, now
            step = np.clip(_common_step(white, errors, candidates, soil), -MOST_STEP, MOST_STEP)
        else:
            step = 0.4 * step
    return dataclasses.replace(model, effects={**model.effects, **_ground(at, names, candidates, model)})


def _ground(at: Array, names: Sequence[str], candidates: Candidates, model: Model) -> dict[str, float]:
    """Soil parameters that lie `at` (T,) typical sizes from the model's own, within their ranges."""
    out = {}
    for name, d in zip(names, at, strict=True):
        i = candidates.keys.index(name)
        value = model.effects.get(name, 0.0) + float(d * candidates.scale[i])
        out[name] = float(np.clip(value, 0.95 * candidates.low[i], 0.95 * candidates.high[i]))
    return out


def _square(errors: Sequence[Array]) -> float:
    return sum(float(e @ e) for e in errors)


def _common_step(
    runs: Sequence[Evidence], errors: Sequence[Array], candidates: Candidates, soil: Sequence[int]
) -> Array:
    """Step of the ground that all runs share, in typical sizes, by their whitened errors (n,)."""
    T, K = len(state_sigmas(candidates)), len(candidates.keys)
    keep = np.arange(len(soil), T)  # offsets are a run's own, the ground is not
    effect = np.arange(T, T + K)
    H, g = np.zeros((K, K)), np.zeros(K)
    for run, error in zip(runs, errors, strict=True):
        G, gain = run.gram, run.rows[:, :-1].astype(float).T @ error
        inner = np.linalg.inv(G[np.ix_(keep, keep)] + np.eye(len(keep)))
        cross = G[np.ix_(keep, effect)]
        H += G[np.ix_(effect, effect)] - cross.T @ inner @ cross
        g += gain[effect] - cross.T @ inner @ gain[keep]
    prior = np.ones(K)
    prior[list(soil)] = 0.1
    return np.asarray(np.linalg.solve(H + np.diag(prior), g)[list(soil)])


def gather(
    runs: Sequence[Recording],
    references: Sequence[Recording],
    vehicle: VehicleParams,
    soils: Soils,
    candidates: Candidates,
    *,
    source: str = "auto",
    jobs: int = 2,
    progress: Callable[[float], None] | None = None,
    kept: dict[str, Drive] | None = None,
) -> Bench:
    """Evidence of all runs; `kept` holds signatures for diagnoses to come with the same vehicle and soils.

    Where not all is compiled there is one thread (`side_by_side.in_threads`).

    Raises:
        DataError: a log without what it needs.
        TerrafusionError: the twin diverges on every reference.
    """
    jobs = jobs if in_threads(candidates) else 1
    model, ground, notes = starting_model([*runs, *references], vehicle, soils)
    logs = prepared([*runs, *references], model, ground, source)
    channels = common_channels(logs)
    logs = [restricted(log, channels) for log in logs]
    others, kept = logs[len(runs) :], {} if kept is None else kept
    if others:
        model = set_ground(others, Drives(model, candidates, kept), channels, jobs)
    drives, done = Drives(model, candidates, kept), [0]

    def told() -> None:
        done[0] += 1
        if progress is not None:
            progress(0.7 * done[0] / len(logs))

    raws = raws_of(logs, drives, channels, jobs, told)
    first = learnt_noise(raws[len(runs) :], raws[: len(runs)], candidates, jobs)
    free = at_own_ground(raws[len(runs) :], drives, first, jobs=jobs)
    most = reach(free, candidates)
    # One limit for all, or a run that is but a further reference would differ from them.
    far = [not (abs(run.own) <= most).all() for run in free]
    again = [*raws[: len(runs)], *itertools.compress(raws[len(runs) :], far)]
    limited = iter(at_own_ground(again, drives, first, most, jobs))
    judged_raws = list(itertools.islice(limited, len(runs)))
    raws = judged_raws + [next(limited) if too else run for run, too in zip(free, far, strict=True)]
    noise = learnt_noise(raws[len(runs) :], raws[: len(runs)], candidates, jobs, first)
    with ThreadPoolExecutor(jobs) as pool:
        evidence = list(pool.map(lambda run: whitened(run, noise), raws))
    judged, normal = bounded(evidence[: len(runs)], evidence[len(runs) :], state_sigmas(candidates), jobs)
    notes += [f"{log.name}: {note}" for log in logs for note in log.notes]
    return Bench(
        model, candidates, channels, noise, judged, normal,
        raws[: len(runs)], most, drives, tuple(dict.fromkeys(notes)), jobs,
    )  # fmt: skip
