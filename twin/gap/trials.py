"""Trials on the twin's own runs: how often there is a false alarm, how often the cause is found, how sure
it may be.

    python -m terrafusion.twin.gap.trials --nulls 200 --trials 300 --seed 1

Real simulated runs with all sensor noise and ground that varies from run to run are the nulls; an effect is
put on top of them as its signature, at a given signal-to-noise ratio. That is linear: an upper bound, and
no substitute for the blind check. Families: `same` (the true law is among the forms), `shifted` (it is
withheld, its effect's other forms are not), `outside` (the whole effect is withheld), `pair` (two at once).
"""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.recording import Recording
from terrafusion.twin.gap.candidates import SOIL, Candidates, Hypothesis
from terrafusion.twin.gap.channels import Block, Columns, Table
from terrafusion.twin.gap.choice import Choice, linear
from terrafusion.twin.gap.detect import choices, detect, judged
from terrafusion.twin.gap.discrepancy import modulated
from terrafusion.twin.gap.evidence import gather
from terrafusion.twin.gap.null import Null, learn
from terrafusion.twin.gap.posterior import Pool, beliefs
from terrafusion.twin.gap.refit import Refit
from terrafusion.twin.gap.residuals import Evidence, state_sigmas
from terrafusion.twin.gap.score import Score, learnt_sigma, score
from terrafusion.twin.gap.verdict import HeldOut, Search, Verdict, floor_of, judge
from terrafusion.twin.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate
from terrafusion.twin.vehicle import load_vehicle

Array = NDArray[np.float64]

REFERENCES, JUDGED, HELD = 20, 3, 20
SPREAD = 0.05
"""1 sigma of the ground's strength and bearing from run to run, of their logarithms (assumed)."""
RATIOS = (10.0, 20.0, 40.0)
"""Signal-to-noise ratios of the effects put on top."""
FAMILIES = ("same", "shifted", "outside", "pair")
MOST_UNITS = 30.0
"""An effect that needs more than so many typical sizes for the ratio is left out."""
SEGMENTS = (
    (1.0, 0.0, 0.0), (5.0, 0.8, 0.4), (5.0, 1.2, -0.5), (4.0, 0.5, 0.0), (5.0, 1.0, 0.0), (4.0, 0.0, 0.6),
    (5.0, 1.4, 0.0), (4.0, 0.5, 0.5), (4.0, 1.0, -0.4), (3.0, 0.0, 0.0),
)  # fmt: skip
DRIVE = Scenario(
    "exciting", 40.0, route=(RouteLeg("loose_sand"),), drive=tuple(DriveSegment(*s) for s in SEGMENTS)
)


def null_run(seed: int) -> Recording:
    """A run of the nominal robot on ground of its own."""
    rng = np.random.default_rng(seed)
    own = {f"{SOIL}/{name}": float(SPREAD * rng.standard_normal()) for name in ("shear", "bearing")}
    return dataclasses.replace(simulate(DRIVE, seed=seed, effects=own), name=f"null{seed}", truth=None)


@dataclasses.dataclass(frozen=True, eq=False)
class Run:
    """A run: its evidence, score, and errors by channel (None where the null is not learnt yet)."""

    evidence: Evidence
    score: Score
    block: Block | None = None

    def with_effect(self, columns: Sequence[int], size: Array) -> Run:
        """The run with an effect of this size (k,), to first order."""
        at, block = list(columns), self.block
        score = dataclasses.replace(self.score, b=self.score.b + self.score.A[:, at] @ size)
        if block is not None:
            block = dataclasses.replace(block, error=block.moved(block.error, at, -size))
        return Run(self.evidence, score, block)


def null_runs(seed: int, jobs: int) -> tuple[list[Run], Array, Candidates]:
    """All null runs, and 1 sigma of their states."""
    seeds = range(1000 * seed + 1, 1000 * seed + 1 + REFERENCES + HELD)
    with ProcessPoolExecutor(jobs) as pool:
        recordings = list(pool.map(null_run, seeds))
    candidates = Candidates.of()
    bench = gather(
        recordings[REFERENCES:], recordings[:REFERENCES], load_vehicle("elevate"), None, candidates
    )
    sigma = learnt_sigma(bench.references, state_sigmas(candidates))
    columns = len(candidates.keys)
    runs = [
        Run(run, dataclasses.replace(score(run, sigma), other=modulated(run, bench.model, sigma, columns)))
        for run in [*bench.references, *bench.runs]
    ]
    return runs, sigma, candidates


