"""What references know of the robot's own offsets, and what that means on any drive.

Ranks among runs are exact while all runs make the same kind of drive; a drive that no reference made is
always the odd one out. Here the columns of a run are random effects, phi_run ~ N(phi_robot, Omega) and
phi_robot ~ N(0, T), in typical sizes, learned from the references by expectation-maximisation (Laird and Ware
1982). For the judged drive with the information A that gives scores b ~ N(A m, A (V + Omega) A + A): what the
references know of a column travels to any drive, and what they do not know counts as unknown.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.gap.data.threads import in_threads
from terrafusion.twin.gap.null.score import Score
from terrafusion.twin.gap.rollout.nuisance import BASIS

CANDIDATE_SCATTER, NUISANCE_SCATTER, PRIOR_RUNS = 0.15, 0.05, 4.0
"""Prior 1 sigma from run to run of an effect and of a column of the nuisance basis, in their units, and its
weight in runs (set on the twin's own runs on other drives than the study's)."""
SCATTER_SCALES = (0.3, 1.0)
"""Factors of that sigma, of which the references choose the likelier: runs of one robot may be alike."""
PRIOR_COLUMNS = 8.0
"""Weight, in columns, of an offset's prior variance of one, the least. A larger one is learned, for the
effects together and for the columns of each channel: where the twin is wrong on the references' drives, it
may be as wrong on others."""
EM_STEPS, MISFIT_STEPS = 8, 3
MISFIT_SCATTER = 0.1  # prior 1 sigma from run to run of a coefficient of law misfit (assumed)
CERTAIN = 3.0  # times its variance (assumed) that the square of a column must exceed to be no noise
MATCHING_STEPS, MATCHED_PRIOR, FEWEST_MATCHED = 3, 12.0, 10
"""Steps that match the scatter to the squares of scores, the weight, in runs, of those expected (both set
with robots 105 to 128 of the study `unseen_gap` in view), and references from which: a variance that fewer
show is uncertain by half of itself."""
LEAST_SCATTER = 1e-3  # 1 sigma, in the columns' units
LEAST_VARIANCE = 1e-12  # of the score of a column that no channel shows
FEWEST = 3  # references from which a scatter can be learned


@dataclass(frozen=True, eq=False)
class RobotOffsets:
    """What the references know of the robot.

    Attributes:
        mean, covariance: (P,) and (P, P) of the columns that all its runs share.
        scatter: (P,) variance from run to run.
        prior: (P,) variance of the columns before the references.
        references: number of them.
        misfit: number of the last columns that are of the misfit of laws.
        changed: (P,) variance by which columns on the judged drives differ from those on the references'; it
            is part of the covariance.
        matched: whether the scatter is matched to the squares of the references' scores.
    """

    mean: Array
    covariance: Array
    scatter: Array
    prior: Array
    references: int
    misfit: int = 0
    changed: Array | float = 0.0
    matched: bool = False

    def known(self) -> Array:
        """(P, P) covariance on the references' drives."""
        return self.covariance - np.diag(np.broadcast_to(self.changed, len(self.mean)))

    def certain(self) -> Array:
        """(P,) the part of each column that the references show with certainty."""
        square = self.mean**2 - CERTAIN * np.diag(self.known())
        return np.asarray(np.sign(self.mean) * np.sqrt(np.maximum(square, 0.0)))

    def modest(self, references: Sequence[Score]) -> RobotOffsets:
        """What the references know with the least prior variance: columns that act alike share what they
        explain, where a wide prior lets large offsets of opposite sign cancel."""
        prior = np.ones(len(self.mean))
        mean, covariance, _ = _posterior(references, self.scatter, prior)
        return RobotOffsets(mean, covariance, self.scatter, prior, len(references))

    def left_out(self, references: Sequence[Score]) -> list[Array]:
        """Mean (P,) by all the references but each, with the same scatter and prior."""
        own, parts = 1.0 / self.scatter, list[tuple[Array, Array]]()
        for r in references:
            H = inverse(r.A + np.diag(own))
            parts.append((np.diag(own) - own[:, None] * H * own, own * (H @ r.b)))
        known, gain = np.diag(1.0 / self.prior) + sum(k for k, _ in parts), sum(g for _, g in parts)
        return [np.asarray(np.linalg.solve(known - k, gain - g)) for k, g in parts]


