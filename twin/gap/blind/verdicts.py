"""One answer beside its truth: what was right in it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from terrafusion.twin.effects.catalogue import catalogue
from terrafusion.twin.gap.blind.plan import Trial
from terrafusion.twin.gap.blind.shapes import SAME

PARAMETER = "soil_strength"  # the effect whose verdict is *parameters*


@dataclass(frozen=True)
class Judged:
    """One trial, judged.

    Attributes:
        trial: the trial and its truth.
        crashed: no answer, or one that lacks what the contract asks for.
        detected: the answer says that there is a gap.
        verdict: as answered; "crash" where there is none.
        rank: place (1 is first) of the first cause whose class holds the (first) truth; 0 for none.
        first: effect ranked first, or None; `first_class` is its class.
        confidence: stated probability of that class.
        found: truths that a named cause, or its class, holds.
        extras: named causes whose class holds no truth.
        deviation: by how many sigmas the stated size differs from the true one, or None (see `_deviation`).
        shrink: stated share of the gap that goes away, or None.
        seconds: the answer took.
    """

    trial: Trial
    crashed: bool
    detected: bool
    verdict: str = "crash"
    rank: int = 0
    first: str | None = None
    first_class: tuple[str, ...] = ()
    confidence: float = 1.0
    found: int = 0
    extras: int = 0
    deviation: float | None = None
    shrink: float | None = None
    seconds: float = 0.0

    def top(self, places: int) -> bool:
        """Whether the truth is held by the classes of the first `places` causes."""
        return 1 <= self.rank <= places

    def right(self) -> bool:
        """Whether the class ranked first holds the truth and the verdict is not *unknown*."""
        return self.top(1) and self.verdict != "unknown"


def judge(trial: Trial, entry: Mapping[str, Any] | None) -> Judged:
    """A trial and its answer; None, an error or a malformed answer is a crash, and wrong."""
    seconds = float(entry["seconds"]) if entry else 0.0
    try:
        if not entry or entry["answer"] is None:
            raise KeyError("answer")
        return _judge(trial, entry["answer"], seconds)
    except (KeyError, TypeError, ValueError, AttributeError):
        return Judged(trial, True, trial.family == "null", seconds=seconds)


def _judge(trial: Trial, answer: Mapping[str, Any], seconds: float) -> Judged:
    causes = sorted(answer["causes"], key=lambda cause: -float(cause["probability"]))
    classes = [{str(c["effect"]), *(str(member) for member in c["class"])} for c in causes]
    truth, verdict = trial.effects(), str(answer["verdict"])
    by_effect = dict(zip((c["effect"] for c in causes), classes, strict=True))
    groups = named_groups(answer["named"], by_effect)
    if verdict == "parameters" and not groups:
        groups = [{PARAMETER}]
    share = (answer["shrink"] or {}).get("share")
    return Judged(
        trial, False, bool(answer["gap"]["detected"]), verdict,
        rank=next((i + 1 for i, known in enumerate(classes) if truth and truth[0] in known), 0),
        first=str(causes[0]["effect"]) if causes else None,
        first_class=tuple(sorted(classes[0])) if classes else (),
        confidence=_stated(answer, causes, classes), found=sum(any(e in g for g in groups) for e in truth),
        extras=sum(not g.intersection(truth) for g in groups), deviation=_deviation(trial, causes),
        shrink=None if share is None else float(share), seconds=seconds,
    )  # fmt: skip


def _stated(
    answer: Mapping[str, Any], causes: Sequence[Mapping[str, Any]], classes: Sequence[set[str]]
) -> float:
    """Stated probability that the class ranked first holds a true effect: that of its credible set, or, of a
    method that states none, of its members together."""
    own = [float(s["probability"]) for s in answer.get("sets", ()) if {*s["effects"]} == classes[0]]
    members = sum(float(c["probability"]) for c in causes if c["effect"] in classes[0])
    return min(max(own[0] if own else members, 0.0), 1.0)


def _deviation(trial: Trial, causes: Sequence[Mapping[str, Any]]) -> float | None:
    """(size stated - true size) / sigma of a single effect by the catalogue's first law, where the answer
    ranks it first by that law and it has one parameter; without sign, since a change turns either way."""
    if trial.family != SAME or not causes or causes[0]["effect"] != trial.effects()[0]:
        return None
    law = next(form.key for form in catalogue().values() if form.effect == causes[0]["effect"])
    stated = causes[0]["parameters"]
    if list(stated) != [law] or not stated[law]["sigma"]:
        return None
    return (abs(float(stated[law]["value"])) - trial.values[0]) / float(stated[law]["sigma"])


def named_groups(named: Sequence[str], classes: Mapping[str, set[str]]) -> list[set[str]]:
    """Named effects as claims: look-alikes of one class that are all named make one claim."""
    groups: list[set[str]] = []
    for effect in named:
        if not any(effect in group for group in groups):
            groups.append({effect, *classes.get(effect, set())})
    return groups
