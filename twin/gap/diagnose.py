"""`diagnose`: where twin and robot differ, which effect causes it, and how far the gap shrinks with it.

data -> rollout -> null -> infer -> answer
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.calibrate.inputs import check_source
from terrafusion.twin.gap.answer.diagnosis import GapDiagnosis
from terrafusion.twin.gap.answer.drives import drive_coverage
from terrafusion.twin.gap.answer.effect_search import EffectSearch
from terrafusion.twin.gap.answer.next_run import next_run
from terrafusion.twin.gap.answer.shrinkage import shrinkage
from terrafusion.twin.gap.answer.verdict import judge
from terrafusion.twin.gap.answer.where import gap_map
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.data.logs import Soils, check_distinct
from terrafusion.twin.gap.infer.candidate_selection import select_and_refit
from terrafusion.twin.gap.infer.channels import ChannelTable
from terrafusion.twin.gap.infer.detect import detect
from terrafusion.twin.gap.infer.discrepancy import discrepancy_of
from terrafusion.twin.gap.infer.nonlinear_refit import NonlinearRefit
from terrafusion.twin.gap.infer.other_drives import FEWEST, learn_offsets, p_value_of_drive
from terrafusion.twin.gap.infer.posterior import PooledScores
from terrafusion.twin.gap.null.evidence import GapEvidence, gather_evidence
from terrafusion.twin.gap.null.null import learn_null
from terrafusion.twin.gap.null.score import REPLICATES, Score, learn_state_sigma, replicates, score
from terrafusion.twin.gap.rollout.residuals import WhitenedRun, initial_state_sigma
from terrafusion.twin.gap.rollout.sensitivities import Linearisation
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
    cache: dict[str, Linearisation] | None = None,
) -> GapDiagnosis:
    """Compare runs with reference runs through the twin.

    Args:
        runs: the robot as it is now; truth channels are not read.
        references: runs of the same robot that count as normal; none: twin replicates stand in.
        vehicle: the twin's vehicle.
        soils: the soil of all logs, or soils by the logs' labels; None: each label's soil of the library.
        effects: candidates by name; None: the whole catalogue, registered ones included.
        significance: threshold of the test for a gap.
        source: one of `calibrate.inputs.SOURCES`: what drives the twin.
        seed: of permutations and replicates.
        jobs: threads.
        progress: called with the share done, 0 to 1.
        cache: an empty dict, passed to several diagnoses with the same vehicle and soils to linearise the
            twin along each drive only once.

    Raises:
        ConfigError: an unknown effect, soil or source, no effect, a significance out of range.
        DataError: a log lacks what the diagnosis needs, or is given twice.
        TerrafusionError: the twin diverges on a log.
    """
    began = time.perf_counter()
    if not runs:
        raise DataError("no run to diagnose was given", remedy="give at least one")
    if not 0.0 < significance < 1.0:
        raise ConfigError(f"a significance of {significance:g} is out of range", remedy="give 0.001 to 0.5")
    check_source(source)
    check_distinct([*runs, *references])
    candidates = Candidates.of(effects, vehicle.effects)
    evidence = gather_evidence(
        runs, references, vehicle, soils, candidates, source=source, jobs=jobs, progress=progress, cache=cache
    )
    found = diagnose_evidence(evidence, vehicle.name, significance=significance, seed=seed, progress=progress)
    return dataclasses.replace(found, elapsed_s=time.perf_counter() - began)


def diagnose_evidence(
    evidence: GapEvidence,
    vehicle: str,
    *,
    significance: float = SIGNIFICANCE,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> GapDiagnosis:
    """The diagnosis of gathered evidence; arguments as those of `diagnose`."""
    began, candidates, runs = time.perf_counter(), evidence.candidates, evidence.runs
    # null: how scores scatter where nothing has changed
    sigma = learn_state_sigma(evidence.references, initial_state_sigma(candidates))
    scores = [_score_with_discrepancy(evidence, sigma, run) for run in runs]
    normal = [score(run, sigma) for run in evidence.references]
    uncalibrated = math.comb(len(runs) + len(normal), len(runs)) < 1.0 / significance
    notes = list(evidence.notes)
    if uncalibrated:
        notes.append(_too_few(len(normal), len(runs), significance))
        normal = _with_replicates(evidence, sigma, normal, seed)
    null = learn_null(normal, len(scores))
    # infer: is there a gap, and what remains of it with each effect in the twin
    detection = detect(scores, normal, candidates, seed, evidence.jobs)
    if detection.p_value <= significance and len(evidence.references) >= FEWEST:
        # A drive that no reference made is always the odd one out: it must be unusual for the robot, too.
        offsets = learn_offsets([score(run, sigma) for run in evidence.references], len(candidates.keys))
        unusual = p_value_of_drive(scores, offsets, candidates, seed)
        detection = dataclasses.replace(detection, p_value=max(detection.p_value, unusual))
    pooled = PooledScores.of(scores, null).with_scatter(detection.typical, detection.scatter)
    keys = len(candidates.keys)
    table = ChannelTable.of(runs, evidence.references, normal, sigma, keys, evidence.jobs)
    refit = NonlinearRefit(evidence, scores, sigma, null, pooled, table)
    posterior, fits, failed = select_and_refit(refit, detection.p_value <= significance)
    # answer: verdict, shrinkage, place, next run
    refits = {law: found.fit for law, found in fits.items()} | failed
    by_effect = {name: refits[law] for name, law in posterior.laws.items() if law in refits}
    search = EffectSearch.of(refit, {**failed, **fits})
    verdict = judge(detection, significance, pooled, posterior, by_effect, search)
    if progress is not None:
        progress(0.9)
    shrunk = shrinkage(evidence, scores, sigma, null, verdict.fit)
    where = gap_map(evidence, sigma, null, seed)
    drives = drive_coverage(runs, evidence.references, evidence.model)
    if verdict.kind == "unknown" and drives is not None and drives.limits():
        # Undecided: what no effect explains may come from drives that no reference made.
        verdict = dataclasses.replace(verdict, kind="no_gap")
    following = next_run(evidence, sigma, pooled, verdict)
    notes += [f"{law.effect} ({law.form}): {fit.failure}" for law, fit in failed.items()]
    if verdict.fit is not None and verdict.fit.failure:
        notes.append(f"{', '.join(verdict.named)}: {verdict.fit.failure}")
    return GapDiagnosis(
        vehicle, detection, significance, uncalibrated, where, posterior, verdict, shrunk, following, drives,
        by_effect, evidence, tuple(notes), time.perf_counter() - began,
    )  # fmt: skip


def _score_with_discrepancy(evidence: GapEvidence, sigma: Array, run: WhitenedRun) -> Score:
    discrepancy = discrepancy_of(run, evidence.model, sigma, len(evidence.candidates.keys))
    return dataclasses.replace(score(run, sigma), discrepancy=discrepancy)


def _with_replicates(evidence: GapEvidence, sigma: Array, normal: list[Score], seed: int) -> list[Score]:
    """References, and twin replicates around what they have in common."""
    templates = evidence.references or evidence.runs
    offset = learn_null(normal, 1).offset if normal else None
    return normal + replicates(templates, sigma, offset, REPLICATES, seed)


def _too_few(references: int, runs: int, significance: float) -> str:
    return (
        f"{references} reference run(s) and {runs} run(s) are too few for a test at {significance:g}: twin "
        "replicates stand in, and false alarms are as frequent as the twin is wrong (uncalibrated)"
    )
