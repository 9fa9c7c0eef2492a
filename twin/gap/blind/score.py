"""All trials judged, as numbers: what `blind.json` holds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from terrafusion.twin.gap.blind.answers import DIAGNOSIS
from terrafusion.twin.gap.blind.plan import D_PRIMES, FAMILIES, HARDER, OTHER_DRIVES, PLAIN, Trial
from terrafusion.twin.gap.blind.rates import Rate, reliability
from terrafusion.twin.gap.blind.shapes import shapes
from terrafusion.twin.gap.blind.verdicts import judge

if TYPE_CHECKING:
    import pandas as pd

SCHEMA = "terrafusion.gap-blind/2"
SINGLE = ("same", "shifted")
TARGETS: tuple[tuple[str, str, tuple[float, float] | None], ...] = (
    ("false alarms, same drives", "false_alarms.same drives", (0.0, 0.05)),
    ("upper bound of that, same drives", "false_alarms.same drives.high", (0.0, 0.10)),
    ("false alarms, other drives", "false_alarms.other drives", (0.0, 0.05)),
    ("upper bound of that, other drives", "false_alarms.other drives.high", (0.0, 0.10)),
    ("power at d' 5", "power_all.5", None),
    ("power at d' 10", "power_all.10", (0.5, 1.0)),
    ("power at d' 25", "power_all.25", (0.9, 1.0)),
    ("power on other drives, d' 10 and 25", "other_drives.power", None),
    ("right and not unknown, same form", "right.same", (0.90, 1.0)),
    ("right and not unknown, form-shifted", "right.shifted", (0.85, 1.0)),
    ("right and not unknown, other drives", "other_drives.right", None),
    ("mean credible set, same form", "class_size.same", (1.0, 2.0)),
    ("mean credible set, form-shifted", "class_size.shifted", (1.0, 2.0)),
    ("class top-1, same form", "top1.same", (0.95, 1.0)),
    ("class top-1, form-shifted", "top1.shifted", (0.90, 1.0)),
    ("class top-3, same form", "top3.same", (0.98, 1.0)),
    ("class top-3, form-shifted", "top3.shifted", (0.95, 1.0)),
    ("ECE, same form", "confidence.same.ece", (0.0, 0.05)),
    ("ECE, form-shifted", "confidence.shifted.ece", (0.0, 0.10)),
    ("unknown recall", "unknown.recall", (0.85, 1.0)),
    ("false unknown", "unknown.false", (0.0, 0.10)),
    ("both of a pair, each seen alone", "pairs.both", (0.85, 1.0)),
    ("false extras a pair", "pairs.extras", (0.0, 0.2)),
    ("size within 2 sigma", "sizes", (0.90, 0.98)),
    ("shrink over the oracle's", "shrink.over_oracle", (0.9, 1.1)),
    ("CPU seconds a data set, median", "seconds", (0.0, 8.0)),
)
"""Name, place among the figures, and the closed range that is its target; None: reported without one."""


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
        name: _figures(_judged(trials, {t: some.get(name) for t, some in answers.items()}), oracle or {})
        for name in methods
    }
    return {
        "schema": SCHEMA,
        "trials": len(trials),
        "families": dict(Counter(trial.family for trial in trials)),
        "headline": _headline(found),
        "figures": found,
    }


def _headline(figures: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """One row a figure: `name`, `target` [low, high] or null, and by method `value` (null: not measured),
    `hits`, `count`, `low` and `high` (null where it is no rate), `met`."""
    rows = []
    for name, place, target in TARGETS:
        row: dict[str, Any] = {"name": name, "target": None if target is None else list(target)}
        for method, some in figures.items():
            found = _figure_at(some, place)
            rate = found if isinstance(found, Mapping) else {"rate": found}
            value = rate["rate"]
            met = None if value is None or target is None else target[0] <= value <= target[1]
            interval = {key: rate.get(key) for key in ("hits", "count", "low", "high")}
            row[method] = {"value": value, "met": met, **interval}
        rows.append(row)
    return rows


def _figure_at(figures: Mapping[str, Any], place: str) -> Any:
    """The figure at a dotted place; the upper bound of nothing is not measured."""
    found: Any = figures
    parts = place.split(".")
    for part in parts:
        if part == "high" and not found["count"]:
            return None
        found = found[part]
    return found


def _judged(trials: Sequence[Trial], answers: Mapping[str, Any]) -> pd.DataFrame:
    """One row a trial: what it was and what was right in its answer."""
    import pandas as pd

    every = [judge(t, answers.get(t.trial)) for t in trials]
    return pd.DataFrame(
        {
            **vars(j.trial), **vars(j), "trial": j.trial.trial, "truth": (*j.trial.effects(), "no_gap")[0],
            "effects": len(j.trial.effects()), "unknown": j.verdict == "unknown", "right": j.right(),
            "top1": j.top(1), "top3": j.top(3), "class_size": len(j.first_class),
        }
        for j in every
    )  # fmt: skip


def _figures(t: pd.DataFrame, oracle: Mapping[str, float]) -> dict[str, Any]:
    """Figures of one method. Effects on other drives and in `HARDER` settings stand by themselves; all others
    are of trials on the references' drives."""
    plain, nulls = t[t.setting == PLAIN], t[t.family == "null"]
    singles = plain[plain.family.isin(SINGLE)]
    seen, outside = singles[singles.detected], plain[(plain.family == "outside") & plain.detected]
    by_family = {family: seen[seen.family == family] for family in SINGLE}
    sized = seen.deviation.dropna()

    def power(some: pd.DataFrame) -> dict[str, Any]:
        return {f"{d:g}": _rate(some.detected[some.d_prime == d]) for d in D_PRIMES}

    return {
        "crashes": sorted(t.trial[t.crashed]),
        "false_alarms": {
            **{s: _rate(nulls.detected[nulls.setting == s]) for s in (PLAIN, *OTHER_DRIVES, *HARDER)},
            "other drives": _rate(nulls.detected[nulls.setting.isin(OTHER_DRIVES)]),
        },
        "power": {family: power(plain[plain.family == family]) for family in (*SINGLE, "outside")},
        "power_all": power(singles),
        "settings": {s: _effects_of(t[t.setting == s]) for s in (*OTHER_DRIVES, *HARDER)},
        "other_drives": _effects_of(t[t.setting.isin(OTHER_DRIVES)]),
        **{
            name: {family: _rate(some[name]) for family, some in by_family.items()}
            for name in ("right", "top1", "top3")
        },
        "class_size": {f: _mean(some.class_size[some["first"].notna()]) for f, some in by_family.items()},
        "confidence": {
            family: vars(reliability(some.confidence.tolist(), some.top1.tolist()))
            for family, some in by_family.items()
        },
        "unknown": {"recall": _rate(outside.unknown), "false": _rate(seen.unknown)},
        "pairs": _pairs(t),
        "extras_single": _mean(seen.extras),
        "sizes": _rate(sized.abs() <= 2.0),
        "shrink": _shrink(seen, oracle),
        "confusion": _confusion(t[t.family != "pair"]),
        "verdicts": {f: dict(Counter(t.verdict[t.family == f]).most_common()) for f in FAMILIES},
        "seconds": float(t.seconds.median()),
    }


