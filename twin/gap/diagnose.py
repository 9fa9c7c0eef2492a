"""`diagnose`: where twin and robot disagree, which effect causes it, and how far the gap shrinks with it."""

from __future__ import annotations

import dataclasses
import hashlib
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.calibrate.inputs import check_source
from terrafusion.twin.gap.answer.diagnosis import GapDiagnosis
from terrafusion.twin.gap.answer.next_run import NextRun, propose
from terrafusion.twin.gap.answer.shrink import adapted, own_error, shrink
from terrafusion.twin.gap.answer.verdict import HeldOut, Search, Verdict, alike, floor_of, judge
from terrafusion.twin.gap.answer.where import gap_map
from terrafusion.twin.gap.data.candidates import Candidates, Hypothesis
from terrafusion.twin.gap.infer.candidate_selection import chosen
from terrafusion.twin.gap.infer.channels import Table
from terrafusion.twin.gap.infer.detect import detect
from terrafusion.twin.gap.infer.discrepancy import modulated
from terrafusion.twin.gap.infer.evidence import Bench, Soils, gather
from terrafusion.twin.gap.infer.nonlinear_refit import Fitted, Fitter
from terrafusion.twin.gap.infer.posterior import Beliefs, Pool, beliefs
from terrafusion.twin.gap.infer.refit import Refit, scored
from terrafusion.twin.gap.infer.replicates import COUNT, replicates
from terrafusion.twin.gap.null.null import Null, learn
from terrafusion.twin.gap.null.score import Score, learnt_sigma, score
from terrafusion.twin.gap.rollout.residuals import Evidence, state_sigmas
from terrafusion.twin.gap.rollout.sensitivities import Drive
from terrafusion.twin.gap.threads import one_blas_thread
from terrafusion.twin.model.vehicle import VehicleParams

Array = NDArray[np.float64]

SIGNIFICANCE = 0.05


@one_blas_thread()
def diagnose(
    runs: Sequence[Recording],
    references: Sequence[Recording],
    vehicle: VehicleParams,
    soils: Soils = None,
    *,
    effects: Sequence[str] | None = None,
    significance: float = SIGNIFICANCE,
    source: str = "auto",
    seed: int = 0,
    jobs: int = 2,
    progress: Callable[[float], None] | None = None,
    kept: dict[str, Drive] | None = None,
) -> GapDiagnosis:
    """Compare runs with reference runs through the twin.

    Args:
        runs: the robot as it is now; its truth channels are not read.
        references: runs of the same robot that count as normal; none: twin replicates stand in.
        vehicle: the twin's vehicle.
        soils: the ground of all logs, or grounds by the logs' labels; None: each label's soil of the library.
        effects: candidates by name; None: the whole catalogue, one's own included.
        significance: threshold of the test for a gap.
        source: one of `identify.inputs.SOURCES`: what drives the twin.
        seed: of permutations and replicates.
        jobs: threads.
        progress: told the share done, 0 to 1.
        kept: one's own empty dict, given to each of several diagnoses with the same vehicle and soils: what
            the twin makes of a drive is computed once.

    Raises:
        ConfigError: an unknown effect, soil or source, no effect, a significance out of range.
        DataError: a log without what the diagnosis needs, or given twice.
        TerrafusionError: the twin diverges on a log.
    """
    began = time.perf_counter()
    if not runs:
        raise DataError("no run to diagnose was given", remedy="give at least one")
    if not 0.0 < significance < 1.0:
        raise ConfigError(f"a significance of {significance:g} is out of range", remedy="give 0.001 to 0.5")
    check_source(source)
    _check_each_once([*runs, *references])
    candidates = Candidates.of(effects, vehicle.effects)
    bench = gather(
        runs, references, vehicle, soils, candidates, source=source, jobs=jobs, progress=progress, kept=kept
    )
    found = diagnosed(bench, vehicle.name, significance=significance, seed=seed, progress=progress)
    return dataclasses.replace(found, elapsed_s=time.perf_counter() - began)


