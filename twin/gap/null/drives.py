"""How far the judged drives leave what the references drove.

References teach errors of the twin, scatter of the ground and noise for the drives that they made. The time
of the judged runs is counted by cell of commanded speed, turn rate and acceleration; a cell is covered where
the references spent at least a second in it, or as long as any judged run. Cells are shares of the speed and
turn rate that the references reach: half the speed is another drive for a slow robot, too.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.calibrate.inputs import DT_S
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.gap.rollout.nuisance import commanded_acceleration, commanded_twist
from terrafusion.twin.gap.rollout.residuals import WhitenedRun

CELL_SHARE, REACHED = 0.2, 0.95
"""Greatest width of a cell, as a share of this quantile of the references' speeds or turn rates; the middle
one is centred on zero."""
NARROWEST, WIDEST = 0.05, 0.3  # limits of that width, m/s and rad/s (assumed)
ACCELERATION_MPS2 = 0.6  # width of a cell
LEAST_S = 1.0  # time of all references in a cell from which it counts as covered (assumed)
MOST_LISTED = 4
LEAST_MISSING = 0.02  # share of the judged time from which a cell is listed
SPREAD_SIGMAS = 2.0
"""By so many standard deviations of what references have in common, judged drives may have less (set on the
development robots of the study `unseen_gap`)."""
MOSTLY_COVERED = 0.8
"""Share of the judged time from which the drives do not limit the answer (assumed)."""

Cell = tuple[int, int, int]
Samples = Counter[Cell]
"""Number of samples, `DT_S` apart, by cell of commanded speed, turn rate and acceleration."""


@dataclass(frozen=True)
class DriveCoverage:
    """Share of the judged time that references cover, 0 to 1, and what they lack, longest first."""

    covered: float
    missing: tuple[str, ...]

    def limits(self) -> bool:
        """Whether a gap that nothing explains may come from the drives."""
        return self.covered < MOSTLY_COVERED


def cell_widths(references: Sequence[Array]) -> Array:
    """Widths (3,) of the cells by the references' commanded twists (N, 2) each."""
    reached = np.quantile(np.abs(np.concatenate(references)), REACHED, axis=0)
    parts = np.ceil(WIDEST / np.clip(CELL_SHARE * reached, NARROWEST, WIDEST))  # middles are round numbers
    return np.append(WIDEST / parts, ACCELERATION_MPS2)


def by_cell(twist: Array, widths: Array) -> Samples:
    """Samples of a commanded twist (N, 2), m/s and rad/s, in cells of widths (3,)."""
    columns = np.column_stack([twist, commanded_acceleration(twist[:, 0])])
    index = np.round(columns / widths).astype(np.int64)
    low, sides = index.min(axis=0), tuple((np.ptp(index, axis=0) + 1).tolist())
    number, count = np.unique(np.ravel_multi_index(tuple((index - low).T), sides), return_counts=True)
    cells = (np.stack(np.unravel_index(number, sides), axis=1) + low).tolist()
    return Counter({(a, b, c): n for (a, b, c), n in zip(cells, count.tolist(), strict=True)})


def drive_coverage(
    runs: Sequence[WhitenedRun], references: Sequence[WhitenedRun], model: Model
) -> DriveCoverage | None:
    """Coverage of the judged runs by the references; None without references."""
    if not references:
        return None
    return coverage(
        [commanded_twist(r.log, model)[1] for r in runs],
        [commanded_twist(r.log, model)[1] for r in references],
    )


def coverage(runs: Sequence[Array], references: Sequence[Array]) -> DriveCoverage:
    """Coverage of commanded twists (N, 2) each, by those of references."""
    widths = cell_widths(references)
    taught, own = ([by_cell(twist, widths) for twist in some] for some in (references, runs))
    known, judged = (sum(some, Samples()) for some in (taught, own))
    longest = {cell: max(run[cell] for run in own) for cell in judged}
    lacking = {cell: n for cell, n in judged.items() if known[cell] < min(LEAST_S / DT_S, longest[cell])}
    words = Counter[str]()
    for cell, n in lacking.items():
        words[_words(cell, widths)] += n
    long = [name for name in words if words[name] >= LEAST_MISSING * judged.total()]
    order = sorted(long, key=lambda name: (-words[name], name))[:MOST_LISTED]
    listed = tuple(f"{name} ({_seconds(DT_S * words[name])} s)" for name in order)
    return DriveCoverage(1.0 - words.total() / max(judged.total(), 1), listed)


def _seconds(time_s: float) -> str:
    return f"{time_s:.0f}" if time_s >= 1.0 else f"{time_s:.1f}"


def overlap(runs: Sequence[Array], references: Sequence[Array]) -> float:
    """Share of the commands, by time, that runs and references have in common, over that of as many of the
    references with the rest, less `SPREAD_SIGMAS` of one of these; at most one. Twists as for `coverage`."""
    size = min(len(runs), len(references) // 2)
    if not size:
        return 1.0
    widths = cell_widths(references)
    known = [by_cell(twist, widths) for twist in references]
    own = [
        _in_common(known[i : i + size], [*known[:i], *known[i + size :]])
        for i in range(0, len(known) - size + 1, size)
    ]
    alone = [_in_common([one], [*known[:i], *known[i + 1 :]]) for i, one in enumerate(known)]
    spread = float(np.std(alone)) / max(float(np.mean(alone)), 1e-9)
    usual = float(np.mean(own)) * (1.0 - SPREAD_SIGMAS * spread)
    return min(_in_common([by_cell(twist, widths) for twist in runs], known) / max(usual, 1e-9), 1.0)


def _in_common(runs: Sequence[Samples], others: Sequence[Samples]) -> float:
    a, b = sum(runs, Samples()), sum(others, Samples())
    return sum(min(n / a.total(), b[cell] / b.total()) for cell, n in a.items())


def _words(cell: Cell, widths: Array) -> str:
    speed, turn, acceleration = float(cell[0] * widths[0]), float(cell[1] * widths[1]), cell[2]
    how = "steady" if acceleration == 0 else "speeding up" if acceleration * (cell[0] or 1) > 0 else "braking"
    where = "straight" if cell[1] == 0 else f"turning {turn:+.1f} rad/s"
    return f"{speed:.1f} m/s, {where}, {how}"
