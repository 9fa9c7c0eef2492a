"""A diagnosis in sentences."""

from __future__ import annotations

import math

from terrafusion.fusion.reports.explain_effect import effect_words
from terrafusion.twin.gap.answer.diagnosis import GapDiagnosis
from terrafusion.twin.gap.answer.next_run import BY_HAND
from terrafusion.twin.gap.answer.verdict import Cause
from terrafusion.twin.gap.answer.where import LEAST_REFERENCES

MOST_LISTED = 4
MOSTLY_COVERED = 0.8
"""Share of the judged time that references must cover for the drives not to be mentioned."""


def sentences(d: GapDiagnosis) -> list[str]:
    """The answer in sentences."""
    lines = [_detection(d)]
    if d.detected:
        lines += [_cause(d), *_checks(d), _place(d), _shrink(d), _drives(d)]
    if d.next_run is not None:
        what = d.next_run.scenario
        lines.append(f"Next, {what if what == BY_HAND else f'drive {what!r}'}: {d.next_run.why}.")
    if d.uncalibrated:
        lines.append(
            "The threshold is uncalibrated: there are too few reference runs, so replicates of the twin "
            "take their place."
        )
    return [line for line in lines if line]


def _detection(d: GapDiagnosis) -> str:
    p, runs = d.detection.p_value, f"{len(d.runs)} run(s), {d.seconds:.0f} s"
    against = f"{len(d.references)} reference run(s)" if d.references else "the twin's own replicates"
    if not d.detected:
        return (
            f"No gap was detected: {runs} differ from {against} no more than these among themselves "
            f"(p = {p:.3g}, threshold {d.significance:g}). A small gap may remain undetected."
        )
    return f"There is a gap: {runs} differ from {against} (p = {p:.3g}, threshold {d.significance:g})."


def _cause(d: GapDiagnosis) -> str:
    verdict, first = d.verdict, d.verdict.causes[0]
    share = "" if first.share is None else f", which explains {100.0 * first.share:.0f} % of it"
    if verdict.kind == "unknown":
        return (
            f"No candidate explains it: the best, {first.effect}, leaves too large a residual. "
            "The cause is probably not in the catalogue of effects."
        )
    if verdict.kind == "parameters":
        return f"The soil parameters differ; no structural effect is missing ({numbers(d)})."
    if len(verdict.named) > 1:
        several = [cause for name in verdict.named for cause in verdict.causes if cause.effect == name]
        listed = "; and ".join(f"{_class_of(cause)} ({numbers(d, cause)})" for cause in several)
        total = 100.0 * sum(cause.probability for cause in several)
        return f"The most probable causes act together (probability {total:.0f} %): {listed}."
    if verdict.kind == "ambiguous":
        listed = ", ".join(first.members)
        return f"Its cause is one of {listed}, which these runs cannot distinguish{share} ({numbers(d)})."
    return (
        f"The most probable cause is {first.effect} "
        f"(probability {100.0 * first.probability:.0f} %){share} ({numbers(d)})."
    )


def _checks(d: GapDiagnosis) -> list[str]:
    """What each named effect is, and how to check it on the robot."""
    words = effect_words()
    return [f"{name}: {' To check: '.join(words[name])}" for name in d.verdict.named if name in words]


def _drives(d: GapDiagnosis) -> str:
    if d.drives is None or d.drives.covered >= MOSTLY_COVERED:
        return ""
    return (
        f"Your drives differ from your references: these cover {100.0 * d.drives.covered:.0f} % of the time "
        f"and lack {'; '.join(d.drives.missing)}. Make references of such drives: until then the gap may "
        "come from the drives and not from the robot."
    )


def _class_of(cause: Cause) -> str:
    if len(cause.members) == 1:
        return cause.effect
    return f"one of {', '.join(cause.members)}, which these runs cannot distinguish"


def numbers(d: GapDiagnosis, cause: Cause | None = None) -> str:
    """A cause's parameters with one sigma; None: the first one's."""
    cause, c = cause or d.verdict.causes[0], d.evidence.candidates
    parts = []
    for i, value, sigma in zip(cause.columns, cause.value, cause.sigma, strict=True):
        unit = f" {c.units[i]}" if c.units[i] else ""
        within = (
            f"+- {sigma * c.scale[i]:.2g}{unit}" if math.isfinite(sigma) else f"{unit} (fit failed)".strip()
        )
        parts.append(f"{c.keys[i]} = {value * c.scale[i]:.3g} {within}")
    return ", ".join(parts)


def _place(d: GapDiagnosis) -> str:
    if len(d.references) < LEAST_REFERENCES:
        return f"The channel and regime are unknown: that takes {LEAST_REFERENCES} references."
    significant = [c for c in d.where if c.p_value <= d.significance][:MOST_LISTED]
    if not significant:
        return "It is significant in no single channel and regime."
    listed = "; ".join(
        f"{c.channel} while {c.regime}, {c.band} ({100.0 * c.share:.0f} %)" for c in significant
    )
    return f"It is significant in: {listed}. A channel in which a gap is significant is not its cause."


def _shrink(d: GapDiagnosis) -> str:
    s = d.shrinkage
    if s is None or not d.verdict.named:
        return ""
    if s.share is None:
        return (
            f"The squared error goes from {s.before:.3g} to {s.after:.3g} noise variances; the gap is too "
            "little above its floor to state a share."
        )
    interval = (
        "" if s.interval is None else f" (95 %: {100 * s.interval[0]:.0f} to {100 * s.interval[1]:.0f} %)"
    )
    data = "on runs held out of the fit" if len(d.runs) > 1 else "on the run it was fitted to"
    return (
        f"With the effect in the twin, {100.0 * s.share:.0f} % of the gap above its floor disappears "
        f"{data}{interval}: {s.before:.3g} before, {s.after:.3g} after, {s.floor or 0.0:.3g} in the "
        f"references; refitting soil and sensor offsets alone leaves {s.recalibrated:.3g}."
    )
