"""Where the gap shows: cells of channel, regime and band in which the judged runs err more than the
references.

A cell's share is its part of the excess of squared errors. Its p-value holds for all cells together: the
greatest standardised excess over all cells, among replicates of the judged drives (max-T, Westfall and Young
1993). In a replicate the mean square of a cell scatters as that of references does, each judged by what the
others show of the robot. It is larger, never smaller, by how much more its scatter and what is unknown of the
robot show than on their drives.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.gap.answer.cells import BANDS, REGIMES, RunCells
from terrafusion.twin.gap.data.samples import Indices
from terrafusion.twin.gap.infer.detection import drawn_robots, drawn_scatter
from terrafusion.twin.gap.infer.other_drives import RobotOffsets
from terrafusion.twin.gap.null.evidence import GapEvidence
from terrafusion.twin.gap.null.loud_noise import LOUD
from terrafusion.twin.gap.null.score import score
from terrafusion.twin.gap.rollout.nuisance import CHANNEL_NAMES
from terrafusion.twin.gap.rollout.residuals import WhitenedRun, physical_error

LEAST_SAMPLES = 5  # effective, of all runs together, from which a cell is listed (assumed)
REPLICATES, ROBOTS = 3999, 200  # of the judged drives, and robots drawn for these
LEAST_REFERENCES = 2  # fewer have no scatter from run to run
SPREAD_RUNS = 8.0  # weight, in runs, of the variance that the cells of a band have on average (assumed)
SCATTER_RUNS, SCATTER_DRAWS = 3, 20  # references, and draws each, that show the squares due to both
LEAST_NOISE = 0.25  # least share of the references' mean squares that is noise (assumed)
UNSEEN = math.log(LOUD)
"""1 sigma of the log mean square in a regime that no reference drove: up to so much louder, no noise is taken
to be louder."""


@dataclass(frozen=True)
class GapCell:
    """One cell of the gap map.

    Attributes:
        channel, regime, band: its place.
        share: of the excess of squared errors over the references'.
        p_value: of that excess, for all cells together.
        error, reference: root mean square of the judged runs' errors and of the references', in the channel's
            unit (`CHANNEL_UNITS`).
        sigmas: the same of the judged runs, in sigmas of the noise.
    """

    channel: str
    regime: str
    band: str
    share: float
    p_value: float
    error: float
    reference: float
    sigmas: float


def gap_map(
    evidence: GapEvidence, sigma: Array, robot: RobotOffsets, significance: float, seed: int
) -> list[GapCell]:
    """All cells with enough samples, significant ones first, by share; none below `LEAST_REFERENCES`."""
    runs, R = [*evidence.runs, *evidence.references], len(evidence.runs)
    if len(evidence.references) < LEAST_REFERENCES:
        return []
    names = list(dict.fromkeys(CHANNEL_NAMES[c] for c in evidence.channels))
    cells = [RunCells.of(run, evidence.model, names) for run in runs]
    errors = out_of_sample(evidence.runs, evidence.references, sigma, robot)
    square = np.array([c.squares(e[:, None])[:, 0] for c, e in zip(cells, errors, strict=True)])
    count, samples = np.array([c.count for c in cells]), np.array([c.samples for c in cells])
    kept = np.flatnonzero((count[:R].min(axis=0) >= 1.0) & (count.sum(axis=0) >= LEAST_SAMPLES))
    if not len(kept):
        return []
    p_values = _p_values(evidence, sigma, robot, cells, square, kept, np.random.default_rng(seed))
    own, size = square[:R].sum(axis=0), count[:R].sum(axis=0)
    floor = square[R:].sum(axis=0) / np.maximum(count[R:].sum(axis=0), 1e-9)
    over = np.maximum(own - floor * size, 0.0)
    share, sigmas = over / max(float(over[kept].sum()), 1e-12), np.sqrt(own / np.maximum(size, 1e-9))
    physical = [physical_error(run, evidence.noise, e) for run, e in zip(runs, errors, strict=True)]
    sums = np.array([c.squares(e[:, None])[:, 0] for c, e in zip(cells, physical, strict=True)])
    judged, normal = (
        np.sqrt(sums[some].sum(axis=0) / np.maximum(samples[some].sum(axis=0), 1.0))
        for some in (slice(R), slice(R, None))
    )
    found = [
        GapCell(
            names[place], REGIMES[regime][0], BANDS[band], float(share[i]), float(p),
            float(judged[i]), float(normal[i]), float(sigmas[i]),
        )
        for i, p in zip(kept, p_values, strict=True)
        for place, regime, band in [np.unravel_index(i, (len(names), len(REGIMES), len(BANDS)))]
    ]  # fmt: skip
    return sorted(found, key=lambda c: (c.p_value > significance, -c.share, c.channel, c.regime, c.band))


def out_of_sample(
    runs: Sequence[WhitenedRun], references: Sequence[WhitenedRun], sigma: Array, robot: RobotOffsets
) -> list[Array]:
    """Errors (n,) of judged runs and references less states and offsets, those that the other runs show."""
    means = [robot.mean] * len(runs) + robot.left_out([score(run, sigma) for run in references])
    every = zip([*runs, *references], means, strict=True)
    return [run.without_states(sigma, run.error - run.by_parameter @ mean) for run, mean in every]


def _p_values(
    evidence: GapEvidence, sigma: Array, robot: RobotOffsets, cells: Sequence[RunCells], square: Array,
    kept: Indices, rng: np.random.Generator,
) -> Array:  # fmt: skip
    """Of the cells `kept` (K,), by the sums of squares (R, cells) of judged runs and references."""
    J = len(evidence.runs)
    count = np.array([c.count for c in cells])
    # Where a reference has no sample in a regime, it counts as in all regimes together.
    by_regime = [x.reshape(len(x), -1, len(REGIMES), len(BANDS)) for x in (square, count)]
    whole = [np.repeat(x.sum(axis=2, keepdims=True), len(REGIMES), axis=2) for x in by_regime]
    square, samples = (
        np.where(count < 1.0, a.reshape(count.shape), b) for a, b in zip(whole, (square, count), strict=True)
    )
    log = np.log((square + 1.0) / (samples + 1.0))[:, kept]
    normal, R, size = log[J:].mean(axis=0), len(log) - J, (REPLICATES, len(kept))
    # Each cell's spread is known from R runs and, a little, from that of its band (Smyth 2004).
    squares, bands = log[J:].var(axis=0) * R, kept % len(BANDS)
    for band in np.unique(bands):
        squares[bands == band] += SPREAD_RUNS * squares[bands == band].mean() / (R - 1.0)
    sd = np.sqrt(squares / rng.chisquare(R - 1.0 + SPREAD_RUNS, size))
    unseen = UNSEEN * (count[J:, kept].max(axis=0) < 1.0) * rng.standard_normal(size)
    drawn = -sd * rng.standard_normal(size) / np.sqrt(R)  # of the references' mean

    def scattered(runs: Sequence[WhitenedRun], of: Sequence[RunCells]) -> list[Array]:
        draws = drawn_scatter(robot, len(runs), SCATTER_DRAWS, rng)
        every = zip(runs, of, draws, strict=True)
        return [_moved(run, own, d, sigma)[:, kept].mean(axis=0) for run, own, d in every]

    some, there = slice(SCATTER_RUNS), dataclasses.replace(robot, covariance=robot.known(), changed=0.0)
    usual = np.mean(scattered(evidence.references[some], cells[J:][some]), axis=0)
    offsets = drawn_robots(there, SCATTER_DRAWS, rng)
    for run, of in zip(evidence.references[some], cells[J:][some], strict=True):
        usual += _moved(run, of, offsets, sigma)[:, kept].mean(axis=0) / len(evidence.references[some])
    noise = np.maximum(np.exp(normal) - usual, LEAST_NOISE * np.exp(normal))
    offsets, scatter = drawn_robots(robot, ROBOTS, rng), scattered(evidence.runs, cells[:J])
    which = rng.integers(ROBOTS, size=REPLICATES)
    for run, of, own in zip(evidence.runs, cells[:J], scatter, strict=True):
        unknown = _moved(run, of, offsets, sigma)[:, kept]
        larger = np.log((noise + np.maximum(own + unknown, usual)) / (noise + usual))
        drawn += (larger[which] + unseen + sd * rng.standard_normal(size)) / J
    excess = log[:J].mean(axis=0) - normal
    middle, high = np.quantile(drawn, [0.5, 0.95], axis=0)
    least = (excess - middle) / (high - middle)
    tops = ((drawn - middle) / (high - middle)).max(axis=1)
    return np.array([(1.0 + np.count_nonzero(tops >= x)) / (1.0 + len(tops)) for x in least])


def _moved(run: WhitenedRun, cells: RunCells, offsets: Array, sigma: Array) -> Array:
    """Mean squares (N, cells) of what offsets (N, P) do to a run."""
    moved = run.rows[:, run.states : -1] @ offsets.T.astype(np.float32)
    return cells.squares(run.without_states(sigma, moved.astype(float))).T / (cells.count + 1.0)
