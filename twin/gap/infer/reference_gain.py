"""How much of the likelihood that laws gain they also gain on references, where nothing has changed.

A nonlinear signature, or the discrepancy of a law, also fits errors that the twin makes in every run, and
scatter of the ground that the random effects do not model. Both are in the references too. So the gain of a
set of laws on references, at the sizes of the judged runs but with free coefficients, is subtracted.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.gap.infer.bank import SignatureBank, SimulatedSize
from terrafusion.twin.gap.infer.close_look import CloseLook, products_with_discrepancy
from terrafusion.twin.gap.infer.other_drives import FEWEST, RobotOffsets
from terrafusion.twin.gap.infer.predictive import metric
from terrafusion.twin.gap.infer.single_effects import RIDGE, Fitted, Laws
from terrafusion.twin.gap.null.evidence import GapEvidence
from terrafusion.twin.gap.null.score import score

GROUPS = 4  # most groups of references: each costs as many rollouts as the judged runs


@dataclasses.dataclass(frozen=True, eq=False)
class ReferenceGains:
    """Groups of references, as many as there are judged runs where they suffice, each with offsets learned
    from the others.

    Attributes:
        looks: of each group, with the columns of the discrepancy of each law.
        column: columns of each law: those of a linear one, or its one signature.
        share: number of judged runs over that of a group.
    """

    looks: tuple[CloseLook, ...]
    column: Mapping[int, Array]
    share: float

    @classmethod
    def of(
        cls,
        evidence: GapEvidence,
        sigma: Array,
        robot: RobotOffsets,
        weight: Array,
        laws: Laws,
        alone: Mapping[int, Fitted],
    ) -> ReferenceGains:
        """Of laws at the sizes that fit the judged runs alone. Too few references make no group.

        Args:
            sigma: (T,) 1 sigma of the states.
            robot: offsets, learned from all references.
            weight: (C,) of each channel, as for `metric`.
        """
        count = len(evidence.references)
        size = min(len(evidence.runs), count // 2)
        if count - size < FEWEST or not size:
            return cls((), {}, 0.0)
        references = evidence.references[: GROUPS * size]
        there = dataclasses.replace(evidence, runs=references, references=[])
        soils = [run.residuals.soil for run in references]
        at = {i: float(fit.values[0][0]) for i, fit in alone.items() if i not in laws.planes}
        points = [SimulatedSize(laws.names[i], x, soils) for i, x in at.items() if x]
        bank = SignatureBank.empty(there).with_sizes(there, points)
        shared = references[0].by_parameter.shape[1]
        place = {law: shared + k for k, law in enumerate(bank.signatures)}  # each at one size
        column, used = dict[int, Array](), dict[int, Array]()
        for i, fit in alone.items():
            own = [place[laws.names[i]]] if laws.names[i] in place else []
            column[i] = np.array(laws.names[i].columns if i in laws.planes else own, dtype=int)
            used[i] = np.zeros(shared + len(place) + 2)
            used[i][column[i]] = fit.values[0] if i in laws.planes else 1.0
        products, extra = products_with_discrepancy(references, evidence.model, bank, used)
        scores, looks = [score(run, sigma) for run in evidence.references], list[CloseLook]()
        for first in range(0, len(references) - size + 1, size):
            group = range(first, first + size)
            others = robot.of([s for i, s in enumerate(scores) if i not in group])
            group_metric = metric([products[i] for i in group], weight, sigma, others)
            looks.append(CloseLook(group_metric, laws, (), extra))
        return cls(tuple(looks), column, len(evidence.runs) / size)

    def most(self, laws: Sequence[int]) -> float:
        """Log likelihood ratio of some laws together on references, as of so many runs as are judged: the
        largest of any group, since groups are few and their gains differ widely."""
        if not self.looks:
            return 0.0
        at = np.concatenate([self.column[i] for i in laws])
        gains = []
        for look in self.looks:
            m, share = look.with_discrepancy(laws)
            inner, b = m.K[np.ix_(at, at)], m.K[at, m.error]
            gains.append(share + 0.5 * float(b @ np.linalg.solve(inner + RIDGE * np.eye(len(b)), b)))
        return self.share * max(*gains, 0.0)
