"""One answer beside its truth: what was right in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from terrafusion.twin.gap.blind.plan import Trial

PARAMETER = "soil_strength"  # the effect whose verdict is *parameters*


@dataclass(frozen=True)
class Judged:
    """One trial, judged.

    Attributes:
        trial: the trial and its truth.
        crashed: no answer, or one that lacks what the contract asks for.
        detected: the answer says that there is a gap.
        verdict: as answered; "crash" where there is none.
        ranks: place (1 is first) of the first ranked cause whose class holds the truth, a truth each; 0 for
        none.
        first: effect ranked first, or None; `first_class` is its class.
        confidence: stated probability of that class.
        found: truths that a named cause, or its class, holds.
        extras: named causes whose class holds no truth.
        shrink: stated share of the gap that goes away, or None.
        seconds: the answer took.
    """

    trial: Trial
    crashed: bool
    detected: bool
    verdict: str
    ranks: tuple[int, ...]
    first: str | None
    first_class: tuple[str, ...]
    confidence: float
    found: int
    extras: int
    shrink: float | None
    seconds: float

    def top(self, places: int) -> bool:
        """Whether the first truth is held by the classes of the first `places` causes."""
        return bool(self.ranks) and 1 <= self.ranks[0] <= places

    def right(self) -> bool:
        """Whether the class ranked first holds the truth and the verdict is not *unknown*."""
        return self.top(1) and self.verdict != "unknown"

    def exact(self) -> bool:
        """Whether the cause ranked first is the truth itself and not a look-alike."""
        return self.first is not None and self.first in self.trial.effects()


def judge(trial: Trial, entry: Mapping[str, Any] | None) -> Judged:
    """A trial and its line of the answers; None, an error or a malformed answer is a crash, and wrong."""
    seconds = float(entry["seconds"]) if entry else 0.0
    try:
        if not entry or entry["answer"] is None:
            raise KeyError("answer")
        return _judge(trial, entry["answer"], seconds)
    except (KeyError, TypeError, ValueError, AttributeError):
        nothing = tuple(0 for _ in trial.effects())
        return Judged(
            trial, True, trial.family == "null", "crash", nothing, None, (), 1.0, 0, 0, None, seconds
        )


def _judge(trial: Trial, answer: Mapping[str, Any], seconds: float) -> Judged:
    causes = sorted(answer["causes"], key=lambda cause: -float(cause["probability"]))
    classes = [_class(cause) for cause in causes]
    truth, verdict, detected = trial.effects(), str(answer["verdict"]), bool(answer["gap"]["detected"])
    ranks = tuple(next((i + 1 for i, known in enumerate(classes) if e in known), 0) for e in truth)
    groups = named_groups(answer["named"], dict(zip((c["effect"] for c in causes), classes, strict=True)))
    if verdict == "parameters" and not groups:
        groups = [{PARAMETER}]
    share = (answer["shrink"] or {}).get("share")
    return Judged(
        trial=trial, crashed=False, detected=detected, verdict=verdict, ranks=ranks,
        first=str(causes[0]["effect"]) if causes else None,
        first_class=tuple(sorted(classes[0])) if classes else (),
        confidence=_confidence(causes, classes), found=sum(any(e in g for g in groups) for e in truth),
        extras=sum(not g.intersection(truth) for g in groups),
        shrink=None if share is None else float(share), seconds=seconds,
    )  # fmt: skip


def _class(cause: Mapping[str, Any]) -> set[str]:
    return {str(cause["effect"]), *(str(member) for member in cause["class"])}


def _confidence(causes: Sequence[Mapping[str, Any]], classes: Sequence[set[str]]) -> float:
    """Probability of the first cause's class: the sum over its members."""
    if not causes:
        return 0.0
    total = sum(float(cause["probability"]) for cause in causes if cause["effect"] in classes[0])
    return min(max(total, 0.0), 1.0)


def named_groups(named: Sequence[str], classes: Mapping[str, set[str]]) -> list[set[str]]:
    """Named effects as claims: look-alikes of one class that are all named make one claim."""
    groups: list[set[str]] = []
    for effect in named:
        if not any(effect in group for group in groups):
            groups.append({effect, *classes.get(effect, set())})
    return groups
