"""Bank of nonlinear signatures: by how much each law changes the errors of the judged runs, at several sizes.

A signature between two sizes is interpolated. Laws of the sensors alone that are no delays and have sizes of
either sign are linear (their columns are their signatures). All others begin with their sensitivity, up to
the ends of their range, and are simulated, along their one parameter, where a size is of interest. A law of
several parameters that vanishes to first order is simulated along the direction in which all are equal, in
typical sizes.
"""

import dataclasses
import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.gap.data.candidates import Candidates, Hypothesis
from terrafusion.twin.gap.infer.refit import RunWithEffects, whitened_errors
from terrafusion.twin.gap.null.evidence import GapEvidence
from terrafusion.twin.sensors.effects import DELAYS

INSENSITIVE = 10.0
"""A law is insensitive where its sensitivity, at the end of its range, makes a smaller square in all runs;
32-bit rounding makes 3 at most (docs/how-to/gap.md)."""
APART = 0.15
"""A simulated size takes the place of others that differ by less than this share, where runs were on other
soils; the end of a law's range is then simulated there as well."""
THRESHOLDS = (0.4, 0.7, 1.0)
"""Sizes of an insensitive law, in that of its range: it acts beyond a threshold, if at all."""
DELAYED = (1.0, 3.0, 8.0)
"""Typical sizes at which a delay on the way to the motors is simulated at once: its sensitivity may be of the
other sign than what a whole delay does."""
FIRST_SIZE = 1.0  # typical ones, at which the sensitivity of a composite law is simulated


Ladder = tuple[Array, tuple[int, ...]]
"""Sizes (N,) of one law, ascending, zero among them: the value of each of its parameters, in typical sizes;
and the index of each one's signature in `SignatureBank.columns`, -1 for zero."""


@dataclass(frozen=True, eq=False)
class SimulatedSize:
    """A law at a size, beside which each run is on a soil (S,), typical sizes from the model's."""

    law: Hypothesis
    size: float
    soils: Sequence[Array]


