"""The files of a benchmark.

benchmark.json   every row, comparison and target, with its provenance
benchmark.md     the tables; with `--docs` also the document made of them
report.html      tables and figure in one page
parts/           the rows of single jobs, from which a stopped run continues
"""

import dataclasses
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.json_text import to_json
from terrafusion.datasets.core.tables import number
from terrafusion.fusion.benchmark.checkpoints import LIBRARIES, hash_sources, sources_sha256
from terrafusion.fusion.benchmark.compare import LEAST_UNITS, Contrast, as_json, contrasts, shares
from terrafusion.fusion.benchmark.methods import ADAPTIVE, BASELINE
from terrafusion.fusion.benchmark.plan import BenchmarkPlan
from terrafusion.fusion.benchmark.reasons import reasons
from terrafusion.fusion.benchmark.run import BenchmarkResult
from terrafusion.fusion.benchmark.targets import MISSED, REACHED, Target, pooled_nees, targets
from terrafusion.fusion.benchmark.twin_runs import FIELD
from terrafusion.fusion.metrics.pooled_consistency import PooledConsistency
from terrafusion.fusion.noise.modes import load_modes
from terrafusion.fusion.noise.policy import load_policy
from terrafusion.fusion.reports.benchmark_tables import Section, tables
from terrafusion.fusion.reports.page import Tile, VerdictBox, write_page, write_text
from terrafusion.fusion.reports.plots import style
from terrafusion.fusion.reports.plots.sheet import Sheet

SCHEMA = "terrafusion.benchmark/1"
MARK = "<!-- what follows is written by terrafusion benchmark --docs -->"
CAPTION = (
    "Position error in the outage over that of the fixed noise tuned on the training drives: median of the "
    "pairs and its 95 % interval. The filled dot is the adaptive weighting with the detected terrain."
)
COLOURS = style.MODE_COLOURS | {"data sheet": "#e69f00", "shuffled": "#8c510a", "adversarial": "#5e2a84"}
METHOD_PX, LEAST_PX = 15, 48
"""Height of a method in the row of its group, and of the row at least."""
RANGE = (0.1, 20.0)
"""Of the ratios; what lies outside, such as those of failed replays, is drawn at its ends."""
TICKS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0)


def write_benchmark(out: Path, result: BenchmarkResult, origin: Mapping[str, str]) -> list[Section]:
    """All files but the parts; returns the tables. A TerrafusionError where a file cannot be written."""
    sections = tables(result.rows)
    write_text(out / "benchmark.json", to_json(_content(result, origin), indent=1) + "\n")
    write_text(out / "benchmark.md", "\n".join(document_lines(sections, result, origin)) + "\n")
    judged, sheet = targets(result.rows), Sheet()
    plot_ratios(sheet, contrasts(result.rows))
    write_page(
        out / "report.html", "benchmark.html.j2", "Fixed against adaptive weighting",
        verdicts=[_verdict(judged)], tiles=_tiles(judged), provenance=origin, packages=LIBRARIES,
        tables=sections, caption=CAPTION, refused=[one.line for one in result.refused], **sheet.parts(),
    )  # fmt: skip
    return sections


def _verdict(judged: Sequence[Target]) -> VerdictBox:
    """How many targets are reached, and a sentence for each that is missed."""
    missed = [t for t in judged if t.verdict() == MISSED]
    reached = sum(t.verdict() == REACHED for t in judged)
    reasons = [f"Missed: {t.name}, {t.what}: {number(t.found)}, limit {t.limit:g}." for t in missed]
    left = len(judged) - reached - len(missed)
    title = f"{reached} of {len(judged)} targets are reached, {len(missed)} missed, {left} open"
    return VerdictBox("not_to_be_used" if missed else "doubtful" if left else "good", title, reasons)


def _tiles(judged: Sequence[Target]) -> list[Tile]:
    """The first three ratios of adaptive to fixed weights."""
    found = [t for t in judged if t.what.endswith(f"{ADAPTIVE} over {BASELINE}")][:3]
    return [Tile(t.what, number(t.found), f"target {t.limit:g}: {t.verdict()}") for t in found]


def write_document(
    path: Path, made: Sequence[Section], result: BenchmarkResult, origin: Mapping[str, str]
) -> None:
    """Replace what follows the line `MARK` of a document by the tables.

    Raises:
        ConfigError: the file is not there, or has no such line.
        TerrafusionError: it cannot be written.
    """
    lines = document_lines(made, result, origin)
    write_text(path, document_head(path) + MARK + "\n\n" + "\n".join(lines) + "\n")


def document_head(path: Path) -> str:
    """What precedes the line `MARK` of a document; a ConfigError where there is no such file or line."""
    try:
        head, mark, _ = path.read_text(encoding="utf-8").partition(MARK)
    except (OSError, ValueError):
        head, mark = "", ""
    if not mark:
        raise ConfigError(
            "is no document with a place for the tables", file=path, remedy=f"add a line {MARK}"
        )
    return head


