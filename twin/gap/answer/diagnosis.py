"""`GapDiagnosis`: what a diagnosis found, and the same as `diagnosis.json` has it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from terrafusion.twin.gap.answer.next_run import NextRun
from terrafusion.twin.gap.answer.shrink import METRIC, Shrink
from terrafusion.twin.gap.answer.verdict import Cause, Verdict
from terrafusion.twin.gap.answer.where import Cell
from terrafusion.twin.gap.infer.cause_posterior import Choice
from terrafusion.twin.gap.infer.detect import Detection
from terrafusion.twin.gap.infer.evidence import Bench
from terrafusion.twin.gap.infer.refit import Refit

SCHEMA = "terrafusion.gap/1"


@dataclass(frozen=True, eq=False)
class GapDiagnosis:
    """What `diagnose` finds.

    Attributes:
        runs, references, vehicle: names.
        seconds: length of what was judged.
        detection: the permutation test.
        significance: threshold of its p-value.
        uncalibrated: whether twin replicates stood in for references.
        where: cells of the gap map, most important first.
        choice: what each cause leaves of the gap, and its odds.
        verdict: causes and the judgement.
        shrinking: how far the gap shrinks on runs left out.
        next_run: drive that would separate look-alikes.
        refits: by effect, failures included.
        bench: the evidence, for plots.
        notes: what was assumed, in sentences.
        elapsed_s: time the diagnosis took.
    """

    runs: tuple[str, ...]
    references: tuple[str, ...]
    vehicle: str
    seconds: float
    detection: Detection
    significance: float
    uncalibrated: bool
    where: list[Cell]
    choice: Choice
    verdict: Verdict
    shrinking: Shrink | None
    next_run: NextRun | None
    refits: dict[str, Refit]
    bench: Bench
    notes: tuple[str, ...]
    elapsed_s: float

    @property
    def detected(self) -> bool:
        """Whether there is a gap at this significance."""
        return self.detection.p_value <= self.significance

    def to_json(self) -> dict[str, Any]:
        """The answer as `docs/schemas/diagnosis.schema.json` has it; what is not known is null."""
        return as_dict(self)


def as_dict(d: GapDiagnosis) -> dict[str, Any]:
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


def _cause(d: GapDiagnosis, cause: Cause) -> dict[str, Any]:
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
