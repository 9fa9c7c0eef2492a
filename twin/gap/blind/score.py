"""All trials judged, as numbers: what `blind.json` holds."""

import statistics
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from terrafusion.twin.gap.blind.answers import DIAGNOSIS
from terrafusion.twin.gap.blind.headline import headline
from terrafusion.twin.gap.blind.plan import D_PRIMES, FAMILIES, HARDER, OTHER_DRIVES, PLAIN, Trial
from terrafusion.twin.gap.blind.rates import rate, reliability
from terrafusion.twin.gap.blind.shapes import shapes
from terrafusion.twin.gap.blind.verdicts import Judged, judge

SCHEMA = "terrafusion.gap-blind/2"
SINGLE = ("same", "shifted")


def score(
    trials: Sequence[Trial],
    answers: Mapping[str, Mapping[str, Any]],
    oracle: Mapping[str, float] | None = None,
    methods: Sequence[str] = (DIAGNOSIS,),
) -> dict[str, Any]:
    """Scores of all methods, and the headline with the targets.

    Args:
        trials: with their truth.
        answers: by trial; missing ones count as crashes.
        oracle: share of the gap that goes away when the true effect is given, by trial, where known.
    """
    found = {
        name: _figures([judge(t, answers.get(t.trial, {}).get(name)) for t in trials], oracle or {})
        for name in methods
    }
    return {
        "schema": SCHEMA,
        "trials": len(trials),
        "families": dict(Counter(trial.family for trial in trials)),
        "headline": headline(found),
        "figures": found,
    }


def _figures(judged: Sequence[Judged], oracle: Mapping[str, float]) -> dict[str, Any]:
    """Figures of one method. Effects on other drives and in `HARDER` settings stand by themselves; all others
    are of trials on the references' drives."""
    plain = [j for j in judged if j.trial.setting == PLAIN]
    singles = {family: _of(plain, family, detected=True) for family in SINGLE}
    every = [j for many in singles.values() for j in many]

    def by_family(outcome: Callable[[Judged], bool]) -> dict[str, Any]:
        return {family: _rate(many, outcome) for family, many in singles.items()}

    return {
        "crashes": sorted(j.trial.trial for j in judged if j.crashed),
        "false_alarms": _false_alarms(judged),
        "power": {
            family: {f"{d:g}": _rate([j for j in _of(plain, family) if j.trial.d_prime == d], _detected)
                     for d in D_PRIMES}
            for family in (*SINGLE, "outside")
        },
        "power_all": {
            f"{d:g}": _rate([j for j in _of(plain, *SINGLE) if j.trial.d_prime == d], _detected)
            for d in D_PRIMES
        },
        "settings": {s: _effects_of([j for j in judged if j.trial.setting == s])
                     for s in (*OTHER_DRIVES, *HARDER)},
        "other_drives": _effects_of([j for j in judged if j.trial.setting in OTHER_DRIVES]),
        "right": by_family(Judged.right),
        "top1": by_family(lambda j: j.top(1)),
        "top3": by_family(lambda j: j.top(3)),
        "class_size": {
            family: _mean([len(j.first_class) for j in many if j.first]) for family, many in singles.items()
        },
        "confidence": {
            family: reliability([j.confidence for j in many], [j.top(1) for j in many]).to_json()
            for family, many in singles.items()
        },
        "unknown": {
            "recall": _rate(_of(plain, "outside", detected=True), _unknown), "false": _rate(every, _unknown)
        },
        "pairs": _pairs(judged),
        "extras_single": _mean([j.extras for j in every]),
        "sizes": _rate(
            [j for j in every if j.deviation is not None], lambda j: abs(j.deviation or 0.0) <= 2.0
        ),
        "shrink": _shrink(every, oracle),
        "confusion": _confusion(judged),
        "verdicts": {f: dict(Counter(j.verdict for j in _of(judged, f)).most_common()) for f in FAMILIES},
        "seconds": statistics.median(j.seconds for j in judged) if judged else None,
    }  # fmt: skip


def _of(judged: Sequence[Judged], *families: str, detected: bool = False) -> list[Judged]:
    return [j for j in judged if j.trial.family in families and (j.detected or not detected)]


def _rate(judged: Sequence[Judged], outcome: Callable[[Judged], bool]) -> dict[str, Any]:
    return rate([outcome(j) for j in judged]).to_json()


def _detected(j: Judged) -> bool:
    return j.detected


def _unknown(j: Judged) -> bool:
    return j.verdict == "unknown"


def _mean(values: Sequence[float]) -> float | None:
    return statistics.fmean(values) if values else None


def _false_alarms(judged: Sequence[Judged]) -> dict[str, Any]:
    """By setting, and of all on other drives."""
    nulls = _of(judged, "null")
    groups = {s: [j for j in nulls if j.trial.setting == s] for s in (PLAIN, *OTHER_DRIVES, *HARDER)}
    groups["other drives"] = [j for s in OTHER_DRIVES for j in groups[s]]
    return {name: _rate(many, _detected) for name, many in groups.items()}


def _effects_of(judged: Sequence[Judged]) -> dict[str, Any]:
    """Power and naming of single effects."""
    some = _of(judged, *SINGLE)
    return {
        "power": _rate(some, _detected),
        "right": _rate([j for j in some if j.detected], Judged.right),
    }


def _pairs(judged: Sequence[Judged]) -> dict[str, Any]:
    """`both` counts pairs of which each effect is seen alone, on the same robot, ground and drives."""
    alone: dict[str, list[bool]] = {}
    for j in judged:
        if j.trial.part_of:
            alone.setdefault(j.trial.part_of, []).append(j.detected)
    pairs = _of(judged, "pair")
    fair = [j for j in pairs if sum(alone.get(j.trial.trial, ())) == len(j.trial.effects())]
    return {
        "both": _rate(fair, lambda j: j.found == 2),
        "both_of_all": _rate(pairs, lambda j: j.found == 2),
        "extras": _mean([j.extras for j in fair]),
    }


def _shrink(judged: Sequence[Judged], oracle: Mapping[str, float]) -> dict[str, Any]:
    """Mean share of the gap that disappears, and the oracle's on the same trials."""
    both = [
        (j.shrink, oracle[j.trial.trial]) for j in judged if j.shrink is not None and j.trial.trial in oracle
    ]
    mean, best = _mean([share for share, _ in both]), _mean([best for _, best in both])
    ratio = mean / best if mean is not None and best else None
    return {"mean": mean, "oracle": best, "count": len(both), "over_oracle": ratio}


def _confusion(judged: Sequence[Judged]) -> dict[str, dict[str, int]]:
    """True effect against the effect ranked first, or no_gap, unknown, crash."""
    table: dict[str, Counter[str]] = {}
    for j in judged:
        if j.trial.family != "pair":
            truth = (*j.trial.effects(), "no_gap")[0]
            table.setdefault(truth, Counter())[_answer(j)] += 1
    order = [*dict.fromkeys(shape.effect for shape in shapes().values()), "no_gap"]
    return {truth: dict(table[truth].most_common()) for truth in order if truth in table}


def _answer(j: Judged) -> str:
    if j.crashed:
        return "crash"
    if not j.detected:
        return "no_gap"
    return "unknown" if j.verdict == "unknown" or j.first is None else j.first
