"""All trials judged, as numbers: what `blind.json` holds."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from terrafusion.twin.gap.blind.plan import FAMILIES, Trial
from terrafusion.twin.gap.blind.rates import rate, reliability
from terrafusion.twin.gap.blind.shapes import shapes
from terrafusion.twin.gap.blind.verdicts import Judged, judge

SCHEMA = "terrafusion.gap-blind/1"
SINGLE = ("same", "shifted")
MATTERS = 1.5  # severity from which an effect should be identified


def score(
    trials: Sequence[Trial],
    answers: Mapping[str, Mapping[str, Any]],
    oracle: Mapping[str, float] | None = None,
) -> dict[str, Any]:
    """Scores of all trials.

    Args:
        trials: with their truth.
        answers: by trial; missing ones count as crashes.
        oracle: share of the gap that goes away when the true effect is given, by trial, known.
    """
    judged = [judge(trial, answers.get(trial.trial)) for trial in trials]
    scores: dict[str, Any] = {
        "schema": SCHEMA,
        "trials": len(judged),
        "families": dict(Counter(j.trial.family for j in judged)),
        "crashes": sorted(j.trial.trial for j in judged if j.crashed),
        "false_alarms": _false_alarms(judged),
        "power": _cells(judged, lambda j: j.detected),
        "top1": _by_family(judged, lambda j: j.top(1)),
        "right": _by_family(judged, Judged.right),
        "top3": _by_family(judged, lambda j: j.top(3)),
        "top1_effect": _by_family(judged, Judged.exact),
        "top1_by_severity": _cells([j for j in judged if j.detected], lambda j: j.top(1)),
        "class_size": _class_size(judged),
        "confusion": _confusion(judged),
        "confidence": _confidence(judged),
        "verdicts": _verdicts(judged),
        "unknown": _unknown(judged),
        "pairs": _pairs(judged),
        "shrink": _shrink(judged, oracle or {}),
        "effects": _effects(judged),
        "seconds": _seconds(judged),
    }
    scores["targets"] = targets(scores)
    return scores


def _of(judged: Sequence[Judged], *families: str, detected: bool = False) -> list[Judged]:
    return [j for j in judged if j.trial.family in families and (j.detected or not detected)]


def _false_alarms(judged: Sequence[Judged]) -> dict[str, Any]:
    nulls = _of(judged, "null")
    drives = sorted({j.trial.drive for j in nulls})
    table = {drive: rate([j.detected for j in nulls if j.trial.drive == drive]).to_json() for drive in drives}
    return table | {"all": rate([j.detected for j in nulls]).to_json()}


def _cells(judged: Sequence[Judged], outcome: Callable[[Judged], bool]) -> list[dict[str, Any]]:
    """One rate for each family, drive and severity, null left out."""
    keys = sorted(
        {(j.trial.family, j.trial.drive, j.trial.severity) for j in judged if j.trial.family != "null"},
        key=lambda key: (FAMILIES.index(key[0]), key[1], key[2]),
    )
    out = []
    for key in keys:
        mine = [outcome(j) for j in judged if (j.trial.family, j.trial.drive, j.trial.severity) == key]
        out.append(dict(zip(("family", "drive", "severity"), key, strict=True)) | rate(mine).to_json())
    return out


def _by_family(judged: Sequence[Judged], outcome: Callable[[Judged], bool]) -> dict[str, Any]:
    """Given detection."""
    return {
        family: rate([outcome(j) for j in _of(judged, family, detected=True)]).to_json() for family in SINGLE
    }


def _class_size(judged: Sequence[Judged]) -> dict[str, float | None]:
    """Mean size of the class ranked first: a class of all effects is always right and worthless."""
    sizes = {f: [len(j.first_class) for j in _of(judged, f, detected=True) if j.first] for f in SINGLE}
    return {family: statistics.fmean(many) if many else None for family, many in sizes.items()}


def _confusion(judged: Sequence[Judged]) -> dict[str, dict[str, int]]:
    """True effect against the effect ranked first, or no_gap, unknown, crash."""
    table: dict[str, Counter[str]] = {}
    for j in _of(judged, *SINGLE, "outside"):
        table.setdefault(j.trial.effects()[0], Counter())[_answer(j)] += 1
    for j in _of(judged, "null"):
        table.setdefault("no_gap", Counter())[_answer(j)] += 1
    order = [*dict.fromkeys(shape.effect for shape in shapes().values()), "no_gap"]
    return {truth: dict(table[truth].most_common()) for truth in order if truth in table}


def _answer(j: Judged) -> str:
    if j.crashed:
        return "crash"
    if not j.detected:
        return "no_gap"
    return "unknown" if j.verdict == "unknown" or j.first is None else j.first


def _confidence(judged: Sequence[Judged]) -> dict[str, Any]:
    """Stated probability of the class ranked first, given detection."""
    groups = {family: _of(judged, family, detected=True) for family in SINGLE}
    groups["all"] = [*groups["same"], *groups["shifted"], *_of(judged, "outside", detected=True)]
    return {
        name: reliability([j.confidence for j in many], [j.top(1) for j in many]).to_json()
        for name, many in groups.items()
    }


def _verdicts(judged: Sequence[Judged]) -> dict[str, dict[str, int]]:
    return {f: dict(Counter(j.verdict for j in _of(judged, f)).most_common()) for f in FAMILIES}


def _unknown(judged: Sequence[Judged]) -> dict[str, Any]:
    def says(many: Sequence[Judged]) -> dict[str, Any]:
        return rate([j.verdict == "unknown" for j in many]).to_json()

    return {
        "recall": says(_of(judged, "outside", detected=True)),
        "recall_of_all": says([j for j in _of(judged, "outside") if j.trial.severity >= MATTERS]),
        "false_same": says(_of(judged, "same", detected=True)),
        "false_shifted": says(_of(judged, "shifted", detected=True)),
        "false": says(_of(judged, *SINGLE, detected=True)),
    }


def _pairs(judged: Sequence[Judged]) -> dict[str, Any]:
    pairs = _of(judged, "pair")
    single = _of(judged, *SINGLE, detected=True)
    return {
        "both": rate([j.found == 2 for j in pairs]).to_json(),
        "at_least_one": rate([j.found >= 1 for j in pairs]).to_json(),
        "false_extras_a_case": statistics.fmean([j.extras for j in pairs]) if pairs else None,
        "false_extras_single": statistics.fmean([j.extras for j in single]) if single else None,
    }


def _shrink(judged: Sequence[Judged], oracle: Mapping[str, float]) -> dict[str, Any]:
    """Mean share of the gap that disappears, and the oracle's on the same trials."""
    out: dict[str, Any] = {}
    for family in SINGLE:
        shares = {j.trial.trial: j.shrink for j in _of(judged, family, detected=True) if j.shrink is not None}
        both = [(share, oracle[trial]) for trial, share in shares.items() if trial in oracle]
        chosen = statistics.fmean(s for s, _ in both) if both else None
        best = statistics.fmean(o for _, o in both) if both else None
        out[family] = {
            "mean": statistics.fmean(shares.values()) if shares else None, "count": len(shares),
            "beside_oracle": chosen, "oracle": best, "count_oracle": len(both),
            "over_oracle": chosen / best if chosen is not None and best else None,
        }  # fmt: skip
    return out


