"""How far a run's states (soil, turn-on offsets, current gains) scatter from run to run.

The robot's own offsets in all columns are fitted beside the states: an offset that acts in proportion to what
a run drives, as that of a wrong turning law, would else pass for a state that scatters.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.gap.infer.other_drives import RobotOffsets, first_offsets
from terrafusion.twin.gap.infer.predictive import marginalise_robot_offsets
from terrafusion.twin.gap.null.score import score
from terrafusion.twin.gap.rollout.residuals import WhitenedRun

EM_STEPS = 6
PRIOR_RUNS = 3.0  # weight of the assumed variance of a state, in runs (assumed)
REFUTED = 0.05  # chance of states as alike below which a data sheet's 1 sigma is too large for this robot
LEAST_SIGMA = 0.03  # least 1 sigma of a state, as a share of its unit (assumed)


def learn_state_sigma(references: Sequence[WhitenedRun], first: Array, sheet: Array | None = None) -> Array:
    """1 sigma (T,) of the states about their mean over the references, by expectation-maximisation (Dempster,
    Laird and Rubin 1977) from the first 1 sigma (T,) on, which fewer than two references leave as it is.

    A larger one of the data sheet (T,) holds until the references refute it: three may be alike by chance.
    """
    sigma, count = first.copy(), len(references)
    if count < 2:
        return sigma
    rests = _rests(references, first)
    for _ in range(EM_STEPS):
        variance = (PRIOR_RUNS * first**2 + _observed(rests, sigma)) / (PRIOR_RUNS + count - 1)
        sigma = np.maximum(np.sqrt(variance), LEAST_SIGMA * first)
    if sheet is None or not (sheet > first).any():
        return sigma
    from scipy.special import chdtr

    square = _observed(_rests(references, sheet), sheet) / sheet**2
    holds = (sheet > first) & (chdtr(count - 1, square) >= REFUTED)
    return np.asarray(np.where(holds, np.maximum(sigma, sheet), sigma))


def _rests(references: Sequence[WhitenedRun], sigma: Array) -> list[Array]:
    """Of each run (T + 1, T + 1), with the robot's offsets beside states of so many sigma (T,)."""
    robot = first_offsets([score(run, sigma) for run in references], references[0].residuals.effects)
    return [_without_offsets(run, robot) for run in references]


def _observed(rests: Sequence[Array], sigma: Array) -> Array:
    """Expected sum (T,) of the squares of states, of so many sigma (T,), about their mean."""
    count = len(rests)
    spread = [np.linalg.inv(rest[:-1, :-1] + np.diag(sigma**-2.0)) for rest in rests]
    means = np.array([H @ rest[:-1, -1] for H, rest in zip(spread, rests, strict=True)])
    return np.asarray(
        np.square(means - means.mean(axis=0)).sum(axis=0)
        + (count - 1) / count * np.sum([np.diag(H) for H in spread], axis=0)
    )


def _without_offsets(run: WhitenedRun, robot: RobotOffsets) -> Array:
    """Inner products (T + 1, T + 1) of a run's states and error with all other columns projected out, as far
    as the robot's offsets and their scatter go."""
    T, P = run.states, len(robot.mean)
    order = np.r_[T : T + P, :T, T + P]
    products = run.gram[np.ix_(order, order)]
    products[:, -1] -= products[:, :P] @ robot.mean
    products[-1] -= robot.mean @ products[:P]
    own = dataclasses.replace(robot, covariance=robot.covariance + np.diag(robot.scatter))
    return marginalise_robot_offsets(products, own)[P:, P:]
