"""The headline of a blind check: each figure of all methods, with its interval and its target."""

from collections.abc import Mapping
from typing import Any

Target = tuple[float, float]
"""Closed range that meets the target."""

TARGETS: tuple[tuple[str, str, Target | None], ...] = (
    ("false alarms, same drives", "false_alarms.same drives", (0.0, 0.05)),
    ("upper bound of that, same drives", "false_alarms.same drives.high", (0.0, 0.10)),
    ("false alarms, other drives", "false_alarms.other drives", (0.0, 0.05)),
    ("upper bound of that, other drives", "false_alarms.other drives.high", (0.0, 0.10)),
    ("power at d' 5", "power_all.5", None),
    ("power at d' 10", "power_all.10", (0.5, 1.0)),
    ("power at d' 25", "power_all.25", (0.9, 1.0)),
    ("power on other drives, d' 10 and 25", "other_drives.power", None),
    ("right and not unknown, same form", "right.same", (0.90, 1.0)),
    ("right and not unknown, form-shifted", "right.shifted", (0.85, 1.0)),
    ("right and not unknown, other drives", "other_drives.right", None),
    ("mean credible set, same form", "class_size.same", (1.0, 2.0)),
    ("mean credible set, form-shifted", "class_size.shifted", (1.0, 2.0)),
    ("class top-1, same form", "top1.same", (0.95, 1.0)),
    ("class top-1, form-shifted", "top1.shifted", (0.90, 1.0)),
    ("class top-3, same form", "top3.same", (0.98, 1.0)),
    ("class top-3, form-shifted", "top3.shifted", (0.95, 1.0)),
    ("ECE, same form", "confidence.same.ece", (0.0, 0.05)),
    ("ECE, form-shifted", "confidence.shifted.ece", (0.0, 0.10)),
    ("unknown recall", "unknown.recall", (0.85, 1.0)),
    ("false unknown", "unknown.false", (0.0, 0.10)),
    ("both of a pair, each seen alone", "pairs.both", (0.85, 1.0)),
    ("false extras a pair", "pairs.extras", (0.0, 0.2)),
    ("size within 2 sigma", "sizes", (0.90, 0.98)),
    ("shrink over the oracle's", "shrink.over_oracle", (0.9, 1.1)),
    ("CPU seconds a data set, median", "seconds", (0.0, 8.0)),
)
"""Name, place among the figures, and its target; None: reported without one."""


def headline(figures: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """One row a figure: `name`, `target` [low, high] or null, and by method `value` (null: not measured),
    `hits`, `count`, `low` and `high` (null where it is no rate), `met`."""
    rows = []
    for name, place, target in TARGETS:
        row: dict[str, Any] = {"name": name, "target": None if target is None else list(target)}
        for method, some in figures.items():
            found = _at(some, place)
            rate = found if isinstance(found, Mapping) else {"rate": found}
            value = rate["rate"]
            met = None if value is None or target is None else target[0] <= value <= target[1]
            row[method] = {"value": value, "met": met, **{k: rate.get(k) for k in _INTERVAL}}
        rows.append(row)
    return rows


_INTERVAL = ("hits", "count", "low", "high")


def _at(figures: Mapping[str, Any], place: str) -> Any:
    """The figure at a dotted place; the upper bound of nothing is not measured."""
    found: Any = figures
    parts = place.split(".")
    for part in parts:
        if part == "high" and not found["count"]:
            return None
        found = found[part]
    return found
