"""The tables of a benchmark as plain cells, for the terminal, the document and the page alike."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.tables import markdown_table, number
from terrafusion.fusion.benchmark import compare
from terrafusion.fusion.benchmark.methods import ADAPTIVE, BASELINE, METHODS
from terrafusion.fusion.benchmark.reasons import Reason, reasons, recognised
from terrafusion.fusion.benchmark.run_score import RunScore
from terrafusion.fusion.benchmark.targets import IN_OUTAGE, INSIDE, Target, pooled_nees, targets
from terrafusion.fusion.benchmark.twin_runs import FAMILIES, FIELD, PLANTS
from terrafusion.fusion.metrics.pooled_consistency import VERDICT_SIGNS, PooledConsistency

Cells = list[str]
NOT_SIGNIFICANT = " (not significant)"
WORDS = ("what", "verdict", "beaten by", "cause", "largest loss", "plant, method", "method", "why", "is")
"""Heads of columns of words; the first column is one, too."""


@dataclass(frozen=True)
class Section:
    """A table with an explanation."""

    title: str
    about: str
    heads: tuple[str, ...]
    rows: tuple[Cells, ...]

    def numbers(self) -> list[int]:
        """The columns of numbers."""
        return [i for i, head in enumerate(self.heads) if i and head not in WORDS]

    def markdown(self) -> list[str]:
        """Lines of a section of a document."""
        return [f"## {self.title}", self.about, "", *markdown_table(self.heads, self.rows)]


def tables(rows: Sequence[RunScore]) -> list[Section]:
    """All tables, the main one first; those without rows are left out."""
    made = (
        _main(rows), _targets(targets(rows)), _reasons(reasons(rows)), _wins(compare.contrasts(rows)),
        _shares(rows), _nees(pooled_nees(rows)), _field(rows), _failures(rows), _arms(),
    )  # fmt: skip
    return [table for table in made if table.rows]


def group_name(family: str, plant: str) -> str:
    """ "mixed, twin"."""
    return f"{family}, {plant}"


def _main(rows: Sequence[RunScore]) -> Section:
    """Median error of the fixed noise, and the ratios to it."""
    methods = [method.name for method in METHODS if method.name != BASELINE]
    lines = []
    for group, of in _by_method(compare.contrasts(rows)).items():
        if BASELINE in of:
            units = of[BASELINE].units
            head = [group_name(*group), str(units), number(of[BASELINE].error_m)]
            lines.append([*head, *(_ratio(of.get(method), units) for method in methods)])
    about = (
        f"Root mean square position error inside the outage: its median for {BASELINE} (tuned), and for the "
        "others the median of the paired ratios to it, with its 95 % interval from "
        f"{compare.LEAST_UNITS} pairs on. Below 1 is better. A replay that failed counts as infinitely "
        "wrong; in brackets the pairs where not every drive has labels."
    )
    return Section("Errors", about, ("drives", "pairs", f"{BASELINE}, m", *methods), tuple(lines))


def _by_method(results: Iterable[compare.Contrast]) -> dict[tuple[str, str], dict[str, compare.Contrast]]:
    """Family and plant -> method -> contrast."""
    groups: dict[tuple[str, str], dict[str, compare.Contrast]] = {}
    for c in results:
        groups.setdefault((c.family, c.plant), {})[c.method] = c
    return groups


def _targets(results: Iterable[Target]) -> Section:
    lines = [
        [
            t.name, t.what, f"{'<=' if t.most else '>='} {t.limit:g}{f' {t.unit}' if t.unit else ''}",
            f"{number(t.found)}{_ends(t.interval)}{f'; {t.broken} failed or diverged' if t.broken else ''}",
            t.verdict(),
        ]
        for t in results
    ]  # fmt: skip
    about = (
        "Reached or missed: the whole interval is on one side of the limit. Open: it contains the limit, or "
        f"there is none (below {compare.LEAST_UNITS} drives). G1: {ADAPTIVE} on mixed ground; G2: harm by "
        "wrong labels, or on firm ground; G5: drift in long outages; G9: field logs, missed by any replay of "
        f"{ADAPTIVE} that fails or diverges; they were in view while the estimator was developed."
    )
    return Section("Targets", about, ("target", "what", "limit", "measured", "verdict"), tuple(lines))


def _reasons(results: Iterable[Reason]) -> Section:
    lines = [
        [
            group_name(r.family, r.plant), f"{r.winner}, {r.ratio:.2f}{'' if r.sure else NOT_SIGNIFICANT}",
            number(r.oracle), r.blame(), f"{r.ground}: {r.kind}" if r.ground else "unknown",
            _percent(r.recognised[0]), _percent(r.recognised[1]),
        ]
        for r in results
    ]  # fmt: skip
    about = (
        "Groups in which some baseline beats adaptive by more than 3 %: error of adaptive over that "
        "baseline, of the oracle over it, and the terrain and kind of velocity error with the largest loss."
    )
    heads = ("drives", "beaten by", "oracle", "cause", "largest loss", "recognised", "recognised there")
    return Section("Where adaptive loses", about, heads, tuple(lines))


def _wins(results: Iterable[compare.Contrast]) -> Section:
    methods = [method.name for method in METHODS if method.name != BASELINE]
    groups = _by_method(results)
    lines = [
        [group_name(*key), *(f"{of[a].wins} : {of[a].losses}" if a in of else "-" for a in methods)]
        for key, of in groups.items()
    ]
    about = f"Drives (logs in the field) won and lost against {BASELINE} by more than 3 %."
    return Section("Wins and losses", about, ("drives", *methods), tuple(lines))


def _shares(rows: Sequence[RunScore]) -> Section:
    groups = compare.groups_of(rows)
    lines = []
    for s in compare.shares(rows):
        known = recognised(groups[s.family, s.plant])
        delays = [
            r.switch_s for r in groups[s.family, s.plant] if r.method == ADAPTIVE and r.switch_s is not None
        ]
        if s.share is not None or known is not None:
            share = "no gain" if s.share is None else f"{number(s.share)}{_ends(s.interval)}"
            after = f"{np.median(delays):.1f} s" if delays else "-"
            lines.append([group_name(s.family, s.plant), share, _percent(known), after])
    about = (
        f"Gain of adaptive over {BASELINE} as a share of the gain with true labels, the share of the outages "
        "in which the detector is right, and its delay after a change (median over drives). "
        "No gain: the oracle gains no more than 3 %."
    )
    return Section(
        "Share of the oracle's gain", about, ("drives", "share", "recognised", "delay"), tuple(lines)
    )


def _nees(cells: Iterable[PooledConsistency]) -> Section:
    groups: dict[tuple[str, str], dict[str, PooledConsistency]] = {}
    for cell in cells:
        groups.setdefault((cell.terrain, cell.mode), {})[cell.quantity] = cell
    lines = []
    for (ground, mode), of in groups.items():
        texts = [_cell(of[q]) if q in of else "-" for q in (INSIDE, IN_OUTAGE)]
        lines.append([ground, mode, str(max(c.drives for c in of.values())), *texts])
    about = (
        "Mean NEES of the position per dimension on each true terrain [95 % interval over drives], inside "
        "(=), above (+, overconfident) or below (-, cautious) the band of a consistent estimator; with fewer "
        f"than {compare.LEAST_UNITS} drives the mean alone."
    )
    heads = ("terrain", "plant, method", "drives", INSIDE, IN_OUTAGE)
    return Section("Consistency", about, heads, tuple(lines))


def _field(rows: Sequence[RunScore]) -> Section:
    """Log by log: medians over its outages."""
    own = [row for row in rows if row.family == FIELD and row.error_m is not None]
    lines = []
    for log in dict.fromkeys(row.unit for row in own):
        of = {
            method.name: [row.error_m for row in own if (row.unit, row.method) == (log, method.name)]
            for method in METHODS
        }
        medians = [number(compare.known_median(of[m.name])) if of[m.name] else "-" for m in METHODS]
        lines.append([log, str(len(of[BASELINE])), *medians])
    about = "Median over the outages of a log, m; against truth, or held-out fixes with their noise."
    return Section("Field logs", about, ("log", "drives", *(method.name for method in METHODS)), tuple(lines))


def _failures(rows: Sequence[RunScore]) -> Section:
    results = [(row, row.failed or f"diverged: {row.diverged}") for row in rows if row.failed or row.diverged]
    lines = tuple([f"{row.family}, {row.plant}, {row.drive}", row.method, why] for row, why in results)
    return Section("Replays that failed or diverged", "All of them.", ("drive", "method", "why"), lines)


def _arms() -> Section:
    lines = [[method.name, method.about] for method in METHODS]
    lines += [[name, family.about] for name, family in FAMILIES.items()]
    lines += [[FIELD, "field logs at hand, 30, 60 and 120 s without GNSS; by terrain"]]
    lines += [[name, about] for name, about in PLANTS.items()]
    return Section("Names", "Arms, families of drives, and plants.", ("name", "is"), tuple(lines))


def _ratio(c: compare.Contrast | None, units: int) -> str:
    if c is None:
        return "-"
    return f"{c.ratio:.2f}{_ends(c.interval, 2)}{f' ({c.units})' if c.units != units else ''}"


def _ends(interval: compare.Interval | None, decimals: int | None = None) -> str:
    if interval is None:
        return ""
    low, high = (f"{x:.{decimals}f}" if decimals else number(x) for x in interval)
    return f" [{low}, {high}]"


def _cell(cell: PooledConsistency) -> str:
    if cell.drives < compare.LEAST_UNITS:
        return f"{cell.mean:.2f}"
    (low, high), band, sign = cell.interval, cell.band, VERDICT_SIGNS[cell.verdict()]
    return f"{cell.mean:.2f} [{low:.2f}, {high:.2f}] {sign} {band[0]:.2f}..{band[1]:.2f}"


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100.0 * share:.0f} %"
