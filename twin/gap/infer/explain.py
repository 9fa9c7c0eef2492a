"""Explains a gap by the effects that caused it, or by a cause outside the catalogue.

A first look ranks all laws, alone and beside each of the best few, to first order; a second one those that
looked promising, simulated at their best sizes. The twin is simulated again at the best sizes of the
promising ones of these, which a close look compares alone and in pairs. Where even the best of them leaves
more in a channel than the references do, the noise of that channel is taken to be larger.
"""

import dataclasses
import itertools
import math
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.gap.infer.bank import SignatureBank, SimulatedSize, model_soil
from terrafusion.twin.gap.infer.close_look import CloseLook, products_with_discrepancy
from terrafusion.twin.gap.infer.detection import UNKNOWN_SIZES
from terrafusion.twin.gap.infer.other_drives import RobotOffsets
from terrafusion.twin.gap.infer.predictive import Metric, Products, energies, excess, metric
from terrafusion.twin.gap.infer.reference_check import ReferenceCheck
from terrafusion.twin.gap.infer.single_effects import Fitted, Laws
from terrafusion.twin.gap.null.evidence import GapEvidence
from terrafusion.twin.gap.rollout.residuals import soil_columns

Sets = tuple[str, ...]  # names of effects that act together, sorted

FIRST, BESIDE, TRIED = 12, 5, 4
"""Laws that get a close look: the best alone, and the best beside each of the best few."""
SECOND, GROWTH = 18, 3.0
"""Best laws alone that get a second look, and the factor from a best size to the next one simulated there."""
WEIGHINGS = 2  # of channels
LEAST_NORMAL = 0.5  # least mean squared whitened error of references that a channel is compared with
CLOSE, LEAST_SIZE = 0.02, 0.05  # sizes nearer than this share, or that of typical ones, are not simulated
SURELY = math.log(20.0)  # log evidence by which a composite law must be ahead of its effect's others
SAME_SIGNATURE, LEAST_SIGNATURE = 0.97, 3.0
"""Correlation of whole signatures, of so many sigmas at least, from which they differ by a quarter: about as
much as a law is wrong."""


@dataclass(frozen=True, eq=False)
class Explanation:
    """What the judged runs say about sets of effects.

    Attributes:
        evidence: log evidence by set.
        fits: of each set's best laws.
        outside: log evidence of a cause outside the catalogue.
        alike: by effect, those whose whole signatures nearly coincide with its own at their sizes.
        left_out: gives the values of a set's best laws fitted without each run, one tuple a run.
        left: share (0..1) of the gap's excess (`predictive.excess`) that a set leaves, after a close look;
            empty without an excess.
    """

    evidence: dict[Sets, float]
    fits: dict[Sets, Fitted]
    outside: float
    alike: dict[str, set[str]]
    left_out: Callable[[Fitted], list[tuple[Array, ...]]]
    left: Mapping[Sets, float] = dataclasses.field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class _Look:
    """The judged runs in the columns of a bank of signatures, and all laws there."""

    bank: SignatureBank
    runs: list[Products]
    metric: Metric
    laws: Laws


