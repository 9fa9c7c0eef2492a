"""Sets the twin to the robot that the reference runs show.

How all laws act depends on the ground and on how the motors follow their commands, which owners hardly know.
Effects are changes of a twin that drives as the references do: such numbers are fitted to them by damped
Gauss-Newton steps (Marquardt 1963), from the best of a few starts.
"""

import contextlib
import dataclasses
import functools
import itertools
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.config import quantities
from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.files import write_atomically
from terrafusion.twin.calibrate.coordinates import Coordinate
from terrafusion.twin.calibrate.inputs import DT_S
from terrafusion.twin.calibrate.log import PreparedLog
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.calibrate.predict import plant_of
from terrafusion.twin.calibrate.start import coordinates_of
from terrafusion.twin.engine.codegen import follows_from
from terrafusion.twin.engine.library_cache import cache_folder
from terrafusion.twin.engine.stability import stable_steps
from terrafusion.twin.gap.data.samples import driven_by
from terrafusion.twin.gap.data.threads import in_threads
from terrafusion.twin.gap.null.channel_noise import learn_noise
from terrafusion.twin.gap.rollout.batch import INTEGRATOR_ORDER
from terrafusion.twin.gap.rollout.residuals import (
    LinearisationCache,
    RunResiduals,
    WhitenedRun,
    run_residuals,
    soil_columns,
    whitened,
    whitened_error,
)
from terrafusion.twin.gap.rollout.sensitivities import Rollout, aligned_predictions
from terrafusion.twin.gap.rollout.shared_errors import ChannelNoise
from terrafusion.twin.model.vehicle import VehicleParams

RUNS = 3  # references that are used
NUMBERS = (
    "effects.soil_strength/shear", "effects.soil_strength/bearing", "soil.shear.shear_modulus_m",
    "soil.resistance.rolling", "vehicle.drive.speed_loop_p_nms", "vehicle.drive.speed_loop_i_nm",
)  # fmt: skip
"""What is fitted: strength of the ground, and how soft and how sticky it is; gains of the speed loop."""
LIMITS, DEAD_TIME = ("vehicle.drive.max_accel_mps2", "vehicle.drive.max_yaw_accel_radps2"), "dead_time_s"
"""Fitted, too, where commands drive the twin: within which limits the robot follows them, and how late."""
LIMIT_SCALE, DEAD_TIME_SCALE_S = 0.5, 0.05  # of a limit's logarithm, and of the dead time (assumed)
NOTED = 0.5  # share of a scale from which a difference from the file is noted
BASE = "vehicle.body.wheelbase_m"
"""Fitted for a robot of two driven wheels, whose casters do not scrub, where nobody measured it."""
STARTS = {"shear_modulus_m": -3.0, "speed_loop_p_nms": 2.7, "speed_loop_i_nm": -6.0, "wheelbase_m": -4.0}
"""Where the search may begin instead, in scales: ground without give, motors that follow stiffly, and ones
without an integral. From too soft a loop it would end in a minimum with too large an integral."""
LATER = 1.0  # scales of the dead time at which another search begins: robots that follow commands later
SCANNED = (-2.0, -1.4, -1.0, -0.7, -0.4, -0.2, 0.4, 1.0)
"""Where a search tries each limit of acceleration first, in scales: errors are least in a narrow valley about
the robot's own, and hardly differ beside it."""
SIGMA = 2.0  # 1 sigma of a number, in scales of `Coordinate` (assumed)
EFFECT_SIGMA = 0.1
"""1 sigma of effects beside, in typical sizes (assumed): the numbers explain what they can."""
DIFFERENCE, LONGEST = 0.25, 1.5  # step of the differences, and the longest one of the search, in scales
FIRST_STEPS, STEPS, TRIES, ENOUGH = 3, 12, 4, 0.01
"""Most steps of each first search, of the one that begins again with the noise learnt there, tries of each,
and the gain, as a share, from which one is taken: the file's numbers stay where others fit as well."""
MOST_STEPS = 4
"""Integration steps a sample beyond which harder ground and stiffer motors than the given twin's are not
tried: logs hardly tell them from softer ones, and all rollouts would take longer."""
DAMPING, LESS, MORE = 1.0, 1.0 / 6.0, 8.0
"""First damping, as a share of the information, and its factors after a step that is better, or is not."""


