"""Close look at a few laws: alone and in pairs, each with the discrepancy of its form.

A law is never quite the robot's. Its signature times functions of the commands, which a law of another form
would depend on, and its signature in each channel by itself join the covariance in proportion to the size of
the effect (after Kennedy and O'Hagan 2001, with a basis in place of a Gaussian process).
"""

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.gap.infer.bank import SignatureBank
from terrafusion.twin.gap.infer.predictive import Metric, Products, excess
from terrafusion.twin.gap.infer.single_effects import Fitted, Laws
from terrafusion.twin.gap.rollout.nuisance import BASIS, CHANNEL_NAMES, command_basis
from terrafusion.twin.gap.rollout.residuals import WhitenedRun

FUNCTIONS = ("speed", "abs_turn", "turn_rate", "acceleration")
"""Factors of a law's signature, with time, each of mean zero and variance one over a run."""
DISCREPANCY = 0.1  # 1 sigma of the coefficient of each (assumed: together about a quarter of the signature)
ROUNDS, SAME = 4, 0.03
"""Most fits of laws, each with the discrepancy of the sizes before, and by what share these may differ."""
LEFT = 0.5
"""Most that a second law may leave of the excess that the first leaves (assumed, with one robot of another
simulator in view)."""
PAIRS, FIRST = 30, 5
"""Pairs that are fitted: the best to first sight, and all of the best laws."""


@dataclass(frozen=True, eq=False)
class CloseLook:
    """Laws examined, by index; columns of the discrepancy of each in the metric, and the norm of its values
    for which these are. `may_be_old` tells of a law, by index, and a size whether references may hold it."""

    metric: Metric
    laws: Laws
    index: tuple[int, ...]
    extra: Mapping[int, Array]
    size: Mapping[int, float]
    may_be_old: Callable[[int, float], bool]

    def fit(self, laws: Sequence[int]) -> Fitted:
        """Some laws together, with the discrepancy of each, in proportion to its size, in the covariance.

        Sizes are those without a discrepancy by channel: where channels differ, it would leave them to those
        that show least.
        """
        share = np.ones(len(laws))
        for _ in range(ROUNDS):
            found = self._fit(laws, share, len(FUNCTIONS) + 1)
            pairs = zip(laws, found.values, strict=True)
            before, share = share, np.array([np.linalg.norm(v) / max(self.size[i], 1e-9) for i, v in pairs])
            if np.allclose(share, before, atol=SAME):
                break
        m, more = self._with_discrepancy(laws, share)
        whole, left = self.laws.fit(m, laws), excess(m, found.used)
        return dataclasses.replace(found, gain=whole.gain + more, evidence=whole.evidence + more, left=left)

    def _fit(self, laws: Sequence[int], share: Array, first: int) -> Fitted:
        m, more = self._with_discrepancy(laws, share, first)
        found = self.laws.fit(m, laws)
        return dataclasses.replace(found, gain=found.gain + more, evidence=found.evidence + more)

    def _with_discrepancy(
        self, laws: Sequence[int], share: Array, first: int | None = None
    ) -> tuple[Metric, float]:
        """The metric with discrepancies of shares (k,) of the given sizes, the first columns of each, or all;
        and what these add to the log likelihood of no effect."""
        D, K, e = np.concatenate([self.extra[i][:first] for i in laws]), self.metric.K, self.metric.error
        sigma = DISCREPANCY * np.repeat(share, [len(self.extra[i][:first]) for i in laws])
        L = np.linalg.cholesky(sigma[:, None] * K[np.ix_(D, D)] * sigma + np.eye(len(D)))
        half = np.linalg.solve(L, sigma[:, None] * K[D])
        less = half.T @ half
        more = 0.5 * float(less[e, e]) - float(np.log(np.diag(L)).sum())
        return Metric(K - less, self.metric.shared), more

    def search(self) -> dict[tuple[int, ...], Fitted]:
        """Fits of all laws alone and of the pairs that look promising.

        A second law counts only where it explains most of what the first leaves: a law that is not quite the
        robot's leaves something of the shape of no law, a part of which any other explains. Nor does one that
        references may hold count beside one that has changed. The evidence of both is then that of the other
        alone.
        """
        found: dict[tuple[int, ...], Fitted] = {(i,): self.fit((i,)) for i in self.index}
        best = sorted(self.index, key=lambda i: -found[i,].evidence)[:FIRST]
        guess = self._pairs()
        pairs = {*sorted(guess, key=lambda pair: -guess[pair])[:PAIRS]}
        pairs |= {(min(pair), max(pair)) for pair in itertools.combinations(best, 2)} & guess.keys()
        for pair in sorted(pairs):
            both, first = self.fit(pair), min(pair, key=lambda i: found[i,].left)
            if both.left <= LEFT * found[first,].left:
                sizes = zip(pair, both.values, strict=True)
                new = [i for i, v in sizes if not self.may_be_old(i, float(v[0]))]
                if len(new) != 1:
                    found[pair] = both
                    continue
                (first,) = new
            if both.evidence > found[first,].evidence:
                found[first,] = dataclasses.replace(found[first,], evidence=both.evidence)
        return found

    def _pairs(self) -> dict[tuple[int, int], float]:
        """Log likelihood ratio of every pair of effects to first sight: one at its best, then the other."""
        names, out = self.laws.names, dict[tuple[int, int], float]()
        gains, _, used = self.laws.best(self.metric)
        for a in self.index:
            beside, _, _ = self.laws.best(self.metric, used[a])
            for b in self.index:
                if names[a].effect != names[b].effect:
                    pair = (min(a, b), max(a, b))
                    out[pair] = max(out.get(pair, -np.inf), float(gains[a] + beside[b]))
        return out


def products_with_discrepancy(
    runs: Sequence[WhitenedRun], model: Model, bank: SignatureBank, used: Mapping[int, Array], weight: Array
) -> tuple[list[Products], dict[int, Array]]:
    """Inner products of the runs with the discrepancy of laws among the columns, and its columns in the
    metric.

    Args:
        used: (M + 1,) coefficients of each law's signature at its size.
        weight: (C,) of each channel: one over the factor of its noise's variance.
    """
    columns, out = bank.columns(), list[Products]()
    first = runs[0].by_parameter.shape[1] + columns[0].shape[1]
    for run, signatures in zip(runs, columns, strict=True):
        f = np.column_stack([modulation(run, model), by_sensor(run)])
        own = np.column_stack([run.by_parameter, signatures])
        parts = [(own @ w[: own.shape[1]])[:, None] * f for w in used.values()]
        root = np.sqrt(weight)[run.channel][:, None]
        out.append(Products.of(run.weighted(weight), root * np.column_stack([signatures, *parts])))
    F = f.shape[1]
    return out, {i: first + F * k + np.arange(F) for k, i in enumerate(used)}


def modulation(run: WhitenedRun, model: Model) -> Array:
    """Factors (n, F) of a signature."""
    f = np.column_stack([command_basis(run.log, model, run.time_s), run.time_s])
    f = f[:, [*map(BASIS.index, FUNCTIONS), -1]]
    return np.asarray((f - f.mean(axis=0)) / np.maximum(f.std(axis=0), 1e-9))


def by_sensor(run: WhitenedRun) -> Array:
    """(n, S) which of the log's channels a sample is of; the wheels of both sides are one."""
    names = [CHANNEL_NAMES[o.channel] for o in run.log.observed]
    names = ["wheels" if name.startswith("wheel") else name for name in names]
    of_sample = np.array(names)[run.channel]
    return np.column_stack([of_sample == name for name in dict.fromkeys(names)]).astype(float)