@dataclass(frozen=True, eq=False)
class _Explainer:
    evidence: GapEvidence
    sigma: Array
    robot: RobotOffsets
    without: Collection[str]

    def look(self, bank: SignatureBank, runs: list[Products] | None = None) -> _Look:
        """At the judged runs, or at their products with further columns."""
        columns = zip(self.evidence.runs, bank.columns(), strict=True)
        runs = [Products.of(r, s) for r, s in columns] if runs is None else runs
        m = metric(runs, self.sigma, self.robot)
        return _Look(bank, runs, m, Laws.of(self.evidence.candidates, bank.ladders(), m.shared, m.none))

    def alone(self, look: _Look) -> dict[int, Fitted]:
        """Fits of single laws, but for those left out."""
        return {
            i: look.laws.fit(look.metric, (i,))
            for i, h in enumerate(look.laws.names)
            if not {*self.without} & {h.effect, f"{h.effect}/{h.form}"}
        }

    def promising(self, look: _Look, alone: Mapping[int, Fitted], most: int) -> dict[int, list[float]]:
        """Laws worth a closer look, with the sizes at which to simulate them (of one size)."""
        order = sorted(alone, key=lambda i: -alone[i].evidence)
        sizes = {i: [float(alone[i].values[0][0])] for i in order[:most]}
        for i in order[:TRIED]:
            gains, values, _ = look.laws.best(look.metric, alone[i].used)
            others = [k for k in order if look.laws.names[k].effect != look.laws.names[i].effect]
            for k in sorted(others, key=lambda k: -gains[k])[:BESIDE]:
                sizes.setdefault(k, []).append(float(values[k][0]))
        return sizes

    def with_first_sizes(self, look: _Look, sizes: Mapping[int, list[float]]) -> SignatureBank:
        """The bank simulated at some sizes, and at larger ones: the sensitivity of a law that saturates makes
        them too small."""
        points, soils = list[SimulatedSize](), model_soil(self.evidence)
        for i, some in sizes.items():
            law = look.laws.names[i]
            if law in look.bank.signatures:
                known = look.bank.sizes(law)
                new = [*some, float(np.clip(GROWTH * some[0], known[0], known[-1]))]
                points += [SimulatedSize(law, x, soils) for x in new if abs(x) > LEAST_SIZE]
        return look.bank.with_sizes(self.evidence, points)

    def with_best_sizes(self, look: _Look, sizes: Mapping[int, list[float]]) -> SignatureBank:
        """The bank simulated where no size is near the best ones, each run on the soil that fits it beside
        the law. Where the law is one of the soil itself, what the runs have in common belongs to the law."""
        limit, soil = self.evidence.soil_limit, soil_columns(self.evidence.candidates)
        _, _, used = look.laws.best(look.metric)
        points = list[SimulatedSize]()
        for i, some in sizes.items():
            law = look.laws.names[i]
            if law not in look.bank.signatures:
                continue
            own = np.array([run.fitted_states(used[i][:-2], self.sigma, self.robot) for run in look.runs])
            own = own[:, : len(limit)]
            for k in (soil.index(column) for column in law.columns if column in soil):
                own[:, k] -= own[:, k].mean()
            soils, known = list(np.clip(own, -limit, limit)), look.bank.sizes(law)
            new = [x for x in dict.fromkeys(some) if np.abs(known - x).min() > _near(x)]
            points += [SimulatedSize(law, x, soils) for x in new]
        return look.bank.with_sizes(self.evidence, points)

    def outside(self, m: Metric) -> float:
        """Log evidence of a change along the whole nuisance basis."""
        basis = np.arange(self.evidence.candidates.count, m.shared - self.robot.misfit)
        values, vectors = np.linalg.eigh(m.K[np.ix_(basis, basis)])
        square = np.square(UNKNOWN_SIZES)[:, None]
        grown = 1.0 + square * np.maximum(values, 0.0)
        each = 0.5 * (square * (vectors.T @ m.K[basis, m.error]) ** 2 / grown - np.log(grown)).sum(axis=1)
        return float(np.logaddexp.reduce(each) - math.log(len(each)))

    def normal_energies(self) -> Array:
        """(C,) mean squared error of each channel of the references, one without them."""
        each, none = list[Array](), np.zeros(0)
        for run in self.evidence.references:
            products = Products(run.gram, run.states, len(self.robot.mean))
            each.append(energies(run, products, none, run.error, self.sigma, self.robot))
        return (
            np.maximum(np.mean(each, axis=0), LEAST_NORMAL) if each else np.ones(len(self.evidence.channels))
        )

    def weights(self, look: _Look, best: Fitted, normal: Array) -> Array:
        """(C,) one over the factor by which the best set's rest is above the references', at least one."""
        P, now = look.metric.shared, list[Array]()
        moved = dataclasses.replace(self.robot, mean=self.robot.mean + best.used[:P])
        used = best.used[P:-2]
        for run, products, own in zip(self.evidence.runs, look.runs, look.bank.columns(), strict=True):
            left = run.error - own @ used[: own.shape[1]]
            now.append(energies(run, products, used, left, self.sigma, moved))
        return np.asarray(1.0 / np.maximum(np.mean(now, axis=0) / normal, 1.0))


def explain(
    evidence: GapEvidence, sigma: Array, robot: RobotOffsets, *, close: bool, without: Collection[str] = ()
) -> Explanation:
    """Log evidence of sets of effects.

    Args:
        sigma: (T,) 1 sigma of the states.
        close: whether to simulate the twin and look at pairs; without, only first-order evidence of each
            effect alone.
        without: effects, or forms of them (effect/form), that are left out.
    """
    own = _Explainer(evidence, sigma, robot, without)
    # First look: sensitivities.
    look = own.look(SignatureBank.of(evidence, simulate=close))
    alone = own.alone(look)
    if not close:
        one: dict[tuple[int, ...], Fitted] = {(i,): fit for i, fit in alone.items()}
        count, outside = len(evidence.runs), own.outside(look.metric)
        return _by_effect(one, alone, look.laws, outside, {}, lambda fit: [fit.values] * count)
    # Second look: the twin simulated at the sizes of the first.
    look = own.look(own.with_first_sizes(look, own.promising(look, alone, SECOND)))
    alone = own.alone(look)
    # The most promising laws alone, simulated where no size is near the best one.
    sizes = own.promising(look, alone, FIRST)
    bank = own.with_best_sizes(look, sizes).only(look.laws.names[i] for i in sizes)
    return _close_look(own, bank, tuple(sizes), alone)