def all_residuals(
    logs: Sequence[PreparedLog],
    cache: LinearisationCache,
    channels: Sequence[str],
    jobs: int,
    done: Callable[[], None] = lambda: None,
    judged: int = 0,
) -> list[RunResiduals]:
    """Errors and derivatives of each run. The first run of each drive makes its linearisation, whichever
    thread is faster; the first `judged` ones come last, as the fit has references only."""

    def one(log: PreparedLog) -> RunResiduals:
        found = run_residuals(log, cache, channels)
        done()
        return found

    first = {cache.key(log): log for log in reversed([*logs[judged:], *logs[:judged]])}
    in_threads(jobs, cache.of, reversed(first.values()))
    return in_threads(jobs, one, logs)


@dataclass(frozen=True, eq=False)
class _Found:
    """Where a search is: numbers w (K,), errors (n,) of the runs (None where the twin diverges), cost and
    damping; `done` where it ends."""

    w: Array
    errors: list[Array] | None
    cost: float
    damping: float = DAMPING
    done: bool = False


@dataclass(frozen=True, eq=False)
class _Fit:
    """The fit of numbers w (K,), in scales, to runs about the given model."""

    cache: LinearisationCache
    noise: ChannelNoise
    numbers: Sequence[Coordinate]
    runs: Sequence[WhitenedRun]
    jobs: int

    def model(self, w: Array) -> Model:
        return self.cache.model.replaced(
            {c.name: c.value(float(x)) for c, x in zip(self.numbers, w, strict=True)}
        )

    def rollouts(self, model: Model) -> list[Rollout]:
        """The runs by a model, within its limits."""
        return [Rollout(driven_by(r.log, model.vehicle), {}, model=model) for r in self.runs]

    def steps(self, model: Model) -> int:
        """Integration steps a sample that a twin needs."""
        return stable_steps(DT_S, plant_of(self.runs[0].log, model), INTEGRATOR_ORDER)

    def errors(self, points: Sequence[Array]) -> list[list[Array] | None]:
        """Whitened errors (n,) of the runs at some points; None where the twin diverges or is too stiff."""
        models, count = [self.model(w) for w in points], len(self.runs)
        most = max(MOST_STEPS, self.steps(self.cache.model))
        soft = [self.steps(model) <= most for model in models]
        tried = [rollout for m in itertools.compress(models, soft) for rollout in self.rollouts(m)]
        found = iter(aligned_predictions(tried, self.cache.model, self.cache.candidates, self.jobs))
        out = list[list[Array] | None]()
        for near in soft:
            own = list(itertools.islice(found, count if near else 0))
            pairs = zip(self.runs[: len(own)], own, strict=True)
            known = [
                whitened_error(r, self.noise, r.residuals.errors_of(y)) for r, y in pairs if y is not None
            ]
            out.append(known if len(known) == count else None)
        return out

    @functools.cached_property
    def beside(self) -> list[tuple[Array, Array]]:
        """Columns J (n, C) of sensor states and effects of each run, and 1 + J'J."""
        soil, out = len(soil_columns(self.cache.candidates)), list[tuple[Array, Array]]()
        for run in self.runs:
            J = run.rows[:, soil:-1].astype(float)
            J[:, run.states - soil :] *= EFFECT_SIGMA
            out.append((J, J.T @ J + np.eye(J.shape[1])))
        return out

    def inner(self, columns: Sequence[Array]) -> Array:
        """Inner products of columns (n, M) of each run, sensor states and effects projected out."""
        total = np.zeros((columns[0].shape[1],) * 2)
        for (J, H), own in zip(self.beside, columns, strict=True):
            cross = J.T @ own
            total += own.T @ own - cross.T @ np.linalg.solve(H, cross)
        return total

    def cost(self, w: Array, errors: Sequence[Array] | None) -> float:
        if errors is None:
            return np.inf
        return float(self.inner([e[:, None] for e in errors])[0, 0] + np.square(w / SIGMA).sum())

    def solve(self, again: bool) -> Array:
        """The numbers that fit best; the search begins at the model itself, if `again`, or at the best of the
        starts."""
        if again:
            w = np.zeros(len(self.numbers))
            (errors,) = self.errors([w])
            return self._search(_Found(w, errors, self.cost(w, errors)), STEPS).w
        best, *others = (self._search(self._at_limits(start), FIRST_STEPS) for start in self._starts())
        for other in others:
            if other.cost < (1.0 - ENOUGH) * best.cost:
                best = other
        return self._search(best, FIRST_STEPS).w

    def _at_limits(self, at: _Found) -> _Found:
        """A start with each limit of acceleration where it fits best."""
        for own, number in zip(np.eye(len(at.w)), self.numbers, strict=True):
            if number.name in LIMITS:
                points = [at.w + x * own for x in SCANNED]
                tried = zip(points, self.errors(points), strict=True)
                best = min((_Found(w, e, self.cost(w, e)) for w, e in tried), key=lambda f: f.cost)
                at = best if best.cost < (1.0 - ENOUGH) * at.cost else at
        return at

    def _search(self, at: _Found, steps: int) -> _Found:
        """At most so many steps from a start."""
        for _ in range(steps):
            if at.errors is None or at.done:
                break
            at = self._step(at, at.errors)
        return at

    def _step(self, at: _Found, errors: Sequence[Array]) -> _Found:
        H, gradient = self._normal(at.w, errors)
        damping = at.damping
        for _ in range(TRIES):
            step = np.linalg.solve(H + damping * np.diag(np.diag(H)), gradient)
            w = at.w + np.clip(step, -LONGEST, LONGEST)
            (after,) = self.errors([w])
            cost = self.cost(w, after)
            if cost < (1.0 - ENOUGH) * at.cost:
                return _Found(w, after, cost, damping * LESS)
            if cost < at.cost:
                break
            damping *= MORE
        return dataclasses.replace(at, done=True)

    def _starts(self) -> list[_Found]:
        """The best start that follows its commands as given, and the best of those that are later."""
        names = [c.name.rpartition(".")[2] for c in self.numbers]
        others = [(0.0, STARTS[name]) if name in STARTS else (0.0,) for name in names]
        near = [np.array(p) for p in itertools.product(*others)]
        groups = [near]
        if DEAD_TIME in names:
            groups.append([p + LATER * np.equal(names, DEAD_TIME) for p in near])
        errors = iter(self.errors([p for group in groups for p in group]))
        out = []
        for group in groups:
            found = [_Found(w, e, self.cost(w, e)) for w, e in zip(group, errors, strict=False)]
            out.append(min(found, key=lambda f: f.cost))
        return out

    def _normal(self, w: Array, errors: Sequence[Array]) -> tuple[Array, Array]:
        """Information (K, K) on the numbers and gradient (K,) of the fit; none where the twin diverges."""
        moved = self.errors([w + d for d in DIFFERENCE * np.eye(len(w))])
        columns = [
            np.column_stack([*((e - (m[i] if m else e)) / DIFFERENCE for m in moved), e])
            for i, e in enumerate(errors)
        ]
        G, prior = self.inner(columns), np.eye(len(w)) / SIGMA**2
        return G[:-1, :-1] + prior, G[:-1, -1] - w / SIGMA**2