def _effects(judged: Sequence[Judged]) -> list[dict[str, Any]]:
    """Each effect: how often it was detected, and identified, from severity `MATTERS` on."""
    strong = [j for j in _of(judged, *SINGLE, "outside") if j.trial.severity >= MATTERS]
    names = list(dict.fromkeys(j.trial.effects()[0] for j in strong))
    rows = []
    for name in sorted(names):
        own = [j for j in strong if j.trial.effects()[0] == name]
        detected = [j for j in own if j.detected]
        rows.append({
            "effect": name, "power": rate([j.detected for j in own]).to_json(),
            "top1": rate([j.top(1) for j in detected]).to_json(),
            "unknown": rate([j.verdict == "unknown" for j in detected]).to_json(),
        })  # fmt: skip
    return rows


def _seconds(judged: Sequence[Judged]) -> dict[str, float | None]:
    times = sorted(j.seconds for j in judged)
    if not times:
        return {"median": None, "p95": None}
    return {"median": statistics.median(times), "p95": times[min(len(times) - 1, int(0.95 * len(times)))]}


def targets(scores: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The requirement's targets beside what was measured; `met` is None where nothing was measured."""
    alarms, unknown = scores["false_alarms"]["all"], scores["unknown"]
    wanted: list[tuple[str, float | None, str, float]] = [
        ("false alarms", alarms["rate"], "<=", 0.05),
        ("false alarms, upper bound", alarms["high"] if alarms["count"] else None, "<=", 0.10),
        ("right and not called unknown, same form", scores["right"]["same"]["rate"], ">=", 0.90),
        ("right and not called unknown, form-shifted", scores["right"]["shifted"]["rate"], ">=", 0.85),
        ("mean class size, same form", scores["class_size"]["same"], "<=", 2.0),
        ("mean class size, form-shifted", scores["class_size"]["shifted"], "<=", 2.0),
        ("top-1, same form", scores["top1"]["same"]["rate"], ">=", 0.95),
        ("top-1, form-shifted", scores["top1"]["shifted"]["rate"], ">=", 0.90),
        ("top-3, same form", scores["top3"]["same"]["rate"], ">=", 0.98),
        ("top-3, form-shifted", scores["top3"]["shifted"]["rate"], ">=", 0.95),
        ("ECE, same form", scores["confidence"]["same"]["ece"], "<=", 0.05),
        ("ECE, form-shifted", scores["confidence"]["shifted"]["ece"], "<=", 0.10),
        ("unknown recall", unknown["recall"]["rate"], ">=", 0.90),
        ("false unknown", unknown["false"]["rate"], "<=", 0.10),
        ("both of a pair", scores["pairs"]["both"]["rate"], ">=", 0.80),
        ("false extras a case", scores["pairs"]["false_extras_a_case"], "<=", 0.20),
        ("shrink over the oracle's, same form", scores["shrink"]["same"]["over_oracle"], ">=", 0.95),
        ("shrink over the oracle's, form-shifted", scores["shrink"]["shifted"]["over_oracle"], ">=", 0.95),
        ("seconds a data set (median)", scores["seconds"]["median"], "<=", 8.0),
    ]
    return [
        {"name": name, "value": value, "sign": sign, "target": limit, "met": _met(value, sign, limit)}
        for name, value, sign, limit in wanted
    ]


def _met(value: float | None, sign: str, limit: float) -> bool | None:
    if value is None:
        return None
    return value <= limit if sign == "<=" else value >= limit