def _rate(outcomes: pd.Series) -> dict[str, Any]:
    return Rate(int(outcomes.sum()), len(outcomes)).to_json()


def _mean(values: pd.Series) -> float | None:
    return float(values.mean()) if len(values) else None


def _effects_of(t: pd.DataFrame) -> dict[str, Any]:
    """Power and naming of single effects."""
    some = t[t.family.isin(SINGLE)]
    return {"power": _rate(some.detected), "right": _rate(some.right[some.detected])}


def _pairs(t: pd.DataFrame) -> dict[str, Any]:
    """`both` counts pairs of which each effect is seen alone, on the same robot, ground and drives."""
    pairs, alone = t[t.family == "pair"], t.detected.groupby(t.part_of).sum()
    fair = pairs[pairs.trial.map(alone).fillna(0) == pairs.effects]
    return {
        "both": _rate(fair.found == 2), "both_of_all": _rate(pairs.found == 2), "extras": _mean(fair.extras),
    }  # fmt: skip


def _shrink(seen: pd.DataFrame, oracle: Mapping[str, float]) -> dict[str, Any]:
    """Mean share of the gap that disappears, and the oracle's on the same trials."""
    both = seen.assign(best=seen.trial.map(oracle)).dropna(subset=["shrink", "best"])
    mean, best = _mean(both.shrink.astype(float)), _mean(both.best)
    ratio = mean / best if mean is not None and best else None
    return {"mean": mean, "oracle": best, "count": len(both), "over_oracle": ratio}


def _confusion(t: pd.DataFrame) -> dict[str, dict[str, int]]:
    """True effect against the effect ranked first, or no_gap, unknown, crash."""
    first = t["first"].fillna("unknown").mask(t.unknown, "unknown").mask(~t.detected, "no_gap")
    first = first.mask(t.crashed, "crash")
    order = [*dict.fromkeys(shape.effect for shape in shapes().values()), "no_gap"]
    counts = {truth: Counter(first[t.truth == truth]) for truth in order}
    return {truth: dict(some.most_common()) for truth, some in counts.items() if some}
