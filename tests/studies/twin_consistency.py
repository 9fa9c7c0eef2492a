"""NEES and NIS on twin drives, ground by ground, in the adaptive and the fixed mode.

    python -m tests.studies.twin_consistency --seeds 10

Each seed is a drive of its own: heading, soil (scattered as for the policy) and all sensor noise are drawn
from it. The seeds and the scenario are not those of the policy's training. Every drive has one outage; rows
inside it are told apart, because there P is the model's word and not the receiver's.

Two bounds stand beside each mean. The band is where the mean of a consistent estimator would fall, with the
effective samples of all drives added up. The interval is the bootstrap's over drives, which are independent
(Efron 1979, Ann. Statist. 7(1)): how far the mean itself is known.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from terrafusion.datasets.core.errors import ConfigError, DataError, TerrafusionError
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.metrics.consistency import (
    CONFIDENCE,
    Consistency,
    summarise,
    whitened_series,
)
from terrafusion.fusion.metrics.pooled_consistency import IN_OUTAGE, VERDICT_SIGNS, PooledConsistency, pool
from tests.studies.parts import TaskWorkers, add_options, answers

MODES = ("adaptive", "fixed")
SCENARIO = "waypoints"
FIRST_SEED = 1000
"""The policy is fitted to seeds from 0 on."""
OUTAGE_S = (20.0, 30.0)
"""Start and length of the outage of each drive."""
TABLES = (
    ("position", f"position{IN_OUTAGE}"),
    ("heading", f"heading{IN_OUTAGE}"),
    ("nis gnss", "nis wheels"),
)


Drive = tuple[str, str, float, int, tuple[str, ...]]
"""Scenario, ground, slope in degrees, seed, and the modes in which it is replayed."""


@dataclass(frozen=True)
class ConsistencyPlan:
    """Which drives are made: `seeds` of each ground, in each mode."""

    seeds: int
    terrains: tuple[str, ...] = ("mud", "loose_sand", "medium_sand", "asphalt")
    modes: tuple[str, ...] = MODES
    scenario: str = SCENARIO
    slope_deg: float = 0.0

    def drives(self) -> list[Drive]:
        """All drives, ground by ground."""
        seeds = range(FIRST_SEED, FIRST_SEED + self.seeds)
        return [(self.scenario, t, self.slope_deg, seed, self.modes) for t in self.terrains for seed in seeds]


@dataclass(frozen=True)
class ConsistencyResult:
    """What the drives of a plan gave; `refused` says which of them could not be estimated, and why."""

    cells: tuple[PooledConsistency, ...]
    refused: tuple[str, ...] = ()


def run(
    plan: ConsistencyPlan, workers: TaskWorkers | None = None, out: Path | None = None
) -> ConsistencyResult:
    """Drive, replay and test; the same plan finds the same.

    Raises:
        ConfigError: no seeds, or an unknown ground or scenario.
    """
    if plan.seeds < 1:
        raise ConfigError(f"{plan.seeds} seeds are none", remedy="give --seeds 1 or more")
    found: dict[tuple[str, str], list[tuple[Consistency, ...]]] = {
        (terrain, mode): [] for terrain in plan.terrains for mode in plan.modes
    }
    refused: list[str] = []
    drives = plan.drives()
    for drive, told in zip(
        drives, answers(drives, checked_modes, workers or TaskWorkers(), out), strict=True
    ):
        _, terrain, _, seed, _ = drive
        for mode, rows in zip(plan.modes, told, strict=True):
            if isinstance(rows, str):
                refused.append(f"{terrain}, {mode}, seed {seed}: {rows}")
            else:
                found[terrain, mode].append(tuple(Consistency(**row) for row in rows))
    cells = [cell for (terrain, mode), rows in found.items() for cell in pool(terrain, mode, rows)]
    return ConsistencyResult(tuple(cells), tuple(refused))


def checked_modes(drive: Drive) -> list[list[dict[str, object]] | str]:
    """The quantities of a drive in each mode, or why it could not be estimated."""
    from terrafusion.fusion.training.simulated_runs import Condition

    scenario, terrain, slope_deg, seed, modes = drive
    recording = Condition(scenario, terrain, slope_deg, 0.0, seed).run()
    found: list[list[dict[str, object]] | str] = []
    for mode in modes:
        try:
            found.append([dataclasses.asdict(row) for row in checked_drive(recording, mode)])
        except DataError as error:
            found.append(str(error))
    return found


def checked_drive(recording: Recording, mode: str) -> tuple[Consistency, ...]:
    """Replay one drive; its quantities, those against the truth apart inside and outside the outage."""
    from terrafusion.fusion.metrics.scores import Outage
    from terrafusion.fusion.replay import replay

    outage = Outage(*OUTAGE_S)
    result = replay(recording, mode=mode, outages=[outage])
    errors = result.scores.errors
    rows: list[Consistency | None] = []
    for series in whitened_series(result.estimate, errors, errors):
        lost = outage.covers(series.t_ns, recording.start_ns)
        if series.quantity.startswith("nis"):
            rows.append(summarise(series, np.ones_like(lost), recording.start_ns))
            continue
        rows.append(summarise(series, ~lost, recording.start_ns))
        inside = dataclasses.replace(series, quantity=f"{series.quantity}{IN_OUTAGE}")
        rows.append(summarise(inside, lost, recording.start_ns))
    return tuple(row for row in rows if row is not None)


def table(cells: Sequence[PooledConsistency], quantities: Sequence[str]) -> list[str]:
    """Markdown: a row for each ground and mode, a column for each quantity that was found."""
    shown = [q for q in quantities if any(cell.quantity == q for cell in cells)]
    lines = ["| ground | mode | " + " | ".join(shown) + " |", "| --- | --- |" + " --- |" * len(shown)]
    for terrain, mode in dict.fromkeys((cell.terrain, cell.mode) for cell in cells):
        of = {cell.quantity: cell for cell in cells if (cell.terrain, cell.mode) == (terrain, mode)}
        texts = [_text(of[q]) if q in of else "-" for q in shown]
        lines.append(f"| {terrain} | {mode} | " + " | ".join(texts) + " |")
    return lines


def _text(cell: PooledConsistency) -> str:
    (a, b), (low, high) = cell.interval, cell.band
    return f"{cell.mean:.2f} [{a:.2f}, {b:.2f}] {VERDICT_SIGNS[cell.verdict()]} {low:.2f}..{high:.2f}"


def command(arguments: list[str] | None = None) -> int:
    """`python -m tests.studies.twin_consistency`: 0 when done, 1 with one line for a known error."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.twin_consistency",
        description="NEES and NIS of the estimator on twin drives of each ground.",
        epilog="example: python -m tests.studies.twin_consistency --seeds 10",
    )
    plan = ConsistencyPlan(seeds=0)
    parser.add_argument("--seeds", type=int, default=5, help="drives of each ground (default 5)")
    parser.add_argument("--terrain", nargs="+", default=plan.terrains, help="grounds")
    parser.add_argument("--mode", nargs="+", default=plan.modes, help="modes of the estimator")
    parser.add_argument("--scenario", default=plan.scenario, help=f"default {plan.scenario}")
    parser.add_argument("--slope-deg", type=float, default=plan.slope_deg, help="default 0")
    parser.add_argument("--out", type=Path, help="folder for parts; the same command continues")
    add_options(parser)
    given = parser.parse_args(arguments)
    asked = ConsistencyPlan(
        given.seeds, tuple(given.terrain), tuple(given.mode), given.scenario, given.slope_deg
    )
    try:
        found = run(asked, TaskWorkers.of(given), given.out)
    except TerrafusionError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print("\n".join(report(asked, found)))
    return 0


def report(plan: ConsistencyPlan, found: ConsistencyResult) -> list[str]:
    """Everything the command prints."""
    start, seconds = OUTAGE_S
    lines = [
        f"Mean per dimension over {plan.seeds} drives of {plan.scenario} a ground, "
        f"slope {plan.slope_deg:g} deg, no GNSS from {start:g} to {start + seconds:g} s.",
        f"[{CONFIDENCE:.0%} of the bootstrap over drives], then = inside, + above (overconfident), - below "
        f"(cautious) the {CONFIDENCE:.0%} band of a consistent estimator.",
    ]
    for quantities in TABLES:
        lines += ["", *table(found.cells, quantities)]
    return [*lines, *(f"not estimated: {line}" for line in found.refused)]


if __name__ == "__main__":
    from tests.studies import twin_consistency

    raise SystemExit(twin_consistency.command())  # workers know the drives by the module's own name