def _close_look(
    own: _Explainer, bank: SignatureBank, index: tuple[int, ...], alone: Mapping[int, Fitted]
) -> Explanation:
    """Promising laws, by index, alone and in pairs, with their discrepancies; `alone` are fits of all laws
    without it."""
    evidence, look = own.evidence, own.look(bank)
    _, values, used = look.laws.best(look.metric)
    wanted, weight = {i: used[i] for i in index}, np.ones(len(evidence.channels))
    size = {i: float(np.linalg.norm(values[i])) for i in index}
    normal = own.normal_energies()
    plain = list[Products]()
    check = ReferenceCheck(bank, evidence)

    def may_be_old(i: int, size: float) -> bool:
        return check.may_be_old(look.laws.names[i], size)

    for _ in range(WEIGHINGS):
        runs, extra = products_with_discrepancy(evidence.runs, evidence.model, bank, wanted, weight)
        plain, look = plain or runs, own.look(bank, runs)
        laws = look.laws
        found = CloseLook(look.metric, laws, index, extra, size, may_be_old).search()
        top = max(found, key=lambda some: found[some].evidence - 5.0 * len(some))
        before, weight = weight, own.weights(look, found[top], normal)
        if np.allclose(before, weight, rtol=0.1):
            break

    def left_out(fit: Fitted) -> list[tuple[Array, ...]]:
        if len(runs) == 1:
            return [fit.values]
        some = [laws.names.index(law) for law in fit.laws]
        parts = [metric([r for r in runs if r is not run], own.sigma, own.robot) for run in runs]
        return [laws.fit(part, some).values for part in parts]

    single = [found[i,] for i in index]
    effects = {fit.laws[0].effect for fit in single}
    shown = [_shown([f for f in single if f.laws[0].effect == e], laws) for e in effects]
    # Where one side has changed, it is beside the point what a change of both would resemble.
    is_composite = laws.candidates.is_composite
    alike = _same_signatures(plain, [f for f in single if f in shown or not is_composite(*f.laws)])
    every = _by_effect(found, alone, laws, own.outside(look.metric), alike, left_out)
    whole = excess(look.metric)
    left = {effects: min(fit.left / whole, 1.0) for effects, fit in every.fits.items()} if whole else {}
    return dataclasses.replace(every, left=left)


def _same_signatures(runs: Sequence[Products], fits: Sequence[Fitted]) -> dict[str, set[str]]:
    """By effect, those whose signatures nearly coincide with its own before the ground is fitted."""
    T, out = runs[0].states, dict[str, set[str]]()
    G = np.sum([run.gram[T:-1, T:-1] for run in runs], axis=0)
    used = np.array([fit.used[:-2] for fit in fits])
    inner = used @ G @ used.T
    size = np.sqrt(np.diag(inner))
    names = [fit.laws[0].effect for fit in fits]
    for a, b in itertools.permutations(range(len(names)), 2):
        seen = min(size[a], size[b]) > LEAST_SIGNATURE
        if seen and names[a] != names[b] and abs(inner[a, b]) > SAME_SIGNATURE * size[a] * size[b]:
            out.setdefault(names[a], set()).add(names[b])
    return out


def _by_effect(
    found: Mapping[tuple[int, ...], Fitted],
    alone: Mapping[int, Fitted],
    laws: Laws,
    outside: float,
    alike: dict[str, set[str]],
    left_out: Callable[[Fitted], list[tuple[Array, ...]]],
) -> Explanation:
    """Sets of laws by their effects: forms are alternatives of equal weight. Laws without a close look are as
    far behind the best as at first look, or further."""
    close = {i for some in found for i in some}
    worst, lowest = min(alone[i].evidence for i in close), min(found[i,].evidence for i in close)
    every = dict(found)
    for i in alone.keys() - close:
        behind = max(worst - alone[i].evidence, 0.0)
        every[i,] = dataclasses.replace(alone[i], evidence=lowest - behind)
    groups = dict[Sets, list[Fitted]]()
    for some, fit in every.items():
        groups.setdefault(tuple(sorted(laws.names[i].effect for i in some)), []).append(fit)
    # One that is composite is as probable as another, and takes nothing from those.
    forms = Counter(law.effect for law in laws.names if not laws.candidates.is_composite(law))
    evidence = {
        effects: float(np.logaddexp.reduce([fit.evidence for fit in some]))
        - math.log(math.prod(forms[effect] or 1 for effect in effects))
        for effects, some in groups.items()
    }
    fits = {effects: _shown(some, laws) for effects, some in groups.items()}
    return Explanation(evidence, fits, outside, alike, left_out)


def _shown(fits: Sequence[Fitted], laws: Laws) -> Fitted:
    """The most probable; with a composite law, which may claim a side, where the others surely fit less."""
    claims = [any(map(laws.candidates.is_composite, fit.laws)) for fit in fits]
    return max(zip(fits, claims, strict=True), key=lambda one: one[0].evidence - SURELY * one[1])[0]


def _near(size: float) -> float:
    """How near to a size the twin need not be simulated once more."""
    return CLOSE * max(abs(size), LEAST_SIZE)
