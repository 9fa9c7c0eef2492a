"""From the evidence of sets of effects to a verdict."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.gap.data.candidates import SOIL_STRENGTH, Candidates
from terrafusion.twin.gap.infer.calibration import Head, calibration_head, log_odds, probabilities
from terrafusion.twin.gap.infer.detection import Detection
from terrafusion.twin.gap.infer.explain import Explanation, Sets
from terrafusion.twin.gap.infer.single_effects import Fitted
from terrafusion.twin.sensors.effects import DELAYS

UNKNOWN = 0.5  # probability of an unknown cause, given a gap, above which that is the verdict
CREDIBLE, LEAST_MEMBER = 0.95, 0.02
"""Probability of a credible set, and the least (assumed) of a member, given the effects beside it."""
MOST_LEFT = 0.5  # share of the gap that named effects may leave on drives unlike the references' (assumed)
FINEST_P = {False: 1e-4, True: 1e-3}
"""Least p-value that counts as evidence of an unknown cause: below, it is extrapolated (assumed).
Keys: whether drives are unlike the references'."""
MOST_UNNAMED, LEAST_PROBABILITY = 3, 0.01  # further sets, and the least probability of an effect in one


@dataclass(frozen=True, eq=False)
class Cause:
    """One candidate.

    Attributes:
        effect, members: its name, and those of its credible set (itself first).
        probability: that it is present, alone or with others.
        columns, value, sigma: (k,) its best law, in units of `Candidates.scale`.
        share: of what all effects explain together.
    """

    effect: str
    members: tuple[str, ...]
    probability: float
    columns: tuple[int, ...]
    value: Array
    sigma: Array
    share: float | None


@dataclass(frozen=True)
class CredibleSet:
    """Effects of which one is present with a probability, and whether the verdict names it."""

    effects: tuple[str, ...]
    probability: float
    named: bool


@dataclass(frozen=True, eq=False)
class GapVerdict:
    """The verdict, its named effects, all causes and credible sets, the most probable first; `fit` is that of
    the named effects, `log_odds` those of any effect against none, `left` the share of the gap that the named
    ones leave, None where whole runs show no excess."""

    kind: str
    named: tuple[str, ...]
    causes: list[Cause]
    sets: list[CredibleSet]
    p_null: float
    p_unknown: float
    fit: Fitted | None
    log_odds: float = 0.0
    left: float | None = 0.0

    def ambiguous(self) -> Cause | None:
        """The most probable of the named causes that cannot be distinguished from others."""
        return next((c for c in self.causes if c.effect in self.named and len(c.members) > 1), None)

    def withheld_on_unseen_drives(self, significant: bool = True, sure: bool = False) -> Self:
        """On drives unlike the references', or patchier ground: undecided where no effect explains the gap
        well, as it may come from these, or where the test is not `significant` at a stricter threshold. Where
        it is `sure` that there is a gap, its cause is unknown instead."""
        explained = self.kind != "unknown" and self.log_odds >= 0.0 and (self.left or 0.0) <= MOST_LEFT
        if (significant and explained) or (sure and self.kind == "unknown"):
            return self
        if sure and self.kind != "no_gap":
            return self.refuted()
        return self.undecided()

    def undecided(self) -> Self:
        """Without a gap that could be named."""
        loose = [dataclasses.replace(s, named=False) for s in self.sets]
        return dataclasses.replace(self, kind="no_gap", named=(), sets=loose, fit=None)

    def refuted(self) -> Self:
        """An unknown cause, where the twin with the named effects is nearly as far from the runs as without:
        the likelihood only compares effects, with noise as loud as the best of them leaves."""
        share, p_effect = 1.0 - CREDIBLE, 1.0 - self.p_null - self.p_unknown
        causes = [dataclasses.replace(c, probability=share * c.probability) for c in self.causes]
        sets = [dataclasses.replace(s, probability=share * s.probability, named=False) for s in self.sets]
        return dataclasses.replace(
            self, kind="unknown", named=(), causes=causes, sets=sets, fit=None,
            p_unknown=self.p_unknown + (1.0 - share) * p_effect,
        )  # fmt: skip


def null_probability(p_value: float) -> float:
    """Least posterior probability of no gap at even odds (Sellke, Bayarri and Berger 2001, eq. 3)."""
    if p_value >= 1.0 / math.e:
        return 0.5 + 0.5 * (p_value - 1.0 / math.e) / (1.0 - 1.0 / math.e)
    bound = -math.e * p_value * math.log(max(p_value, 1e-300))
    return bound / (1.0 + bound)