@dataclass(frozen=True, eq=False)
class SignatureBank:
    """By how much a law at a size reduces the whitened error (n,) of each judged run.

    Attributes:
        signatures: of each run, by law and size; laws that are not linear have an entry.
        samples: n of each run.
    """

    signatures: Mapping[Hypothesis, Mapping[float, Sequence[Array]]]
    samples: tuple[int, ...]

    @classmethod
    def empty(cls, evidence: GapEvidence) -> Self:
        """Without any law."""
        return cls({}, tuple(len(run.time_s) for run in evidence.runs))

    @classmethod
    def of(cls, evidence: GapEvidence, simulate: bool = True) -> Self:
        """All laws that are not linear, by their sensitivity, which costs nothing; insensitive ones and
        delays by rollout, too, unless `simulate` is false."""
        signatures: dict[Hypothesis, dict[float, list[Array]]] = {}
        candidates, simulated, composite = evidence.candidates, list[SimulatedSize](), list[SimulatedSize]()
        soils = model_soil(evidence)
        columns = [run.by_parameter for run in evidence.runs]
        for law in candidates.hypotheses:
            if not is_simulated(law, candidates):
                continue
            low, high = candidates.bounds(law.columns)
            if candidates.is_composite(law):
                size = FIRST_SIZE if high.min() >= FIRST_SIZE else -FIRST_SIZE
                composite.append(SimulatedSize(law, size, soils))
                continue
            slope = [c[:, law.columns].sum(axis=1) for c in columns]
            square = sum(float(np.square(s).sum()) for s in slope)
            signatures[law] = {}
            for end in {float(low.max()), float(high.min())} - {0.0}:
                if square * end**2 >= INSENSITIVE:
                    signatures[law][end] = [end * s for s in slope]
                else:
                    simulated += [SimulatedSize(law, share * end, soils) for share in THRESHOLDS]
            if candidates.units[law.columns[0]] == "s" and candidates.keys[law.columns[0]] not in DELAYS:
                simulated += [SimulatedSize(law, x, soils) for x in DELAYED if x < float(high.max())]
        bank = dataclasses.replace(cls.empty(evidence), signatures=signatures)
        return bank.with_sizes(evidence, [*simulated, *composite])._extended(evidence) if simulate else bank

    def _extended(self, evidence: GapEvidence) -> Self:
        """With composite laws in proportion to their size, up to the ends of their range."""
        candidates, out = evidence.candidates, dict(self.signatures)
        for law in filter(candidates.is_composite, self.signatures):
            ((size, own),) = out[law].items()
            low, high = candidates.bounds(law.columns)
            out[law] = {
                end: [end / size * s for s in own] for end in {float(low.max()), float(high.min())} - {0.0}
            }
        return dataclasses.replace(self, signatures=out)

    def only(self, laws: Iterable[Hypothesis]) -> Self:
        """With some laws alone."""
        kept = {law: self.signatures[law] for law in laws if law in self.signatures}
        return dataclasses.replace(self, signatures=kept)

    def sizes(self, law: Hypothesis) -> Array:
        """(N,) ascending, zero among them."""
        return np.array(sorted((0.0, *self.signatures[law])))

    def ladders(self) -> dict[Hypothesis, Ladder]:
        """By law."""
        count, sizes = itertools.count(), {law: self.sizes(law) for law in self.signatures}
        return {law: (at, tuple(next(count) if size else -1 for size in at)) for law, at in sizes.items()}

    def columns(self) -> list[Array]:
        """(n, Q) signatures of each run, in the order of the ladders."""
        every = [own[size] for law, own in self.signatures.items() for size in self.sizes(law) if size]
        return [
            np.column_stack([np.zeros((n, 0)), *(of_runs[i] for of_runs in every)])
            for i, n in enumerate(self.samples)
        ]

    def with_sizes(self, evidence: GapEvidence, points: Sequence[SimulatedSize]) -> Self:
        """With further sizes of laws, the first of near ones, without those at which the twin diverges."""
        points = self._with_ends(points)
        runs = range(len(evidence.runs))
        changed = evidence.candidates.changed
        effects = [changed(p.law.columns, p.size * np.ones(len(p.law.columns))) for p in points]
        tried = [RunWithEffects(r, e, p.soils[r]) for p, e in zip(points, effects, strict=True) for r in runs]
        plain = {(r, p.soils[r].tobytes()): RunWithEffects(r, {}, p.soils[r]) for p in points for r in runs}
        # Unclipped: a large effect is no outlier.
        errors = whitened_errors(evidence, [*tried, *plain.values()], clip=False)
        without = dict(zip(plain, errors[len(tried) :], strict=True))
        signatures, simulated = dict(self.signatures), dict[Hypothesis, dict[float, list[Array]]]()
        for i, point in enumerate(points):
            with_it = errors[i * len(runs) : (i + 1) * len(runs)]
            pairs = [(without[r, point.soils[r].tobytes()], with_it[r]) for r in runs]
            new = [whole - error for whole, error in pairs if whole is not None and error is not None]
            if len(new) == len(runs):
                simulated.setdefault(point.law, {})[point.size] = new
        for law, sizes in simulated.items():
            known = signatures.get(law, {})
            apart = {x: s for x, s in known.items() if not any(_near(x, size) for size in sizes)}
            signatures[law] = {**apart, **sizes}
        return dataclasses.replace(self, signatures=signatures)

    def _with_ends(self, points: Sequence[SimulatedSize]) -> list[SimulatedSize]:
        """The points but for those near an earlier one, and the ends of a ladder beyond a near point."""
        out = list[SimulatedSize]()
        for p in points:
            if not any(p.law == other.law and _near(p.size, other.size) for other in out):
                out.append(p)
        for p in list(out):
            ends = self.sizes(p.law)[[0, -1]].tolist() if p.law in self.signatures else []
            beyond = [end for end in ends if _near(end, p.size) and abs(end) > abs(p.size)]
            out += [dataclasses.replace(p, size=end) for end in beyond]
        return out


def _near(a: float, b: float) -> bool:
    return abs(a - b) < APART * max(abs(a), abs(b))


def model_soil(evidence: GapEvidence) -> list[Array]:
    """The model's own soil for each run: a run's own holds a part of the effect."""
    return [np.zeros(len(evidence.soil_limit))] * len(evidence.runs)


def is_simulated(law: Hypothesis, candidates: Candidates) -> bool:
    """Whether a law needs the twin's rollout at each size."""
    keys = [candidates.keys[i] for i in law.columns]
    return any(k in candidates.moving or k in DELAYS or k in candidates.composite for k in keys) or (
        len(keys) == 1 and candidates.low[law.columns[0]] == 0.0
    )