def interval(hits: int, count: int) -> tuple[float, float]:
    """95 % interval of a share (Clopper and Pearson 1934)."""
    from scipy.special import betaincinv

    low = float(betaincinv(hits, count - hits + 1, 0.025)) if hits else 0.0
    high = float(betaincinv(hits + 1, count - hits, 0.975)) if hits < count else 1.0
    return low, high


def calibration_error(confidence: Sequence[float], right: Sequence[bool], bins: int = 10) -> float:
    """Expected calibration error (Naeini et al. 2015) in bins of equal width."""
    p, y = np.asarray(confidence), np.asarray(right, dtype=float)
    which = np.minimum((p * bins).astype(int), bins - 1)
    return float(sum(
        np.mean(which == k) * abs(p[which == k].mean() - y[which == k].mean()) for k in np.unique(which)
    ))  # fmt: skip


def false_alarms(
    scores: Sequence[Score], candidates: Candidates, count: int, rng: np.random.Generator
) -> int:
    """How many of so many random choices of null runs are called a gap at 5 %."""
    alarms = 0
    for i in range(count):
        order = rng.permutation(len(scores))[: REFERENCES + JUDGED]
        some = [scores[k] for k in order]
        alarms += detect(some[:JUDGED], some[JUDGED:], candidates, i).p_value <= 0.05
    return alarms


@dataclasses.dataclass(frozen=True, eq=False)
class Trial:
    """One trial: its truth and the verdict (None where no gap was seen)."""

    family: str
    ratio: float
    truth: tuple[str, ...]
    verdict: Verdict | None


class Trials:
    """Trials against one split of null runs into references and held-out ones."""

    def __init__(
        self, runs: Sequence[Run], sigma: Array, candidates: Candidates, rng: np.random.Generator
    ) -> None:
        order = rng.permutation(len(runs))
        normal, held = [runs[i] for i in order[:REFERENCES]], [runs[i] for i in order[REFERENCES:]]
        self.references = [run.score for run in normal]
        self.candidates, self.rng = candidates, rng
        self.null: Null = learn(self.references, JUDGED)
        columns, evidence = len(candidates.keys), [run.evidence for run in normal]
        self.table = Table.of(evidence[:1], evidence, self.references, sigma, columns)
        channels = len(self.table.inside)
        self.held = [
            dataclasses.replace(
                run,
                block=Block.of(run.evidence, Columns.of(run.evidence, channels, columns, self.null.offset)),
            )
            for run in held
        ]
        picks = choices(REFERENCES, JUDGED, 0)[:20]
        rest = [[r for i, r in enumerate(self.references) if i not in c] for c in picks]
        mine = [[self.references[i] for i in c] for c in picks]
        pools = [Pool.of(a, learn(b, JUDGED)) for a, b in zip(mine, rest, strict=True)]
        self.floor = floor_of(pools, range(pools[0].own))
        others = [beliefs(judged(a, b), candidates).statistic() for a, b in zip(mine, rest, strict=True)]
        self.threshold = float(np.quantile(others, 0.95))
        self.laws = [h for h in candidates.hypotheses if h.effect != SOIL]

    def one(self, family: str, ratio: float) -> Trial | None:
        """A random trial; None where the family or the ratio does not suit the effect drawn."""
        law = self.laws[self.rng.integers(len(self.laws))]
        forms = [h for h in self.laws if h.effect == law.effect]
        if family == "shifted" and len(forms) < 2:
            return None
        withheld = {"shifted": [law], "outside": forms}.get(family, [])
        kept = tuple(h for h in self.candidates.hypotheses if h not in withheld)
        candidates = dataclasses.replace(self.candidates, hypotheses=kept)
        runs: list[Run] | None = [
            self.held[i] for i in self.rng.choice(len(self.held), JUDGED, replace=False)
        ]
        truth = [law]
        if family == "pair":
            truth.append(self.laws[self.rng.integers(len(self.laws))])
            if truth[1].effect == law.effect:
                return None
        for h in truth:
            runs = self._with(runs, h, ratio) if runs is not None else None
        if runs is None:
            return None
        names = tuple(h.effect for h in truth)
        scores = [run.score for run in runs]
        if beliefs(judged(scores, self.references), candidates).statistic() <= self.threshold:
            return Trial(family, ratio, names, None)
        return Trial(family, ratio, names, self._verdict(runs, scores, candidates))

    def _verdict(self, runs: Sequence[Run], scores: Sequence[Score], candidates: Candidates) -> Verdict:
        pool = Pool.of(scores, self.null)
        blocks = tuple(run.block for run in runs if run.block is not None)
        table = dataclasses.replace(self.table, columns=(), blocks=blocks)
        choice = Choice.of(pool, table, linear(table, pool, candidates)[0])

        def remaining(several: Sequence[tuple[Hypothesis, ...]]) -> list[tuple[Pool, Refit | None]]:
            return [(pool, None)] * len(several)

        each = HeldOut(tuple(Pool.of([dataclasses.replace(s, other=None)], self.null) for s in scores))
        search = Search(remaining, each, candidates, table, pool.alone)
        return judge(True, 0.01, pool, choice, {}, search, self.floor)

    def _with(self, runs: list[Run], law: Hypothesis, ratio: float) -> list[Run] | None:
        at = list(law.columns)
        way = self.rng.standard_normal(len(at))
        if self.candidates.low[at[0]] >= 0.0:
            way = np.abs(way)
        plain = [dataclasses.replace(r.score, other=None) for r in runs]
        information = Pool.of(plain, self.null).information[np.ix_(at, at)]
        size = ratio / math.sqrt(max(float(way @ information @ way), 1e-12))
        if np.abs(size * way).max() > MOST_UNITS:
            return None
        return [run.with_effect(at, size * way) for run in runs]