def judge(
    detection: Detection, significance: float, found: Explanation, candidates: Candidates,
    head: Head | None = None, other_drives: bool = False,
) -> GapVerdict:  # fmt: skip
    """The verdict; without a head, by that of the package. On drives unlike the references', where no p-value
    is as fine, a tiny one speaks less for an unknown cause."""
    head = calibration_head() if head is None else head
    p_null, detected = null_probability(detection.p_value), detection.p_value <= significance
    p_value = max(detection.p_value, FINEST_P[other_drives])
    sets, unknown = probabilities(found, len(candidates.effects), head, p_value)
    unknown = unknown if detected else 0.0
    scale = (1.0 - p_null) * (1.0 - unknown) / sum(sets.values())
    sets = {name: scale * p for name, p in sets.items()}
    best = most_probable(sets, found.evidence)
    likely = detected and unknown <= UNKNOWN  # else what is left is nearly even over the whole catalogue
    classes = {
        effect: credible_members(effect, best, sets, found.alike) if likely else (effect,)
        for effect in (best if detected else ())
    }
    credible = credible_sets(classes, sets) if detected else []
    causes = _causes(found, sets, best, classes, candidates, head)
    p_unknown = (1.0 - p_null) * unknown
    if not detected:
        return GapVerdict("no_gap", (), causes, [], p_null, p_unknown, None)
    if unknown > UNKNOWN:
        loose = [dataclasses.replace(s, named=False) for s in credible]
        return GapVerdict("unknown", (), causes, loose, p_null, p_unknown, None)
    named = tuple(c.effect for c in causes if c.effect in best)
    kind = "ambiguous" if any(len(members) > 1 for members in classes.values()) else "effect"
    alone = credible_members(SOIL_STRENGTH, best, sets, {}) if best == (SOIL_STRENGTH,) else ()
    kind = "parameters" if alone == (SOIL_STRENGTH,) else kind  # whatever it resembles, the runs exclude
    odds = log_odds(found, len(candidates.effects))
    fit = found.fits[best]
    verdict = GapVerdict(kind, named, causes, credible, p_null, p_unknown, fit, odds, found.left.get(best))
    surely = odds > math.log(CREDIBLE / (1.0 - CREDIBLE))  # as of a limit that acts beyond a size
    return (
        verdict if surely or any(map(_differs_from_zero, fit.values, fit.covariance)) else verdict.undecided()
    )


def _differs_from_zero(value: Array, covariance: Array) -> bool:
    """Whether the 95 % confidence region of a law's sizes (k,) leaves zero out; those of a law that is
    simulated are one."""
    from scipy.special import chdtri

    freedom = np.linalg.matrix_rank(covariance, hermitian=True)
    square = value @ np.linalg.pinv(covariance, hermitian=True) @ value
    return bool(square > chdtri(freedom, 1.0 - CREDIBLE))


def most_probable(sets: Mapping[Sets, float], evidence: Mapping[Sets, float]) -> Sets:
    """The most probable set of the most probable number of effects; of equals that of most log evidence: an
    unknown cause may be so much more probable that all sets are equal to the last bit."""
    by_count: dict[int, float] = {}
    for name, p in sets.items():
        by_count[len(name)] = by_count.get(len(name), 0.0) + p
    count = max(by_count, key=lambda k: by_count[k])
    return max((name for name in sets if len(name) == count), key=lambda name: (sets[name], evidence[name]))


def credible_members(
    effect: str, best: Sets, sets: Mapping[Sets, float], alike: Mapping[str, set[str]]
) -> tuple[str, ...]:
    """Effects that could stand in the place of one, the others being as they are; and those whose signatures
    differ from its own by no more than a law is wrong."""
    others = {*best} - {effect}
    instead = {
        next(iter({*name} - others)): p
        for name, p in sets.items()
        if (len(name) == len(best) and others < {*name}) or (not others and len(name) == 1)
    }
    total, sum_, members = sum(instead.values()), 0.0, [effect]
    for name in sorted(instead, key=lambda name: (name != effect, -instead[name])):
        if name != effect and (sum_ >= CREDIBLE * total or instead[name] < LEAST_MEMBER * total):
            continue
        members += [name] if name != effect else []
        sum_ += instead[name]
    same = sorted(alike.get(effect, set()) - {*members, *best})  # a set has no order of its own
    return (*members, *sorted(same, key=lambda name: -instead.get(name, 0.0)))


def credible_sets(classes: Mapping[str, tuple[str, ...]], sets: Mapping[Sets, float]) -> list[CredibleSet]:
    """A set for each named effect, then for the most probable others; the most certain first."""

    def present(effects: Sequence[str]) -> float:
        return min(sum(p for name, p in sets.items() if {*effects} & {*name}), 1.0)

    out = [CredibleSet(members, present(members), named=True) for members in classes.values()]
    used = {effect for members in classes.values() for effect in members}
    every = dict.fromkeys(effect for name in sets for effect in name if effect not in used)
    rest = sorted(every, key=lambda effect: -present([effect]))[:MOST_UNNAMED]
    out += [CredibleSet((e,), present([e]), named=False) for e in rest if present([e]) >= LEAST_PROBABILITY]
    return sorted(out, key=lambda s: (not s.named, -s.probability))


def _causes(
    found: Explanation, sets: Mapping[Sets, float], best: Sets, classes: Mapping[str, tuple[str, ...]],
    candidates: Candidates, head: Head,
) -> list[Cause]:  # fmt: skip
    """All candidates, the most probable first."""
    weight = dict.fromkeys(candidates.effects, 0.0)
    for name, p in sets.items():
        for effect in name:
            weight[effect] += p
    most = max(fit.gain for fit in found.fits.values())
    out = []
    for effect in sorted(weight, key=lambda effect: (-weight[effect], -found.evidence[effect,])):
        alone = found.fits[effect,]
        fit = found.fits[best] if effect in best else alone
        k = next(k for k, law in enumerate(fit.laws) if law.effect == effect)
        columns, value = fit.laws[k].columns, fit.values[k]
        share = float(np.clip(alone.gain / max(most, 1e-9), 0.0, 1.0))
        sigma = _sigma(candidates, columns, value, fit.covariance[k], head)
        members = classes.get(effect) or next(
            ((effect, *(m for m in some if m != effect)) for some in classes.values() if effect in some),
            (effect,),
        )
        out.append(Cause(effect, members, weight[effect], columns, value, sigma, share))
    return out


def _sigma(
    candidates: Candidates, columns: Sequence[int], value: Array, covariance: Array, head: Head
) -> Array:
    """1 sigma (k,) of sizes: by the runs, and by how wrong the law is."""
    motion = {*candidates.moving, *DELAYS}
    law = [head.law_motion if candidates.keys[i] in motion else head.law_sensor for i in columns]
    return np.hypot(np.sqrt(np.diag(covariance)), law * np.abs(value))