def origin_of(plan: BenchmarkPlan, command: str) -> dict[str, str]:
    """Command, commit, sources and inputs of a benchmark, to be recorded before it runs."""
    seeds = [f"{family} {plan.seed_count(family)}" for family in plan.families if family != FIELD]
    return {
        "command": command,
        "commit": commit() or "not from a checkout",
        "sources": sources_sha256()[:16],
        "policy": load_policy().inputs_sha256[:16],
        "modes": load_modes().inputs_sha256[:16],
        "seeds": ", ".join(seeds) or "none",
    }


def at_the_end(origin: Mapping[str, str]) -> dict[str, str]:
    """The origin, with a note where the sources have changed since the start."""
    note = "" if hash_sources()[:16] == origin["sources"] else ", changed while it ran"
    return {**origin, "sources": origin["sources"] + note}


def commit() -> str:
    """Commit of the checkout that this library runs from, "-dirty" where files differ; "" without one.

    An installed library is in no checkout, even where the folder above it is one.
    """
    file = Path(__file__)
    try:
        _git(file.parent, "ls-files", "--error-unmatch", file.name)
        return _git(file.parent, "describe", "--always", "--dirty", "--abbrev=12")
    except (OSError, subprocess.SubprocessError):
        return ""


def _git(folder: Path, *words: str) -> str:
    command = ["git", "-C", str(folder), *words]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()


def document_lines(made: Sequence[Section], result: BenchmarkResult, origin: Mapping[str, str]) -> list[str]:
    """The tables as Markdown, and where they come from."""
    lines = [line for section in made for line in [*section.markdown(), ""]]
    if result.refused:
        lines += ["## Logs not run", "", *(f"- {one.line}" for one in result.refused), ""]
    return [*lines, "## Made by", "", *(f"- {name}: `{text}`" for name, text in origin.items())]


def _content(result: BenchmarkResult, origin: Mapping[str, str]) -> dict[str, Any]:
    rows = result.rows
    return {
        "schema": SCHEMA,
        "origin": dict(origin),
        "contrasts": [as_json(c) for baseline in ("fixed", "innovation") for c in contrasts(rows, baseline)],
        "shares": [dataclasses.asdict(s) for s in shares(rows)],
        "targets": [dataclasses.asdict(t) | {"verdict": t.verdict()} for t in targets(rows)],
        "reasons": [dataclasses.asdict(r) | {"blame": r.blame()} for r in reasons(rows)],
        "consistency": [_cell(c) for c in pooled_nees(rows)],
        "refused": [dataclasses.asdict(one) for one in result.refused],
        "rows": [as_json(row) for row in rows],
    }


def _cell(cell: PooledConsistency) -> dict[str, Any]:
    """A cell with its verdict, or without verdict and interval where its drives are too few."""
    few = cell.drives < LEAST_UNITS
    known = {"interval": None, "verdict": None} if few else {"verdict": cell.verdict()}
    return dataclasses.asdict(cell) | known


def plot_ratios(sheet: Sheet, contrasts: Sequence[Contrast]) -> None:
    """A row a family and plant, in it each method with its 95 % interval; below 1 its errors are smaller."""
    shown = [c for c in contrasts if c.method != BASELINE]
    groups = list(dict.fromkeys((c.family, c.plant) for c in shown))
    methods = list(dict.fromkeys(c.method for c in shown))
    if not shown:
        return
    names = [f"{family}, {plant}" for family, plant in groups]
    px = max(LEAST_PX, METHOD_PX * (len(methods) + 2))
    x = f"position error over that of {BASELINE}"
    ends = [_clipped(x) for c in shown for x in (c.ratio, *(c.interval or ()))]
    limits = (0.9 * min(ends), 1.1 * max(ends))
    plot = sheet.add_rows("rows ratios", x, names, px, x_axis_type="log", x_range=limits)
    plot.panel.figure.xaxis.ticker = [t for t in TICKS if limits[0] <= t <= limits[1]]
    edge = np.array([-0.5, len(groups) - 0.5])
    plot.line(np.ones(2), edge, "as large as that of fixed", style.TRUTH_ON_ANY, width=1.0)
    for k, method in enumerate(methods):
        own = [c for c in shown if c.method == method]
        offset = (k - 0.5 * (len(methods) - 1)) / (len(methods) + 2)
        rows = np.array([groups.index((c.family, c.plant)) + offset for c in own])
        values = [(c.ratio, *(c.interval or (c.ratio, c.ratio))) for c in own]
        text = [f"{v:.3g} [{a:.3g}, {b:.3g}]" for v, a, b in values]
        ratio, low, high = (np.array([_clipped(row[i]) for row in values]) for i in range(3))
        colour = style.line_colour(style.colour_of(method, COLOURS))
        plot.intervals(rows, ratio, low, high, method, colour, hollow=method != ADAPTIVE, text=text)


def _clipped(ratio: float) -> float:
    return min(max(ratio, RANGE[0]), RANGE[1])
