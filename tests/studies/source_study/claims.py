"""Claims of the study held against the twin: what it says, what decides, and the table of agreement."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from terrafusion.datasets.core.yaml_file import read_yaml
from tests.studies.source_study.spread import Spread

AGREE, PARTLY, DISAGREE = "agree", "partly", "disagree"
VERDICTS = (AGREE, PARTLY, DISAGREE)
PREDICTED, CALIBRATED, GIVEN = "predicted", "calibrated", "given"
BASES = (PREDICTED, CALIBRATED, GIVEN)
NOT_EXAMINED = "not looked into: it agreed when this was written"
POINTS, SHARE, FACTOR = 1.0, 0.1, 2.0
"""A published mean is met within one point or a tenth of it, and partly within a factor of two."""
FILES = ("claims_tables.yaml", "claims_figures.yaml", "claims_rest.yaml")


RULES = {"near": "within", "at_least": "at least", "at_most": "at most", "published": ""}
"""Rules by their names in the files of claims, and how their limits are introduced."""


@dataclass(frozen=True)
class Criterion:
    """A rule for the mean of one measured quantity over the runs.

    "at_least" and "at_most" have two numbers: the limit of agreement, and that of agreement in part. "near"
    has a target before them, from which the mean may be so far. "published" has a target alone, a mean of
    the study's Tab. 4, which is one run of each: it is near the twin's mean, or among its single runs, which
    counts only where chance moves them by more than a point.
    """

    rule: str
    numbers: tuple[float, ...]

    def _holds(self, found: Spread) -> tuple[bool, bool]:
        """Whether the quantity agrees, and whether it does in part."""
        if self.rule == "published":
            (target,) = self.numbers
            near = abs(found.mean - target) <= max(POINTS, SHARE * target)
            scattered = found.runs > 1 and found.high - found.low > POINTS
            among = scattered and found.low <= target <= found.high
            return near or among, 1.0 / FACTOR <= found.mean / target <= FACTOR
        *targets, agree, partly = self.numbers
        value = abs(found.mean - targets[0]) if targets else found.mean
        if self.rule == "at_least":
            return value >= agree, value >= partly
        return value <= agree, value <= partly

    def verdict(self, found: Spread) -> str:
        """One of `VERDICTS`; what could not be measured disagrees."""
        agrees, partly = self._holds(found)
        return AGREE if agrees else PARTLY if partly else DISAGREE

    def words(self, unit: str) -> str:
        """The rule in words."""
        if self.rule == "published":
            return (
                f"±{POINTS:g} point or ±{100 * SHARE:g} %, or among single runs (partly: factor {FACTOR:g})"
            )
        agree, partly = (_number(limit, unit) for limit in self.numbers[-2:])
        return f"{RULES[self.rule]} {agree}" + (f" (partly: {partly})" if partly != agree else "")

    def wanted(self, unit: str) -> str:
        """What the study says, short."""
        return _number(self.numbers[0], unit) if self.rule in ("near", "published") else ""


def _number(value: float, unit: str) -> str:
    return f"{value:g} {unit}".rstrip()


@dataclass(frozen=True)
class Claim:
    """One statement or number of the study.

    Attributes:
        source: table, figure or section of the study.
        statement: what it says, in our words.
        quantity: what is measured of the twin.
        measure: its key among the measured quantities.
        criterion: what decides.
        unit, digits: of its value.
        basis: `PREDICTED`, or why agreement proves little: it follows from what the twin was `CALIBRATED`
            to, or was `GIVEN` to it.
        why: what in the twin makes it agree.
        why_not: what prevents agreement; empty where it was never examined.
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
class ClaimResult:
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


def load_claims() -> tuple[Claim, ...]:
    """All claims, in the order of the study's tables and figures."""
    claims: list[Claim] = []
    for name in FILES:
        claims += [_claim(dict(row)) for row in read_yaml(Path(__file__).parent / name)["claims"]]
    return tuple(claims)


def _claim(row: dict[str, Any]) -> Claim:
    """One claim; its rule stands under the rule's name.

    Raises:
        ValueError: it has no rule, or several.
    """
    rules = [name for name in RULES if name in row]
    if len(rules) != 1:
        raise ValueError(f"the claim '{row.get('statement')}' has {len(rules)} rules")
    numbers = row.pop(rules[0])
    criterion = Criterion(rules[0], tuple(numbers) if isinstance(numbers, list) else (numbers,))
    return Claim(criterion=criterion, **row)


def judge(claims: Sequence[Claim], measured: Mapping[str, Spread]) -> tuple[ClaimResult, ...]:
    """Every claim with its verdict.

    Raises:
        KeyError: a claim names a quantity that was not measured.
    """
    return tuple(_result(claim, measured[claim.measure]) for claim in claims)


def counts(results: Sequence[ClaimResult], basis: str | None = None) -> dict[str, int]:
    """How many results have each verdict; of one basis where it is given."""
    verdicts = [result.verdict for result in results if basis in (None, result.basis)]
    return {verdict: verdicts.count(verdict) for verdict in VERDICTS}


def _result(claim: Claim, found: Spread) -> ClaimResult:
    verdict = claim.criterion.verdict(found)
    twin = f"{found.text(claim.digits)} {claim.unit}".rstrip() if found.runs else found.text()
    return ClaimResult(
        claim.source, claim.statement, claim.quantity, claim.criterion.wanted(claim.unit), twin, verdict,
        claim.criterion.words(claim.unit), claim.basis,
        claim.why if verdict == AGREE else claim.why_not or NOT_EXAMINED,
    )  # fmt: skip
