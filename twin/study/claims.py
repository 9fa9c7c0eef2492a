"""The claims of the study, from the files `claims_*.yaml`."""

from __future__ import annotations

from importlib import resources
from typing import Any

from terrafusion.datasets.core.config import read_yaml
from terrafusion.twin.study.agreement import Claim
from terrafusion.twin.study.criteria import AtLeast, AtMost, Criterion, Near, Published

FILES = ("claims_tables.yaml", "claims_figures.yaml", "claims_rest.yaml")
_RULES: dict[str, type] = {"near": Near, "at_least": AtLeast, "at_most": AtMost, "published": Published}


def load_claims() -> tuple[Claim, ...]:
    """All claims, in the order of the study's tables and figures."""
    claims: list[Claim] = []
    for name in FILES:
        with resources.as_file(resources.files("terrafusion.twin.study") / name) as path:
            claims += [_claim(dict(row)) for row in read_yaml(path)["claims"]]
    return tuple(claims)


def _claim(row: dict[str, Any]) -> Claim:
    """One claim; its rule stands under the rule's name.

    Raises:
        ValueError: it has no rule, or several.
    """
    rules = [name for name in _RULES if name in row]
    if len(rules) != 1:
        raise ValueError(f"the claim '{row.get('statement')}' has {len(rules)} rules")
    numbers = row.pop(rules[0])
    criterion: Criterion = _RULES[rules[0]](*(numbers if isinstance(numbers, list) else [numbers]))
    return Claim(criterion=criterion, **row)
