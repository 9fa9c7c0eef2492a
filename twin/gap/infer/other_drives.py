"""Is there a gap: whether the judged drives are unusual for the robot that the references show.

Ranks among runs are exact while all runs make the same kind of drive; a drive that no reference made is
always the odd one out. Here the columns of a run are random effects, phi_run ~ N(phi_robot, Omega) and
phi_robot ~ N(0, T), in typical sizes, learned from the references by expectation-maximisation (Laird and Ware
1982). For the judged drive with the information A that gives scores b ~ N(A m, A (V + Omega) A + A): what the
references know of a column travels to any drive, and what they do not know counts as unknown. Replicates of
the judged drive have the same distribution, and the p-value is the rank among them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.null.score import Score
from terrafusion.twin.gap.rollout.nuisance import BASIS

CANDIDATE_SCATTER, NUISANCE_SCATTER, PRIOR_RUNS = 0.15, 0.05, 4.0
"""Prior 1 sigma from run to run of an effect and of a column of the nuisance basis, in their units, and its
weight in runs (set on the twin's own runs on other drives than the study's)."""
PRIOR_COLUMNS = 8.0
"""Weight, in columns, of an offset's prior variance of one, the least. A larger one is learned, for the
effects together and for the columns of each channel: where the twin is wrong on the references' drives, it
may be as wrong on others."""
EM_STEPS, MISFIT_STEPS = 8, 3
MISFIT_SCATTER = 0.1  # prior 1 sigma from run to run of a coefficient of law misfit
MISFIT_FREEDOM = (
    4  # degrees of freedom of the scale of the misfit on other drives, which no reference shows (assumed)
)
JITTER = 0.02  # variance added to a standardised score: no combination of scores is taken as exact
WIDE, UNKNOWN_SIZES = 10.0, (0.3, 1.0, 3.0, 10.0)  # 1 sigma of an effect's size, and of an unknown cause's
TAIL_FREEDOM = 10  # degrees of freedom of the tail of the statistic: heavier than normal (assumed)
FEWEST = 3  # references from which a scatter can be learned
REPLICATES = 1000
LEAST_SQUARE = 1.5  # least typical square of a deviation


@dataclass(frozen=True, eq=False)
class RobotOffsets:
    """What the references know of the robot.

    Attributes:
        mean, covariance: (P,) and (P, P) of the columns that all its runs share.
        scatter: (P,) variance from run to run.
        prior: (P,) variance of the columns before the references.
        references: number of them.
        misfit: number of the last columns that are of the misfit of laws.
        changed: variance by which their coefficients on the judged drives differ from those on the
            references'.
    """

    mean: Array
    covariance: Array
    scatter: Array
    prior: Array
    references: int
    misfit: int = 0
    changed: float = 0.0

    def of(self, references: Sequence[Score]) -> RobotOffsets:
        """What some references know, with the same scatter and prior."""
        mean, covariance, _ = _posterior(references, self.scatter, self.prior)
        return RobotOffsets(mean, covariance, self.scatter, self.prior, len(references), self.misfit)


def learn_offsets(references: Sequence[Score], candidates: int) -> RobotOffsets:
    """From at least `FEWEST` references; the first `candidates` columns are those of effects."""
    P, count = len(references[0].b), len(references)
    first = np.where(np.arange(P) < candidates, CANDIDATE_SCATTER, NUISANCE_SCATTER) ** 2
    group = np.maximum(np.arange(P) - candidates, -1) // len(BASIS)
    scatter, prior = first, np.ones(P)
    mean, covariance = np.zeros(P), np.eye(P)
    for _ in range(EM_STEPS):
        mean, covariance, square = _posterior(references, scatter, prior)
        scatter = (PRIOR_RUNS * first + square) / (PRIOR_RUNS + count)
        own = mean**2 + np.diag(covariance)
        prior = prior.copy()
        for k in np.unique(group):
            mine = group == k
            prior[mine] = max((PRIOR_COLUMNS + own[mine].sum()) / (PRIOR_COLUMNS + mine.sum()), 1.0)
    return RobotOffsets(mean, covariance, scatter, prior, count)


def learn_misfit(
    references: Sequence[Score], offsets: RobotOffsets, sigma: float, changed: float
) -> RobotOffsets:
    """Offsets with further columns of law misfit, which all scores have behind those of `offsets`.

    Args:
        sigma: 1 sigma of their coefficients before the references.
        changed: variance by which they differ on the judged drives.
    """
    count = len(references[0].b) - len(offsets.mean)
    first = np.append(offsets.scatter, np.full(count, MISFIT_SCATTER**2))
    prior, scatter = np.append(offsets.prior, np.full(count, sigma**2)), first
    mean, covariance = np.zeros(len(first)), np.eye(len(first))
    for _ in range(MISFIT_STEPS):
        mean, covariance, square = _posterior(references, scatter, prior)
        scatter = (PRIOR_RUNS * first + square) / (PRIOR_RUNS + len(references))
    covariance = covariance + np.diag(np.append(np.zeros(len(offsets.mean)), np.full(count, changed)))
    return RobotOffsets(mean, covariance, scatter, prior, len(references), count, changed)


def _posterior(references: Sequence[Score], scatter: Array, prior: Array) -> tuple[Array, Array, Array]:
    """Mean (P,) and covariance (P, P) of the robot's offsets, and the sum (P,) of the expected squares of the
    runs' own."""
    within = [np.linalg.inv(r.A + np.diag(1.0 / scatter)) for r in references]
    moved = [H @ r.A for r, H in zip(references, within, strict=True)]
    known = np.diag(1.0 / prior) + sum(r.A - r.A @ m for r, m in zip(references, moved, strict=True))
    gain = np.sum([r.b - m.T @ r.b for r, m in zip(references, moved, strict=True)], axis=0)
    covariance: Array = np.asarray(np.linalg.inv(known))
    mean, square = covariance @ gain, np.zeros(len(scatter))
    for r, H, m in zip(references, within, moved, strict=True):
        own = H @ (r.b - r.A @ mean)
        square += own**2 + np.diag(H) + np.einsum("ij,ij->i", m @ covariance, m)
    return mean, covariance, square


