"""The judged runs in the metric of what references predict for them.

The error of a run is e = J theta + P (phi + omega) + s + noise: theta its states, phi the robot's offsets in
all columns P, known from the references as N(m, V), omega how they scatter from run to run, N(0, Omega) (see
`other_drives`), and s the signature of what has changed. All that an inference about s needs are inner
products in the inverse of the covariance of e - s, `Metric.K`: with w the coefficients of the columns that s
is made of, its log likelihood ratio is w'K e - w'K w / 2.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.gap.infer.other_drives import RobotOffsets
from terrafusion.twin.gap.null.score import without_states
from terrafusion.twin.gap.rollout.residuals import WhitenedRun

NORMAL = 2.0  # standard deviations within which a square is no larger than expected (assumed)


@dataclass(frozen=True, eq=False)
class Products:
    """Inner products of a run's columns: states, effects and nuisance, signatures, error.

    `states` and `shared` are the numbers of the first two.
    """

    gram: Array
    states: int
    shared: int

    @classmethod
    def of(cls, run: WhitenedRun, signatures: Array) -> Self:
        """Of a run and its signatures (n, Q)."""
        return cls(run.gram_with(signatures), run.states, len(run.gram) - 1 - run.states)

    def fitted_states(self, used: Array, sigma: Array, robot: RobotOffsets) -> Array:
        """States (T,) that fit what signatures leave; `used` are coefficients of all columns but states."""
        T, P, G = self.states, self.shared, self.gram
        v = np.concatenate([-used, [1.0]])
        v[:P] -= robot.mean
        return np.asarray(np.linalg.solve(G[:T, :T] + np.diag(sigma**-2.0), G[:T, T:] @ v))


@dataclass(frozen=True, eq=False)
class Metric:
    """Inner products K (M + 1, M + 1) of the columns (effects and nuisance, signatures, error) of all runs
    together; the last row and column are zero and stand for no signature."""

    K: Array
    shared: int

    @property
    def error(self) -> int:
        """Index of the error."""
        return len(self.K) - 2

    @property
    def none(self) -> int:
        """Index of no signature."""
        return len(self.K) - 1


def metric(runs: Sequence[Products], sigma: Array, robot: RobotOffsets) -> Metric:
    """The metric of judged runs; `sigma` (T,) is that of the states."""
    P = runs[0].shared
    total = np.zeros((len(runs[0].gram) - len(sigma),) * 2)
    for run in runs:
        rest = without_states(run.gram, sigma)
        rest[:, -1] -= rest[:, :P] @ robot.mean
        rest[-1] -= robot.mean @ rest[:P]
        total += marginalise_run_offsets(rest, robot)
    total = marginalise_robot_offsets(total, robot)
    return Metric(np.pad(0.5 * (total + total.T), (0, 1)), P)


def excess(m: Metric, used: Array | None = None) -> float:
    """By how much an error is larger, along the columns of effects and nuisance, than references predict.

    Without a change its score k there is N(0, K), and k'(K + 1)^-1 k the square of the change, of typical
    sizes, that fits it; this less its mean and `NORMAL` standard deviations, at least zero.

    Args:
        used: (M + 1,) coefficients of the signatures to subtract from the error.
    """
    P, own = m.shared, np.eye(len(m.K))[m.error]
    k = m.K[:P] @ (own if used is None else own - used)
    fitted = np.linalg.solve(m.K[:P, :P] + np.eye(P), np.column_stack([k, m.K[:P, :P]]))
    share = fitted[:, 1:]
    usual = float(np.trace(share)) + NORMAL * float(np.sqrt(2.0 * (share * share.T).sum()))
    return max(float(k @ fitted[:, 0]) - usual, 0.0)


def marginalise_run_offsets(products: Array, robot: RobotOffsets) -> Array:
    """A run's inner products (M, M), whose first columns are P, with omega projected out."""
    P = len(robot.mean)
    own = np.linalg.solve(np.diag(1.0 / robot.scatter) + products[:P, :P], products[:P])
    return products - products[:, :P] @ own


def marginalise_robot_offsets(products: Array, robot: RobotOffsets) -> Array:
    """Inner products (M, M) of all runs with phi projected out."""
    P, V = len(robot.mean), robot.covariance
    own = np.linalg.solve(np.eye(P) + V @ products[:P, :P], V @ products[:P])
    return products - products[:, :P] @ own


def energies(
    run: WhitenedRun, products: Products, used: Array, left: Array, sigma: Array, robot: RobotOffsets
) -> Array:
    """Mean squared error (C,) of each channel, in white units, with signatures subtracted and the best states
    and robot offsets beside them.

    Args:
        products: of the run, or of it with channels weighted, by which states and offsets are fitted.
        used: coefficients of all columns of `products` behind those of states, effects and nuisance.
        left: (n,) error less the signatures.
    """
    T, P, G = len(sigma), products.shared, products.gram
    v = np.concatenate([np.zeros(T), -robot.mean, -used, [1.0]])
    prior = np.zeros((T + P, T + P))
    prior[:T, :T] = np.diag(sigma**-2.0)
    prior[T:, T:] = np.linalg.inv(robot.covariance + np.diag(robot.scatter))
    v[: T + P] -= np.linalg.solve(G[: T + P, : T + P] + prior, G[: T + P] @ v)
    square = (left + run.rows[:, :-1] @ v[: T + P].astype(np.float32)) ** 2
    samples = np.bincount(run.channel, minlength=len(run.limit))
    found = np.bincount(run.channel, square, len(run.limit))
    return np.maximum(found / np.maximum(samples, 1), 1e-9)
