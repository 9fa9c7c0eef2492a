"""The scores of a replay as a table and as sentences, from the content of `metrics.json` alone.

What was not scored is not mentioned; a comparison words wins and losses alike.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from terrafusion.datasets.core.tables import number
from terrafusion.fusion.reports.page import Tile, VerdictBox

Metrics = Mapping[str, Any]

BASELINES = {"dead_reckoning_m": "dead reckoning", "gnss_m": "receiver alone"}
"""Baselines by their key in `metrics.json`."""
TILES = (
    "Position error", "error at its end", "Consistency", "95 % within", "Estimated distance",
    "Wheel measurements rejected", "Real-time factor",
)  # fmt: skip
"""Scores a report opens with, the first three that there are."""
REFERENCE = {"truth": "the ground truth", "gnss_held_out": "held-out GNSS fixes"}


@dataclass(frozen=True)
class ScoreRow:
    """One score of each run, None where it was not scored.

    `goal` is "low" (less is better), "one" (nearer to 1 is better) or "" (neither is better). `baselines` are
    the same score of the baselines of `BASELINES`.
    """

    label: str
    values: tuple[float | None, ...]
    goal: str = ""
    about: str = ""
    baselines: tuple[float | None, ...] = (None, None)

    def best(self) -> int | None:
        """Which run is best, or None where fewer than two are scored or the best are equal as shown."""
        costs = [self._cost(value) for value in self.values]
        scored = [cost for cost in costs if cost is not None]
        if not self.goal or len(scored) < 2:
            return None
        first = costs.index(min(scored))
        equal = [i for i, cost in enumerate(costs) if cost is not None and self.text(i) == self.text(first)]
        return equal[0] if len(equal) == 1 else None

    def verdict(self, ours: int, theirs: int) -> tuple[str, str]:
        """How run `ours` compares with run `theirs`: a sentence part, and "better", "worse" or ""."""
        a, b = self.values[ours], self.values[theirs]
        cost_a, cost_b = self._cost(a), self._cost(b)
        if not self.goal or cost_a is None or cost_b is None or a is None or b is None:
            return "", ""
        if self.text(ours) == self.text(theirs):
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
        return number(self.values[i])

    def baseline_text(self, k: int) -> str:
        """The number of a baseline as shown."""
        return number(self.baselines[k])

    def _cost(self, value: float | None) -> float | None:
        if value is None or self.goal != "one":
            return value
        return abs(math.log(value)) if value > 0.0 else math.inf


def score_rows(runs: Sequence[Metrics]) -> list[ScoreRow]:
    """The rows of the table, those that have a value for any run."""

    def row(label: str, get: Callable[[Metrics], Any], goal: str = "", about: str = "") -> ScoreRow:
        return ScoreRow(label, tuple(get(run) for run in runs), goal=goal, about=about)

    def held_out(key: str) -> Callable[[Metrics], Any]:
        return lambda m: None if m["held_out"] is None else m["held_out"][key]

    def heading_deg(m: Metrics) -> float | None:
        return None if m["yaw_rmse_rad"] is None else math.degrees(m["yaw_rmse_rad"])

    reference = next((REFERENCE[r["against"]] for r in runs if r["against"]), "")
    ate = f"ATE: horizontal, against {reference}; aligned only at the start of a drive without GNSS"
    ates = tuple(run["ate_m"] for run in runs)
    baselines = _baselines(runs[0].get("baselines"))
    rows = [ScoreRow("Position error, RMS, m", ates, "low", ate if reference else "", baselines)]
    for i, length in enumerate(runs[0]["rpe_percent"]):
        values = tuple(run["rpe_percent"].get(length) for run in runs)
        about = "RPE: mean over all segments of that length" if i == 0 else ""
        rows.append(ScoreRow(f"Relative error over {length} m, %", values, goal="low", about=about))
    nees = "NEES per dimension: 1 is consistent, above 1 overconfident, below 1 cautious"
    rows += [
        row("Heading error, RMS, deg", heading_deg, "low"),
        row("Velocity error, RMS, m/s", lambda m: m["velocity_rmse_mps"], "low"),
        row("Consistency of the covariance", lambda m: m["nees_mean"], "one", nees),
        *_outage_rows(runs),
        row("Held-out fixes: number", held_out("fixes")),
        row("Held-out fixes: median distance, m", held_out("median_m"), "low"),
        row("Held-out fixes: 95 % within, m", held_out("p95_m"), "low"),
        row("GNSS measurements rejected", lambda m: m["rejected"]["gnss"]),
        row("Wheel measurements rejected", lambda m: m["rejected"]["wheels"]),
        row("Weight changes", lambda m: m["weights"]["changes"]),
        row("Estimated distance, m", lambda m: m["distance_m"]),
        row("Real-time factor", lambda m: m["realtime_factor"]),
        row("Latency of an update, median, ms", lambda m: m["update_latency_ms"]["p50"] or None),
        row("Latency of an update, 99 % within, ms", lambda m: m["update_latency_ms"]["p99"] or None),
    ]
    return [r for r in rows if any(value is not None for value in r.values)]


def _outage_rows(runs: Sequence[Metrics]) -> list[ScoreRow]:
    rows = []
    for i, outage in enumerate(runs[0]["outages"]):
        for key, what in (
            ("end_error_m", "error at its end, m"),
            ("median_m", "median error, m"),
            ("percent", "end error, % of the distance"),
        ):
            values = tuple(run["outages"][i][key] if i < len(run["outages"]) else None for run in runs)
            ends = runs[0].get("baselines", {}).get("outages", ())[i : i + 1] if key == "end_error_m" else ()
            baselines = _baselines(ends[0] if ends else None)
            rows.append(ScoreRow(f"{_outage_name(outage)}: {what}", values, goal="low", baselines=baselines))
    return rows


def _baselines(errors: Mapping[str, Any] | None) -> tuple[float | None, ...]:
    return tuple(None if errors is None else errors.get(key) for key in BASELINES)


def tiles(rows: Sequence[ScoreRow], names: Sequence[str], ours: int) -> list[Tile]:
    """The three numbers of run `ours` to see first: error, end of an outage, consistency; else others.

    Below each stand those of the other runs and of the baselines.
    """
    found: list[ScoreRow] = []
    for word in TILES:
        scored = (row for row in rows if word in row.label and row.values[ours] is not None)
        found += [row for row in scored if row not in found][:1]
    return [Tile(row.label, row.text(ours), _beside(row, names, ours)) for row in found[:3]]


def _beside(row: ScoreRow, names: Sequence[str], ours: int) -> str:
    others = [f"{name} {row.text(i)}" for i, name in enumerate(names) if i != ours]
    others += [
        f"{name} {row.baseline_text(k)}"
        for k, name in enumerate(BASELINES.values())
        if row.baselines[k] is not None
    ]
    aim = ["1 is consistent"] if row.goal == "one" else []
    return "; ".join([*([names[ours]] if len(names) > 1 else []), *others, *aim])


def shown_baselines(rows: Sequence[ScoreRow]) -> list[tuple[int, str]]:
    """The baselines that are scored in any row: number and name."""
    names = enumerate(BASELINES.values())
    return [(k, name) for k, name in names if any(row.baselines[k] is not None for row in rows)]


def verdicts(names: Sequence[str], runs: Sequence[Metrics]) -> list[VerdictBox]:
    """The verdict of each run that has one."""
    out = []
    for name, metrics in zip(names, runs, strict=True):
        found = metrics.get("verdict")
        if found is not None:
            run = f" ({name})" if len(runs) > 1 else ""
            title = f"Verdict{run}: {found['value'].replace('_', ' ')}"
            out.append(VerdictBox(found["value"], title, found["reasons"]))
    return out


def summary_of_one(metrics: Metrics) -> list[str]:
    """The opening sentences of a report on one run: what the verdict and the three numbers do not say."""
    sentences = [
        f"The log {metrics['log']} lasts {number(metrics['duration_s'])} s; the vehicle is "
        f"{metrics['vehicle']}. It was replayed with {metrics['mode']} weighting at "
        f"{number(metrics['realtime_factor'], 2)} times real time, over an estimated "
        f"{number(metrics['distance_m'])} m."
    ]
    if metrics["ate_m"] is None and metrics["against"] is None:
        sentences.append("The log has neither truth nor enough GNSS fixes: the accuracy could not be scored.")
    sentences += [_outage_sentence(outage) for outage in metrics["outages"]]
    if metrics["terrain"]:
        ranked = sorted(metrics["terrain"].items(), key=lambda item: -item[1])
        shares = ", ".join(f"{name} ({100 * share:.0f} %)" for name, share in ranked if share >= 0.005)
        sentences.append(f"Detected terrain, by time: {shares}.")
    rejected = [f"{count} of {name}" for name, count in metrics["rejected"].items() if count]
    if rejected:
        sentences.append(f"Measurements rejected by a gate: {' and '.join(rejected)}.")
    status = metrics["status"]
    if status["value"] != "running":
        sentences.append(f"Status at the end: {status['value']} ({status['message']}).")
    return sentences


def summary_of_many(names: Sequence[str], runs: Sequence[Metrics], ours: int, theirs: int) -> list[str]:
    """The opening sentences of a report that compares run `ours` with run `theirs`."""
    a, b, first = names[ours], names[theirs], runs[ours]
    times = "twice" if len(runs) == 2 else f"{len(runs)} times"
    sentences = [
        f"The log {first['log']} lasts {number(first['duration_s'])} s; the vehicle is {first['vehicle']}. "
        f"It was replayed {times} from the same data: {', '.join(names[:-1])} and {names[-1]}."
    ]
    rows = score_rows(runs)
    for row in rows:
        verdict, _ = row.verdict(ours, theirs)
        if verdict and (row.label.startswith("Position error") or row.label.endswith("error at its end, m")):
            name, unit = row.label.rsplit(", ", 1)
            sentences.append(
                f"{name}: {row.text(ours)} {unit} with {a} and {row.text(theirs)} {unit} with {b}, "
                f"so {verdict}{'' if verdict == 'equal' else f' with {a}'}."
            )
    sides = [side for verdict, side in (row.verdict(ours, theirs) for row in rows) if verdict]
    if sides:
        better, worse = sides.count("better"), sides.count("worse")
        sentences.append(
            f"Of {len(sides)} scores in the table, {a} is better than {b} in {better} and worse in {worse}."
        )
    else:
        sentences.append("There is no reference to score against: the runs can only be compared by eye.")
    return sentences


def pick_pair(runs: Sequence[Metrics]) -> tuple[int, int]:
    """The run shown in detail and the one it is compared with: adaptive and fixed where both are there."""
    modes = [run["mode"] for run in runs]
    ours = modes.index("adaptive") if "adaptive" in modes else 0
    rest = [i for i in range(len(runs)) if i != ours]
    theirs = next((i for i in rest if modes[i] == "fixed"), rest[0] if rest else ours)
    return ours, theirs


def _outage_name(outage: Mapping[str, Any]) -> str:
    return f"Without GNSS for {outage['seconds']:g} s from {outage['start_s']:g} s"


def _outage_sentence(outage: Mapping[str, Any]) -> str:
    name = _outage_name(outage)
    if outage["end_error_m"] is None:
        return f"{name} there was nothing to score against near its end."
    share = "" if outage["percent"] is None else f", {number(outage['percent'], 2)} % of the distance"
    return (
        f"{name} the position was {number(outage['end_error_m'], 2)} m off at the end, "
        f"after {number(outage['distance_m'])} m{share}."
    )
