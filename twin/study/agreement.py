"""The table of agreement: what the study says, what the twin does, and whether they agree."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from terrafusion.twin.study.criteria import AGREE, VERDICTS, Criterion
from terrafusion.twin.study.spread import Spread

PREDICTED, CALIBRATED, GIVEN = "predicted", "calibrated", "given"
NOT_EXAMINED = "not looked into: it agreed when this was written"
BASES = (PREDICTED, CALIBRATED, GIVEN)


@dataclass(frozen=True)
class Claim:
    """One statement or number of the study and how it is held against the twin.

    Attributes:
        source: table, figure or section of the study.
        statement: what it says, in our words.
        quantity: what is measured of the twin.
        measure: its key in the evidence.
        criterion: what decides.
        unit, digits: how its value is told.
        basis: `PREDICTED`, or why agreement proves little: it follows from what the twin was `CALIBRATED`
            to, or was `GIVEN` to it.
        why: what in the twin makes it agree.
        why_not: what stands in the way where it does not; empty where it never was looked into.
    """

    source: str
    statement: str
    quantity: str
    measure: str
    criterion: Criterion
    unit: str = ""
    digits: int = 1
    basis: str = PREDICTED
    why: str = ""
    why_not: str = ""


@dataclass(frozen=True)
class Row:
    """A claim with its verdict: one line of `agreement.csv`."""

    source: str
    statement: str
    quantity: str
    study: str
    twin: str
    verdict: str
    criterion: str
    basis: str
    why: str


def judge(claims: Sequence[Claim], measured: Mapping[str, Spread]) -> tuple[Row, ...]:
    """Hold every claim against the evidence.

    Raises:
        KeyError: a claim names a quantity that was not measured.
    """
    return tuple(_row(claim, measured[claim.measure]) for claim in claims)


def counts(rows: Sequence[Row], basis: str | None = None) -> dict[str, int]:
    """How many rows have each verdict; of one basis where it is given."""
    asked = [row.verdict for row in rows if basis in (None, row.basis)]
    return {verdict: asked.count(verdict) for verdict in VERDICTS}


def _row(claim: Claim, found: Spread) -> Row:
    verdict = claim.criterion.verdict(found)
    return Row(
        source=claim.source,
        statement=claim.statement,
        quantity=claim.quantity,
        study=claim.criterion.wanted(claim.unit),
        twin=f"{found.text(claim.digits)} {claim.unit}".rstrip() if found.runs else found.text(),
        verdict=verdict,
        criterion=claim.criterion.words(claim.unit),
        basis=claim.basis,
        why=claim.why if verdict == AGREE else claim.why_not or NOT_EXAMINED,
    )