def learn_offsets(
    references: Sequence[Score], candidates: int, jobs: int = 1, of_twin: bool = False
) -> RobotOffsets:
    """From references; fewer than `FEWEST` show no scatter. The first `candidates` columns are of effects.

    Args:
        of_twin: these are replicates of the twin, which show nothing of how runs scatter.
    """
    first = _first_scatter(len(references[0].b), candidates)
    group = np.maximum(np.arange(len(first)) - candidates, -1) // len(BASIS)
    groups = [group == k for k in np.unique(group)]
    prior, scales = np.ones(len(first)), SCATTER_SCALES[-1:] if of_twin else SCATTER_SCALES
    found = in_threads(
        jobs, lambda scale: _learn(references, scale**2 * first, prior, EM_STEPS, groups), scales
    )
    likeliest = max(found, key=lambda o: _log_likelihood(references, o.scatter, o.prior))
    return likeliest if of_twin else _matched(references, likeliest)


def _matched(references: Sequence[Score], offsets: RobotOffsets) -> RobotOffsets:
    """With the scatter of which scores vary as those of references do that the others predict.

    Many columns act alike, and noise that is not white looks like scatter of some: by likelihood alone, their
    sum can be several times too large in a column that hardly varies. The scatter of each column is scaled
    by the mean, over all scores to which it contributes, of the square over the expected one (Richardson
    1972, JOSA 62, 55: the same for positive numbers of which sums are observed).
    """
    found = offsets
    for _ in range(MATCHING_STEPS if len(references) >= FEWEST_MATCHED else 0):
        square, shares = np.zeros(len(found.mean)), np.zeros_like(found.covariance)
        for r, mean in zip(references, found.left_out(references), strict=True):
            parts = r.A**2 * found.scatter  # of the variance of each score (P, P)
            expected = parts.sum(axis=1) + np.diag(r.A) + ((r.A @ found.covariance) * r.A).sum(axis=1)
            expected = np.maximum(expected, LEAST_VARIANCE)
            square += (r.b - r.A @ mean) ** 2 / expected
            shares += parts / expected[:, None]
        ratio, whole = (MATCHED_PRIOR + square) / (MATCHED_PRIOR + len(references)), shares.sum(axis=0)
        scale = np.divide(ratio @ shares, whole, out=np.ones(len(whole)), where=whole > LEAST_VARIANCE)
        scatter = np.maximum(scale * found.scatter, LEAST_SCATTER**2)
        mean, covariance, _ = _posterior(references, scatter, found.prior)
        found = dataclasses.replace(
            found, mean=mean, covariance=covariance, scatter=scatter, matched=True
        )  # fmt: skip
    return found


def first_offsets(references: Sequence[Score], candidates: int) -> RobotOffsets:
    """From references with the prior variances; arguments as those of `learn_offsets`."""
    scatter = _first_scatter(len(references[0].b), candidates)
    prior = np.ones(len(scatter))
    mean, covariance, _ = _posterior(references, scatter, prior)
    return RobotOffsets(mean, covariance, scatter, prior, len(references))


def _first_scatter(columns: int, candidates: int) -> Array:
    """Prior variance (P,) from run to run."""
    return np.where(np.arange(columns) < candidates, CANDIDATE_SCATTER, NUISANCE_SCATTER) ** 2