def set_to_references(
    logs: Sequence[PreparedLog], cache: LinearisationCache, channels: Sequence[str], jobs: int
) -> Model:
    """The twin of the cache with the numbers that fit the references; those that are zero stay so.

    The noise of a twin that is wrong holds its errors: it is learnt once more about the first fit.
    """
    for again in (False, True):
        runs = all_residuals(logs[:RUNS], cache, channels, jobs)
        noise = learn_noise(runs, [], cache.candidates, jobs)
        white = [whitened(run.without_nuisance(), noise) for run in runs]
        fit = _Fit(cache, noise, numbers(cache, logs), white, jobs)
        w = fit.solve(again)
        model = fit.model(w)
        if not w.any():  # the noise would be learnt as before
            break
        logs, cache = [driven_by(log, model.vehicle) for log in logs], dataclasses.replace(cache, model=model)
    return model


def set_as_before(
    logs: Sequence[PreparedLog], cache: LinearisationCache, channels: Sequence[str], jobs: int
) -> Model:
    """As `set_to_references`, by the numbers, kept on disk, that an earlier diagnosis found for the same
    references, twin and version of the library. Laws of the user's own may have changed since: with these,
    nothing is kept."""
    import joblib

    c, names = cache.candidates, [one.name for one in numbers(cache, logs)]
    version = follows_from("fit", c.keys)
    if version is None:
        return set_to_references(logs, cache, channels, jobs)
    content = [logs[:RUNS], cache.model, c.scale, c.low, c.high, c.base, channels, version]
    file = cache_folder() / f"references-{joblib.hash(content)}.json"
    known = _kept_numbers(file)
    if known is not None and [*known] == names:
        return cache.model.replaced(known)
    model = set_to_references(logs, cache, channels, jobs)
    found = json.dumps({name: model.value(name) for name in names})
    with contextlib.suppress(TerrafusionError, OSError):  # a full disk
        write_atomically(file, lambda part: part.write_text(found, encoding="ascii"))
    return model


