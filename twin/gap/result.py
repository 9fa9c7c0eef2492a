"""The answer as the contract has it: `diagnosis.json`."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from terrafusion.twin.gap.answer.shrink import Shrink
    from terrafusion.twin.gap.answer.verdict import Cause
    from terrafusion.twin.gap.diagnose import Diagnosis

SCHEMA = "terrafusion.gap/1"


def as_dict(d: Diagnosis) -> dict[str, Any]:
    """The diagnosis in plain types; what is not known is null."""
    found, verdict = d.detection, d.verdict
    return {
        "schema": SCHEMA,
        "runs": list(d.runs),
        "reference_runs": list(d.references),
        "vehicle": d.vehicle,
        "seconds": round(d.seconds, 3),
        "gap": {
            "detected": d.detected,
            "statistic": _number(found.statistic) or 0.0,
            "p_value": float(found.p_value),
            "significance": d.significance,
            "uncalibrated": d.uncalibrated,
        },
        "where": [
            {"channel": c.channel, "regime": c.regime, "band": c.band, "share": c.share, "p_value": c.p_value}
            for c in d.where
        ],
        "verdict": verdict.kind,
        "causes": [_cause(d, c) for c in verdict.causes],
        "named": list(verdict.named),
        "p_unknown": verdict.p_unknown,
        "p_null": verdict.p_null,
        "shrink": None if d.shrinking is None else _shrink(d.shrinking),
        "next_run": None
        if d.next_run is None
        else {
            "scenario": d.next_run.scenario,
            "separates": list(d.next_run.separates),
            "why": d.next_run.why,
        },
    }


def _number(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


def _cause(d: Diagnosis, cause: Cause) -> dict[str, Any]:
    c, base = d.bench.candidates, d.bench.model.effects
    parameters = {}
    for i, value, sigma in zip(cause.columns, cause.value, cause.sigma, strict=True):
        shift = float(value * c.scale[i])
        low, high = float(c.low[i]), float(c.high[i])
        at = base.get(c.keys[i], 0.0)
        parameters[c.keys[i]] = {
            "value": min(max(at + shift, low), high) - at,
            "sigma": _number(float(sigma * c.scale[i])),
            "unit": c.units[i],
        }
    return {
        "effect": cause.effect,
        "class": list(cause.members),
        "probability": min(max(cause.probability, 0.0), 1.0),
        "parameters": parameters,
        "explained_share": _number(cause.share),
    }


def _shrink(s: Shrink) -> dict[str, Any]:
    from terrafusion.twin.gap.answer.shrink import METRIC

    return {
        "metric": METRIC,
        "before": s.before,
        "after": s.after,
        "floor": _number(s.floor),
        "share": _number(s.share),
        "ci": None if s.interval is None else [float(x) for x in s.interval],
        "recalibration_only": _number(s.recalibrated),
        "per_channel": {
            name: {"before": _number(b), "after": _number(a), "floor": _number(f)}
            for name, (b, a, f) in s.channels.items()
        },
    }