def line(trials: Sequence[Trial]) -> str:
    """One row of the table."""
    seen = [t for t in trials if t.verdict is not None]
    verdicts = [t.verdict for t in seen if t.verdict is not None]
    first = [v.causes[0].effect in t.truth for t, v in zip(seen, verdicts, strict=True)]
    third = [
        bool({c.effect for c in v.causes[:3]} & set(t.truth)) for t, v in zip(seen, verdicts, strict=True)
    ]
    known = [v.causes[0].probability / max(1.0 - v.p_null - v.p_unknown, 1e-9) for v in verdicts]
    unknown = [v.kind == "unknown" for v in verdicts]
    both = [set(t.truth) <= set(v.named) for t, v in zip(seen, verdicts, strict=True)]
    extra = [len(set(v.named) - set(t.truth)) for t, v in zip(seen, verdicts, strict=True)]
    power = len(seen) / max(len(trials), 1)
    family, ratio = trials[0].family, trials[0].ratio
    return (
        f"| {family} | {ratio:g} | {len(trials)} | {power:.2f} | {np.mean(first):.2f} | {np.mean(third):.2f} "
        f"| {calibration_error(known, first):.3f} | {np.mean(unknown):.2f} | {np.mean(both):.2f} "
        f"| {np.mean(extra):.2f} |"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="How well the diagnosis does on the twin's own runs.")
    parser.add_argument("--nulls", type=int, default=200)
    parser.add_argument("--trials", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args()
    rng = np.random.default_rng(given.seed)
    runs, sigma, candidates = null_runs(given.seed, given.jobs)
    alarms = false_alarms([run.score for run in runs], candidates, given.nulls, rng)
    low, high = interval(alarms, given.nulls)
    print(f"false alarms {alarms} of {given.nulls} (95 %: {100 * low:.1f} to {100 * high:.1f} %)")
    print("| family | signal | trials | seen | first | of three | ECE | unknown | all named | extras |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    cell = max(1, given.trials // (len(FAMILIES) * len(RATIOS)))
    bench = Trials(runs, sigma, candidates, rng)
    for family in FAMILIES:
        for ratio in RATIOS:
            found: list[Trial] = []
            while len(found) < cell:
                trial = bench.one(family, ratio)
                found += [trial] if trial is not None else []
            print(line(found), flush=True)


if __name__ == "__main__":
    main()