def diagnosed(
    bench: Bench,
    vehicle: str,
    *,
    significance: float = SIGNIFICANCE,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> GapDiagnosis:
    """The diagnosis of gathered evidence; arguments as those of `diagnose`."""
    began, candidates, runs = time.perf_counter(), bench.candidates, bench.runs
    sigma = learnt_sigma(bench.references, state_sigmas(candidates))
    scores = [_with_other_forms(bench, sigma, run) for run in bench.runs]
    normal = [score(run, sigma) for run in bench.references]
    notes = list(bench.notes)
    uncalibrated = math.comb(len(runs) + len(normal), len(runs)) < 1.0 / significance
    if uncalibrated:
        notes.append(_too_few(len(normal), len(runs), significance))
        normal = _filled(bench, sigma, normal, seed)
    found = detect(scores, normal, candidates, seed, bench.jobs)
    null = learn(normal, len(scores))
    pool = Pool.of(scores, null).beside(found.usual, found.scatter)
    case = _Case(bench, scores, sigma, null, pool, beliefs(pool, candidates))
    floor = floor_of(found.nulls, range(pool.own))
    table = Table.of(bench.runs, bench.references, normal, sigma, len(candidates.keys), bench.jobs)
    detected = found.p_value <= significance
    fitter = Fitter(bench, scores, sigma, null, pool, table)
    choice, fits, failed = chosen(fitter, case.believed, detected)
    refits = {name: fits[law].fit for name, law in choice.laws.items() if law in fits}
    refits |= {name: failed[law] for name, law in choice.laws.items() if law in failed}
    held_out = HeldOut(tuple(Pool.of([s], null).plain() for s in scores))
    known: dict[tuple[Hypothesis, ...], Fitted | Refit] = {(law,): fit for law, fit in failed.items()}
    known |= {(law,): fit for law, fit in fits.items()}
    remaining = _Remaining(case, fitter, known)
    search = Search(remaining, held_out, candidates, table, pool.alone)
    verdict = judge(detected, found.tail(significance), pool, choice, refits, search, floor)
    if progress is not None:
        progress(0.9)
    shrinking = shrink(bench, scores, sigma, null, verdict.fit)
    errors = [adapted(r, sigma, own_error(r, null)) for r in [*bench.runs, *bench.references]]
    where = gap_map(bench.runs, bench.references, bench.model, errors, seed)
    following = _next_run(bench, sigma, verdict)
    notes += [f"{law.effect} ({law.form}): {fit.failure}" for law, fit in failed.items()]
    if verdict.fit is not None and verdict.fit.failure:
        notes.append(f"{', '.join(verdict.named)}: {verdict.fit.failure}")
    return GapDiagnosis(
        tuple(r.name for r in runs), tuple(r.name for r in bench.references), vehicle,
        sum(r.seconds for r in runs), found, significance, uncalibrated, where, choice, verdict, shrinking,
        following, refits, bench, tuple(notes), time.perf_counter() - began,
    )  # fmt: skip


def _check_each_once(recordings: Sequence[Recording]) -> None:
    """A log that counts twice would make the scatter from run to run look smaller than it is."""
    known: dict[bytes, str] = {}
    for recording in recordings:
        content = hashlib.sha256()
        for name, channel in recording.channels().items():
            content.update(name.encode() + channel.t_ns.tobytes())
            for column in channel.columns().values():
                content.update(column.astype(str).tobytes() if column.dtype == object else column.tobytes())
        digest = content.digest()
        if digest in known:
            raise DataError(f"the same log as {known[digest]}", file=recording.name, remedy="give each once")
        known[digest] = recording.name


def _too_few(references: int, runs: int, significance: float) -> str:
    return (
        f"{references} reference run(s) and {runs} run(s) cannot show a gap at {significance:g} by themselves"
        ": twin replicates stand in, and false alarms are as frequent as the twin is wrong (uncalibrated)"
    )


def _filled(bench: Bench, sigma: Array, normal: list[Score], seed: int) -> list[Score]:
    """References, and replicates around what they have in common."""
    templates = bench.references or bench.runs
    common = learn(normal, 1).offset if normal else None
    return normal + replicates(templates, sigma, common, COUNT, seed)


@dataclass(frozen=True, eq=False)
class _Case:
    """The judged runs against the null: their scores, sums and Bayes factors."""

    bench: Bench
    scores: list[Score]
    sigma: Array
    null: Null
    pool: Pool
    believed: Beliefs


def _with_other_forms(bench: Bench, sigma: Array, run: Evidence) -> Score:
    columns = len(bench.candidates.keys)
    return dataclasses.replace(score(run, sigma), other=modulated(run, bench.model, sigma, columns))


@dataclass(frozen=True, eq=False)
class _Remaining:
    """What is left of the gap with some effects in the twin, and their fit; the gap itself where that fails.
    `known` are those fitted so far."""

    case: _Case
    fitter: Fitter
    known: dict[tuple[Hypothesis, ...], Fitted | Refit]

    def __call__(self, several: Sequence[tuple[Hypothesis, ...]]) -> list[tuple[Pool, Refit]]:
        case = self.case
        fits = [f.fit if isinstance(f, Fitted) else f for f in self._fitted(several)]
        return [(self._left_by(fit) if fit.errors else case.pool, fit) for fit in fits]

    def _left_by(self, fit: Refit) -> Pool:
        case = self.case
        runs = zip(case.bench.runs, fit.errors, case.scores, strict=True)
        left = [
            dataclasses.replace(scored(run, case.sigma, error, own.A), other=own.other)
            for run, error, own in runs
        ]
        return Pool.of(left, case.null)

    def _fitted(self, several: Sequence[tuple[Hypothesis, ...]]) -> list[Fitted | Refit]:
        """Of each set the last one beside those before it, side by side where those are the same; the failure
        of those before where they have none."""
        together: dict[tuple[Hypothesis, ...], list[Hypothesis]] = {}
        for forms in several:
            if forms not in self.known:
                together.setdefault(forms[:-1], []).append(forms[-1])
        for first, more in together.items():
            self._fit(first, more)
        return [self.known[forms] for forms in several]

    def _fit(self, first: tuple[Hypothesis, ...], more: Sequence[Hypothesis]) -> None:
        """Each of `more` beside the first ones."""
        before = self._fitted([first])[0] if first else None
        if isinstance(before, Refit):
            self.known.update({(*first, law): before for law in more})
        elif before is None:
            self.known.update({(law,): self.fitter.alone(law) for law in more})
        else:
            joint = {law: _together((*first, law)) for law in more}
            found = self.fitter.beside(before, list(joint.values()))
            self.known.update({(*first, law): found[both] for law, both in joint.items()})


def _together(forms: Sequence[Hypothesis]) -> Hypothesis:
    """Several laws as one."""
    effects, names = (" and ".join(h.effect for h in forms), " and ".join(h.form for h in forms))
    return Hypothesis(effects, names, tuple(column for h in forms for column in h.columns))


def _next_run(bench: Bench, sigma: Array, verdict: Verdict) -> NextRun | None:
    """For the first cause that has look-alikes and the likeliest of these."""
    if verdict.kind != "ambiguous":
        return None
    first, by_name = alike(verdict.causes, verdict.named), {c.effect: c for c in verdict.causes}
    return None if first is None else propose(bench, sigma, first, by_name[first.members[1]])
