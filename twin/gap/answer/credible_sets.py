"""Sets of effects that the runs cannot distinguish, one for each effect of a verdict."""

from __future__ import annotations

from dataclasses import dataclass

from terrafusion.twin.gap.answer.verdict import LEAST_PROBABILITY, GapVerdict

MOST_UNNAMED = 3


@dataclass(frozen=True)
class CredibleSet:
    """Effects of which one is present with a probability, and whether the verdict names it."""

    effects: tuple[str, ...]
    probability: float
    named: bool


def credible_sets(verdict: GapVerdict) -> list[CredibleSet]:
    """A set for each named effect, then for the most probable others; the most certain first.

    Effects that act together are present together: the mass that the causes share among them is the
    probability of each of their sets.
    """
    if verdict.kind == "no_gap":
        return []
    by_name = {cause.effect: cause for cause in verdict.causes}
    named = [by_name[name] for name in verdict.named]
    used = set(verdict.named).union(*(cause.members for cause in named)) if named else set()
    together = min(sum(by_name[name].probability for name in used), 1.0)
    sets = [CredibleSet(cause.members, together, named=True) for cause in named]
    for cause in verdict.causes:
        if len(sets) >= len(named) + MOST_UNNAMED:
            break
        if cause.effect in used or cause.probability < LEAST_PROBABILITY:
            continue
        members = tuple(name for name in cause.members if name not in used)
        used.update(members)
        probability = min(sum(by_name[name].probability for name in members), 1.0)
        sets.append(CredibleSet(members, probability, named=False))
    return sorted(sets, key=lambda s: (not s.named, -s.probability))