@dataclass(frozen=True)
class Detection:
    """Result of the test: the greatest deviation of any effect, in units of its typical value in replicates,
    and its p-value."""

    statistic: float
    p_value: float


def detect(runs: Sequence[Score], offsets: RobotOffsets, candidates: Candidates, seed: int) -> Detection:
    """How unusual the judged runs are, taken together, among replicates of them.

    Beyond all replicates the p-value is extrapolated: the logarithm of the statistic as Student's t.
    """
    from scipy.special import stdtr

    A = np.sum([r.A for r in runs], axis=0)
    spread = A @ offsets.covariance @ A + A + sum((r.A * offsets.scatter) @ r.A for r in runs)
    own = len(A) - offsets.misfit  # no law misfit is a finding
    squares = _deviations(A[:own, :own], spread[:own, :own], candidates)
    others = squares(_replicates(runs, A, offsets, np.random.default_rng(seed))[:, :own])
    typical = np.maximum(others.mean(axis=0), LEAST_SQUARE)
    greatest = (others / typical).max(axis=1)
    pooled = np.sum([r.b for r in runs], axis=0) - A @ offsets.mean
    found = (squares(pooled[None, :own]) / typical).max()
    p_value = float((1 + np.count_nonzero(greatest >= found)) / (1 + len(greatest)))
    if found > greatest.max():
        others = np.log(greatest)
        z = (math.log(found) - others.mean()) / others.std()
        p_value = min(p_value, float(stdtr(TAIL_FREEDOM, -z)))
    return Detection(math.sqrt(float(found)), p_value)


def _replicates(runs: Sequence[Score], A: Array, offsets: RobotOffsets, rng: np.random.Generator) -> Array:
    """Pooled scores (R, P) less their mean; the scatter from run to run is itself known from few runs."""
    P, size = len(A), (REPLICATES, len(A))
    known = offsets.covariance + 1e-12 * np.eye(P)
    known[np.diag_indices(P)] -= np.append(
        np.zeros(P - offsets.misfit), np.full(offsets.misfit, offsets.changed)
    )
    robot = rng.standard_normal(size) @ np.linalg.cholesky(known).T
    if offsets.changed > 0.0:
        scale = np.sqrt(offsets.changed * MISFIT_FREEDOM / rng.chisquare(MISFIT_FREEDOM, (REPLICATES, 1)))
        robot[:, P - offsets.misfit :] += scale * rng.standard_normal((REPLICATES, offsets.misfit))
    values, vectors = np.linalg.eigh(A)
    noise = rng.standard_normal(size) @ (vectors * np.sqrt(np.maximum(values, 0.0))).T
    freedom = float(offsets.references)
    wider = np.sqrt(freedom / rng.chisquare(freedom, (REPLICATES, 1)) * offsets.scatter)
    return robot @ A + noise + sum((wider * rng.standard_normal(size)) @ r.A for r in runs)


def _deviations(A: Array, spread: Array, candidates: Candidates) -> Callable[[Array], Array]:
    """Squares (R, D) of deviations of scores (R, P): of each column by its own score, of each form jointly
    with all others, and twice the log Bayes factor of an unknown cause."""
    root = 1.0 / np.sqrt(np.diag(A) + 1.0)
    covariance = root[:, None] * spread * root + JITTER * np.eye(len(A))
    U = root[:, None] * A
    weighted = np.linalg.solve(covariance, U)
    information = U.T @ weighted
    forms = [list(h.columns) for h in candidates.hypotheses]
    inner = [np.linalg.inv(information[np.ix_(c, c)] + np.eye(len(c)) / WIDE**2) for c in forms]
    nuisance = slice(len(candidates.keys), len(A))
    values, vectors = np.linalg.eigh(information[nuisance, nuisance])
    sizes = np.square(UNKNOWN_SIZES)[:, None, None]
    grown = 1.0 + sizes * np.maximum(values, 0.0)

    def squares(scores: Array) -> Array:
        x = scores * root
        gain = x @ weighted
        own = x**2 / np.diag(covariance)
        joint = [((gain[:, c] @ H) * gain[:, c]).sum(axis=1) for c, H in zip(forms, inner, strict=True)]
        turned = gain[:, nuisance] @ vectors
        each = 0.5 * (sizes * turned**2 / grown - np.log(grown)).sum(axis=2)
        unknown = 2.0 * (np.logaddexp.reduce(each, axis=0) - np.log(len(each)))
        return np.maximum(np.column_stack([own, *joint, unknown]), 0.0)

    return squares
