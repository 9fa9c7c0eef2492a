"""`GapDiagnosis`: the result of a diagnosis, and its form in `diagnosis.json`."""

from dataclasses import dataclass, field
from typing import Any

from terrafusion.datasets.core.json_text import finite
from terrafusion.twin.gap.answer.next_run import NextRun
from terrafusion.twin.gap.answer.shrinkage import METRIC, Shrinkage
from terrafusion.twin.gap.answer.verdict import Cause, GapVerdict
from terrafusion.twin.gap.answer.where import GapCell
from terrafusion.twin.gap.infer.detection import Detection
from terrafusion.twin.gap.null.drives import DriveCoverage
from terrafusion.twin.gap.null.evidence import GapEvidence

SCHEMA = "terrafusion.gap/1"


@dataclass(frozen=True, eq=False)
class GapDiagnosis:
    """Result of `diagnose`.

    Attributes:
        vehicle: its name.
        detection: the test for a gap.
        significance: threshold of its p-value.
        uncalibrated: whether twin replicates stood in for references.
        where: cells of the gap map, most important first.
        verdict: causes and the judgement.
        shrinkage: how far the gap shrinks on runs left out.
        next_run: drive that would separate look-alikes.
        drives: how far references cover the judged drives; None without references.
        evidence: for plots.
        notes: assumptions, in sentences.
    """

    vehicle: str
    detection: Detection
    significance: float
    uncalibrated: bool
    where: list[GapCell]
    verdict: GapVerdict
    shrinkage: Shrinkage
    next_run: NextRun | None
    drives: DriveCoverage | None
    evidence: GapEvidence = field(repr=False)
    notes: tuple[str, ...]

    @property
    def runs(self) -> tuple[str, ...]:
        """Names of the judged runs."""
        return tuple(r.name for r in self.evidence.runs)

    @property
    def references(self) -> tuple[str, ...]:
        """Names of the references."""
        return self.evidence.reference_names

    @property
    def seconds(self) -> float:
        """Length of the judged runs."""
        return sum(r.log.seconds() for r in self.evidence.runs)

    @property
    def detected(self) -> bool:
        """Whether there is a gap at this significance, and not in the drives alone."""
        return self.detection.p_value <= self.significance and self.verdict.kind != "no_gap"

    def to_json(self) -> dict[str, Any]:
        """The answer as `docs/schemas/diagnosis.schema.json` has it; unknown values are null."""
        verdict = self.verdict
        return {
            "schema": SCHEMA,
            "runs": list(self.runs),
            "reference_runs": list(self.references),
            "vehicle": self.vehicle,
            "seconds": round(self.seconds, 3),
            "gap": {
                "detected": self.detected,
                "statistic": finite(self.detection.statistic) or 0.0,
                "p_value": float(self.detection.p_value),
                "significance": self.significance,
                "uncalibrated": self.uncalibrated,
            },
            "where": [_picked(c, "channel", "regime", "band", "share", "p_value") for c in self.where],
            "verdict": verdict.kind,
            "causes": [_cause(self.evidence, c) for c in verdict.causes],
            "named": list(verdict.named),
            "sets": [_picked(s, "effects", "probability", "named") for s in verdict.sets],
            "drives": _picked(self.drives, "covered", "missing"),
            "p_unknown": verdict.p_unknown,
            "p_null": verdict.p_null,
            "shrink": _shrink(self.shrinkage),
            "next_run": _picked(self.next_run, "scenario", "separates", "why"),
        }


def _picked(part: object, *names: str) -> Any:
    """Some attributes by name, tuples as lists; None of nothing."""
    if part is None:
        return None
    values = {name: getattr(part, name) for name in names}
    return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}


def _cause(evidence: GapEvidence, cause: Cause) -> dict[str, Any]:
    c, changed = evidence.candidates, evidence.candidates.changed(cause.columns, cause.value)
    parameters = {
        c.keys[i]: {
            "value": changed[c.keys[i]] - float(c.base[i]),
            "sigma": finite(float(sigma * c.scale[i])),
            "unit": c.units[i],
        }
        for i, sigma in zip(cause.columns, cause.sigma, strict=True)
    }
    return {
        "effect": cause.effect,
        "class": list(cause.members),
        "probability": min(max(cause.probability, 0.0), 1.0),
        "parameters": parameters,
        "explained_share": finite(cause.share),
    }


def _shrink(s: Shrinkage) -> dict[str, Any]:
    return {
        "metric": METRIC,
        "before": s.before,
        "after": s.after,
        "floor": finite(s.floor),
        "share": finite(s.share),
        "ci": None if s.interval is None else [float(x) for x in s.interval],
        "recalibration_only": finite(s.recalibrated),
        "per_channel": {
            name: {"before": finite(b), "after": finite(a), "floor": finite(f)}
            for name, (b, a, f) in s.channels.items()
        },
    }