def _learn(
    references: Sequence[Score], first: Array, prior: Array, steps: int, groups: Sequence[NDArray[np.bool_]]
) -> RobotOffsets:
    """By expectation-maximisation from a scatter `first` (P,) on; the prior variance is learned for each of
    some groups of columns (P,)."""
    scatter, count, prior = first, len(references), prior.copy()
    for _ in range(steps):
        mean, covariance, square = _posterior(references, scatter, prior)
        scatter = (PRIOR_RUNS * first + square) / (PRIOR_RUNS + count)
        own = mean**2 + np.diag(covariance)
        for mine in groups:
            prior[mine] = max((PRIOR_COLUMNS + own[mine].sum()) / (PRIOR_COLUMNS + mine.sum()), 1.0)
    return RobotOffsets(mean, covariance, scatter, prior, count)


def _log_likelihood(references: Sequence[Score], scatter: Array, prior: Array) -> float:
    """Log likelihood of the references' scores with all offsets integrated out, but for a constant."""
    from scipy.linalg import solve_triangular

    known, gain = np.diag(1.0 / prior), np.zeros(len(prior))
    total = -0.5 * float(np.log(prior).sum() + len(references) * np.log(scatter).sum())
    for r in references:
        L = np.linalg.cholesky(r.A + np.diag(1.0 / scatter))
        half = solve_triangular(L, np.column_stack([r.A, r.b]), lower=True)
        moved, own = half[:, :-1], half[:, -1]
        total += 0.5 * float(own @ own) - float(np.log(np.diag(L)).sum())
        known += r.A - moved.T @ moved
        gain += r.b - moved.T @ own
    L = np.linalg.cholesky(known)
    own = np.linalg.solve(L, gain)
    return total + 0.5 * float(own @ own) - float(np.log(np.diag(L)).sum())


def learn_misfit(
    references: Sequence[Score], offsets: RobotOffsets, sigma: float, changed: Array
) -> RobotOffsets:
    """Offsets with further columns of law misfit, which all scores have behind those of `offsets`.

    Args:
        sigma: 1 sigma of their coefficients before the references.
        changed: (P,) variance by which all columns differ on the judged drives.
    """
    count = len(references[0].b) - len(offsets.mean)
    first = np.append(offsets.scatter, np.full(count, MISFIT_SCATTER**2))
    prior = np.append(offsets.prior, np.full(count, sigma**2))
    found = _matched(references, _learn(references, first, prior, MISFIT_STEPS, ()))
    covariance = found.covariance + np.diag(changed)
    return dataclasses.replace(found, covariance=covariance, misfit=count, changed=changed)


def _posterior(references: Sequence[Score], scatter: Array, prior: Array) -> tuple[Array, Array, Array]:
    """Mean (P,) and covariance (P, P) of the robot's offsets, and the sum (P,) of the expected squares of the
    runs' own."""
    own = 1.0 / scatter  # information on a run's own beforehand; with H, H A = 1 - H own
    within = [inverse(r.A + np.diag(own)) for r in references]
    known, gain = np.diag(1.0 / prior + len(references) * own), np.zeros(len(own))
    for r, H in zip(references, within, strict=True):
        known -= own[:, None] * H * own
        gain += own * (H @ r.b)
    covariance = inverse(known)
    mean, square = covariance @ gain, np.zeros(len(own))
    for r, H in zip(references, within, strict=True):
        moved = np.eye(len(own)) - H * own
        square += (H @ (r.b - r.A @ mean)) ** 2 + np.diag(H)
        square += np.einsum("ij,ij->i", moved @ covariance, moved)
    return mean, covariance, square


def inverse(matrix: Array) -> Array:
    """Of a symmetric positive definite matrix (P, P)."""
    from scipy.linalg.lapack import dpotrf, dpotri

    half, failed = dpotrf(matrix, lower=1)
    if failed:
        return np.asarray(np.linalg.inv(matrix))
    out, _ = dpotri(half, lower=1)
    lower = np.tril(out)
    return np.asarray(lower + np.tril(out, -1).T)
