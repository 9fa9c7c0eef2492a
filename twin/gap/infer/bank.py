"""Bank of nonlinear signatures: what each law does to the errors of the judged runs, at several sizes.

A signature between two sizes is interpolated. Laws that act on the sensors alone and no delays are linear
(their columns are their signatures). All others begin with their sensitivity, up to the ends of their range,
and are simulated, along their one parameter, where a size is of interest. A law of several parameters that
vanishes to first order is simulated along the direction in which all are equal, in typical sizes.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.gap.data.candidates import Candidates, Hypothesis
from terrafusion.twin.gap.infer.refit import RunWithEffects, effects_at, whitened_errors
from terrafusion.twin.gap.null.evidence import GapEvidence
from terrafusion.twin.gap.rollout.delay import DELAYS

INSENSITIVE = 10.0
"""A law is insensitive where its sensitivity, at the end of its range, makes a smaller square in all runs;
32-bit rounding makes 3 at most (docs/how-to/gap.md)."""
APART = 0.15
"""A simulated size takes the place of others nearer than this share of it, where runs were on other soils."""
THRESHOLDS = (0.4, 0.7, 1.0)
"""Sizes of an insensitive law, in that of its range: it acts beyond a threshold, if at all."""


@dataclass(frozen=True, eq=False)
class Ladder:
    """The sizes of one law.

    Attributes:
        at: (N,) sizes, ascending, zero among them: the value of each of its parameters, in typical sizes.
        column: (N,) index of each one's signature in the bank; -1 for zero.
    """

    law: Hypothesis
    at: Array
    column: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class SimulatedSize:
    """A law at a size, beside which each run is on a soil (S,), typical sizes from the model's."""

    law: Hypothesis
    size: float
    soils: Sequence[Array]


@dataclass(frozen=True, eq=False)
class SignatureBank:
    """Signatures (n, Q) of each judged run: by how much a law at a size reduces its whitened error."""

    ladders: Mapping[Hypothesis, Ladder]
    signatures: list[Array]

    @classmethod
    def of(cls, evidence: GapEvidence, simulate: bool = True) -> SignatureBank:
        """All laws that are not linear, by their sensitivity, which costs nothing; insensitive ones by
        rollout, unless `simulate` is false."""
        ladders, candidates, points = dict[Hypothesis, Ladder](), evidence.candidates, list[SimulatedSize]()
        columns = [run.by_parameter for run in evidence.runs]
        first: list[list[Array]] = [[] for _ in columns]
        for law in candidates.hypotheses:
            if not is_simulated(law, candidates):
                continue
            low, high = candidates.bounds(law.columns)
            steps, far = [(0.0, -1)], list[float]()
            square = sum(float(np.square(c[:, law.columns].sum(axis=1)).sum()) for c in columns)
            for end in (float(low.max()), float(high.min())):
                if end == 0.0:
                    continue
                if square * end**2 < INSENSITIVE:
                    far += [share * end for share in THRESHOLDS]
                    continue
                steps.append((end, len(first[0])))
                for mine, c in zip(first, columns, strict=True):
                    mine.append(end * c[:, law.columns].sum(axis=1))
            steps.sort()
            ladders[law] = Ladder(law, np.array([x for x, _ in steps]), tuple(c for _, c in steps))
            points += [SimulatedSize(law, x, model_soil(evidence)) for x in far]
        empty = [np.zeros((len(run.time_s), 0)) for run in evidence.runs]
        bank = cls(ladders, [np.column_stack([e, *mine]) for e, mine in zip(empty, first, strict=True)])
        return bank.with_sizes(evidence, points) if simulate else bank

    def only(self, laws: Iterable[Hypothesis]) -> SignatureBank:
        """With the ladders of some laws alone."""
        kept, columns = dict[Hypothesis, Ladder](), list[int]()
        for law in laws:
            if law in self.ladders:
                old, first = self.ladders[law], len(columns)
                columns += [c for c in old.column if c >= 0]
                new = itertools.count(first)
                kept[law] = dataclasses.replace(
                    old, column=tuple(c if c < 0 else next(new) for c in old.column)
                )
        return SignatureBank(kept, [s[:, columns] for s in self.signatures])

    def with_sizes(self, evidence: GapEvidence, points: Sequence[SimulatedSize]) -> SignatureBank:
        """With further sizes of laws; those at which the twin diverges are left out."""
        runs = range(len(evidence.runs))
        effects = [effects_at(evidence, p.law.columns, p.size * np.ones(len(p.law.columns))) for p in points]
        tried = [RunWithEffects(r, e, p.soils[r]) for p, e in zip(points, effects, strict=True) for r in runs]
        place = {(r, p.soils[r].tobytes()): RunWithEffects(r, {}, p.soils[r]) for p in points for r in runs}
        # Unclipped: a large effect is no outlier.
        errors = whitened_errors(evidence, [*tried, *place.values()], clip=False)
        on_soil = dict(zip(place, errors[len(tried) :], strict=True))
        plain = [on_soil[r, p.soils[r].tobytes()] for p in points for r in runs]
        new: list[list[Array]] = [[] for _ in runs]
        found: dict[Hypothesis, list[tuple[float, int]]] = {
            law: list(zip(old.at.tolist(), old.column, strict=True)) for law, old in self.ladders.items()
        }
        count = self.signatures[0].shape[1]
        for i, point in enumerate(points):
            own = slice(i * len(runs), (i + 1) * len(runs))
            mine = [error for error in errors[own] if error is not None]
            without = [error for error in plain[own] if error is not None]
            if len(mine) < len(runs) or len(without) < len(runs):
                continue
            known = found.setdefault(point.law, [(0.0, -1)])
            apart = [step for step in known if abs(step[0] - point.size) >= APART * abs(point.size)]
            found[point.law] = [*apart, (point.size, count + len(new[0]))]
            for signatures, whole, error in zip(new, without, mine, strict=True):
                signatures.append(whole - error)
        ladders = dict(self.ladders)
        for law, steps in found.items():
            steps.sort()
            ladders[law] = Ladder(law, np.array([x for x, _ in steps]), tuple(c for _, c in steps))
        more = [np.column_stack([old, *some]) for old, some in zip(self.signatures, new, strict=True)]
        return dataclasses.replace(self, ladders=ladders, signatures=more)


def model_soil(evidence: GapEvidence) -> list[Array]:
    """The model's own soil for each run: a run's own holds a part of the effect."""
    return [np.zeros(len(evidence.soil_limit))] * len(evidence.runs)


def is_simulated(law: Hypothesis, candidates: Candidates) -> bool:
    """Whether a law needs the twin's rollout at each size."""
    keys = [candidates.keys[i] for i in law.columns]
    return any(k in candidates.moving or k in DELAYS for k in keys) or (
        len(keys) == 1 and candidates.low[law.columns[0]] == 0.0
    )
