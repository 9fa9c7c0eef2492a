"""What a report says in words and in its table, from `metrics.json` alone.

No sentence says more than a number in the table: what was not scored is not
mentioned, and where a run lost, that is said in the same words as where it won.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from terrafusion.datasets.core.tables import number

Metrics = Mapping[str, Any]

REFERENCE = {"truth": "the ground truth", "gnss_held_out": "GNSS fixes kept from the estimator"}


@dataclass(frozen=True)
class Row:
    """One line of the table: a number for each run, None where it was not scored.

    `goal` is "low" (less is better), "one" (nearer to 1 is better) or "" (neither is better).
    """

    label: str
    values: tuple[float | None, ...]
    digits: int = 3
    goal: str = ""
    about: str = ""

    def best(self) -> int | None:
        """Which run is best, or None when there is no contest or a draw at the digits shown."""
        costs = [self._cost(value) for value in self.values]
        scored = [cost for cost in costs if cost is not None]
        if not self.goal or len(scored) < 2:
            return None
        first = min(scored)
        winners = [
            i for i, cost in enumerate(costs) if cost is not None and self._same(i, costs.index(first))
        ]
        return winners[0] if len(winners) == 1 else None

    def verdict(self, ours: int, theirs: int) -> tuple[str, str]:
        """How run `ours` compares with run `theirs`: a sentence part, and "better", "worse" or ""."""
        a, b = self.values[ours], self.values[theirs]
        cost_a, cost_b = self._cost(a), self._cost(b)
        if not self.goal or cost_a is None or cost_b is None or a is None or b is None:
            return "", ""
        if self._same(ours, theirs):
            return "equal", ""
        better = "better" if cost_a < cost_b else "worse"
        if self.goal == "one":
            return ("nearer to 1" if better == "better" else "farther from 1"), better
        if b <= 0.0:
            return ("lower" if a < b else "higher"), better
        change = 100.0 * (a - b) / b
        if abs(change) >= 500.0:
            return f"{a / b:.1f} times", better
        return f"{abs(change):.0f} % {'lower' if change < 0 else 'higher'}", better

    def text(self, i: int) -> str:
        """The number of run `i` as shown."""
        return number(self.values[i], self.digits)

    def _cost(self, value: float | None) -> float | None:
        if value is None:
            return None
        if self.goal == "one":
            return abs(math.log(value)) if value > 0.0 else math.inf
        return value

    def _same(self, i: int, j: int) -> bool:
        return self.text(i) == self.text(j)


def table_rows(runs: Sequence[Metrics]) -> list[Row]:
    """The rows of the table, those that no run has left out."""

    def row(label: str, get: Callable[[Metrics], Any], goal: str = "", about: str = "") -> Row:
        return Row(label, tuple(get(run) for run in runs), goal=goal, about=about)

    reference = next((REFERENCE[r["against"]] for r in runs if r["against"]), "")
    rows = [
        row(
            "Position error, RMS, m",
            lambda m: m["ate_m"],
            "low",
            f"ATE: horizontal, against {reference}; aligned only at the start of a drive without GNSS"
            if reference
            else "",
        )
    ]
    for i, length in enumerate(runs[0]["rpe_percent"]):
        rows.append(
            row(
                f"Relative error over {length} m, %",
                lambda m, key=length: m["rpe_percent"].get(key),  # type: ignore[misc]
                "low",
                "RPE: mean over all stretches of that length" if i == 0 else "",
            )
        )
    rows += [
        row("Heading error, RMS, deg", lambda m: _degrees(m["yaw_rmse_rad"]), "low"),
        row("Velocity error, RMS, m/s", lambda m: m["velocity_rmse_mps"], "low"),
        row(
            "Honesty of the claimed uncertainty",
            lambda m: m["nees_mean"],
            "one",
            "NEES per dimension: 1 is honest, above 1 too sure, below 1 too cautious",
        ),
    ]
    rows += _outage_rows(runs)
    rows += [
        row("Fixes kept back: number", lambda m: _of(m["held_out"], "fixes")),
        row("Fixes kept back: median distance, m", lambda m: _of(m["held_out"], "median_m"), "low"),
        row("Fixes kept back: 95 % within, m", lambda m: _of(m["held_out"], "p95_m"), "low"),
        row("GNSS measurements rejected", lambda m: m["rejected"]["gnss"]),
        row("Wheel measurements rejected", lambda m: m["rejected"]["wheels"]),
        row("Changes of weight", lambda m: m["weights"]["changes"]),
        row("Distance driven, as estimated, m", lambda m: m["distance_m"]),
        row("Computing speed, times real time", lambda m: m["realtime_factor"]),
        row(
            "Time of an update, median, ms",
            lambda m: m["update_latency_ms"]["p50"] or None,
        ),
        row("Time of an update, 99 % within, ms", lambda m: m["update_latency_ms"]["p99"] or None),
    ]
    return [r for r in rows if any(value is not None for value in r.values)]


def _outage_rows(runs: Sequence[Metrics]) -> list[Row]:
    rows = []
    for i, outage in enumerate(runs[0]["outages"]):

        def get(key: str, i: int = i) -> tuple[float | None, ...]:
            return tuple(run["outages"][i][key] if i < len(run["outages"]) else None for run in runs)

        name = f"Without GNSS for {outage['seconds']:g} s from {outage['start_s']:g} s"
        rows += [
            Row(f"{name}: error at its end, m", get("end_error_m"), goal="low"),
            Row(f"{name}: median error, m", get("median_m"), goal="low"),
            Row(f"{name}: end error, % of the distance", get("percent"), goal="low"),
        ]
    return rows


def head_of_one(metrics: Metrics) -> list[str]:
    """The opening sentences of a report on one run."""
    sentences = [
        f"The log {metrics['log']} lasts {number(metrics['duration_s'])} s; "
        f"the vehicle is {metrics['vehicle']}. "
        f"It was replayed with {metrics['mode']} weighting at {number(metrics['realtime_factor'], 2)} times "
        f"real time, over an estimated {number(metrics['distance_m'])} m."
    ]
    if metrics["ate_m"] is not None:
        sentences.append(
            f"Against {REFERENCE[metrics['against']]}, the horizontal position error is "
            f"{number(metrics['ate_m'], 2)} m RMS."
        )
    elif metrics["against"] is None:
        sentences.append(
            "The log holds neither truth nor spare GNSS fixes: the accuracy could not be scored."
        )
    sentences += [_outage_sentence(outage) for outage in metrics["outages"]]
    sentences += _honesty(metrics["nees_mean"])
    sentences += _terrain(metrics["terrain"])
    sentences += _rejections(metrics["rejected"])
    if metrics["status"]["value"] != "running":
        sentences.append(f"Status at the end: {metrics['status']['value']} ({metrics['status']['message']}).")
    return sentences


def head_of_many(names: Sequence[str], runs: Sequence[Metrics], ours: int, theirs: int) -> list[str]:
    """The opening sentences of a report that compares run `ours` with run `theirs`."""
    a, b = names[ours], names[theirs]
    first = runs[ours]
    listed = ", ".join(names[:-1]) + f" and {names[-1]}"
    times = "twice" if len(runs) == 2 else f"{len(runs)} times"
    sentences = [
        f"The log {first['log']} lasts {number(first['duration_s'])} s; the vehicle is {first['vehicle']}. "
        f"It was replayed {times} from the same data: {listed}."
    ]
    rows = table_rows(runs)
    for row in rows:
        words, _ = row.verdict(ours, theirs)
        if words and (row.label.startswith("Position error") or row.label.endswith("error at its end, m")):
            name, unit = row.label.rsplit(", ", 1)
            sentences.append(
                f"{name}: {row.text(ours)} {unit} with {a} and {row.text(theirs)} {unit} with {b}, "
                f"so {words}{'' if words == 'equal' else f' with {a}'}."
            )
    counted = [row.verdict(ours, theirs)[1] for row in rows if row.verdict(ours, theirs)[0]]
    if counted:
        better, worse = counted.count("better"), counted.count("worse")
        sentences.append(
            f"Of {len(counted)} scores in the table, {a} is better than {b} in {better} and worse in {worse}."
        )
    else:
        sentences.append("The log holds nothing to score against: the runs can only be looked at.")
    return sentences


def pick_pair(runs: Sequence[Metrics]) -> tuple[int, int]:
    """Which run is looked at and which it is compared with: adaptive against fixed where both are there."""
    modes = [run["mode"] for run in runs]
    ours = modes.index("adaptive") if "adaptive" in modes else 0
    rest = [i for i in range(len(runs)) if i != ours]
    theirs = next((i for i in rest if modes[i] == "fixed"), rest[0] if rest else ours)
    return ours, theirs


def _outage_sentence(outage: Mapping[str, Any]) -> str:
    name = f"Without GNSS for {outage['seconds']:g} s from {outage['start_s']:g} s"
    if outage["end_error_m"] is None:
        return f"{name} there was nothing to score against."
    share = "" if outage["percent"] is None else f", {number(outage['percent'], 2)} % of the distance"
    return (
        f"{name} the position was {number(outage['end_error_m'], 2)} m off at the end, "
        f"after {number(outage['distance_m'])} m{share}."
    )


def _honesty(nees: float | None) -> list[str]:
    if nees is None:
        return []
    if nees > 2.0:
        words = "the filter is surer of its position than its errors allow"
    elif nees < 0.5:
        words = "the filter is more cautious about its position than its errors ask for"
    else:
        words = "the claimed uncertainty of the position fits its errors"
    return [f"NEES per dimension is {number(nees, 2)} (1 is honest): {words}."]


def _terrain(shares: Mapping[str, float]) -> list[str]:
    if not shares:
        return []
    ranked = sorted(shares.items(), key=lambda item: -item[1])
    parts = ", ".join(f"{name} {100 * share:.0f} %" for name, share in ranked if share >= 0.005)
    return [f"Ground as detected, by time: {parts}."]


def _rejections(rejected: Mapping[str, int]) -> list[str]:
    if not any(rejected.values()):
        return []
    parts = [f"{count} of {name}" for name, count in rejected.items() if count]
    return [f"Measurements rejected by a gate: {' and '.join(parts)}."]


def _degrees(angle_rad: float | None) -> float | None:
    return None if angle_rad is None else math.degrees(angle_rad)


def _of(group: Mapping[str, Any] | None, key: str) -> Any:
    return None if group is None else group[key]