def _kept_numbers(file: Path) -> dict[str, float] | None:
    """Numbers by name; None where there are none, or the file is damaged."""
    try:
        return {str(name): float(value) for name, value in json.loads(file.read_bytes()).items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return None


def numbers(cache: LinearisationCache, logs: Sequence[PreparedLog]) -> list[Coordinate]:
    """What is fitted, as the solver sees it."""
    commanded = any(log.commanded for log in logs[:RUNS])
    keys, vehicle = {f"effects.{key}" for key in cache.candidates.keys}, cache.model.vehicle
    names = [name for name in NUMBERS if name in keys or not name.startswith("effects.")]
    if vehicle.drive.type == "differential" and BASE.partition(".")[2] not in vehicle.measured:
        names.append(BASE)
    found = [c for c in coordinates_of(names, cache.model, {}) if c.logarithmic or c.name in keys]
    return found + (_limits(cache.model) if commanded else [])


def _limits(model: Model) -> list[Coordinate]:
    """How the robot follows its commands, as numbers of the fit."""
    ranges, out = quantities(VehicleParams), list[Coordinate]()
    for name in (*LIMITS, f"vehicle.drive.{DEAD_TIME}"):
        q, now, is_limit = ranges[name.removeprefix("vehicle.")], model.value(name), name in LIMITS
        scale = LIMIT_SCALE if is_limit else DEAD_TIME_SCALE_S
        out.append(Coordinate(name, q.unit, q.low, q.high, now, scale, is_limit, now))
    return out


def differences(given: Model, shown: Model) -> list[str]:
    """What the references show of the robot against the vehicle's file, in a sentence where it differs."""
    parts = []
    for name in (*LIMITS, f"vehicle.drive.{DEAD_TIME}", BASE):
        before, now = given.value(name), shown.value(name)
        apart = DEAD_TIME_SCALE_S if DEAD_TIME in name else LIMIT_SCALE * before
        if abs(now - before) > NOTED * apart:
            parts.append(f"{name.removeprefix('vehicle.')} {now:.2g} (file: {before:.2g})")
    return [f"the twin is set to what the references show: {', '.join(parts)}"] if parts else []
