"""Ground that varies more along the path than the noise of the references holds.

Where the ground is patchier, wheels, gyro and fixes err together, metre by metre. Judged by the references'
noise that would be a gap. The variance of the patches is estimated in each run beside effects of any size; a
judged run on patchier ground is whitened with what it has above the references together, whose noise and
scatter hold the rest.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.gap.data.samples import Indices
from terrafusion.twin.gap.data.threads import in_threads
from terrafusion.twin.gap.null.channel_noise import ANY_SIZE
from terrafusion.twin.gap.rollout.residuals import RunResiduals, WhitenedRun, whitened_columns
from terrafusion.twin.gap.rollout.shared_errors import ChannelNoise

FACTORS = np.append(0.0, np.geomspace(0.05, 3.0, 35))
"""1 sigma of patches that are tried, in that of `PATCH_SIGMAS`. No ground varies as much as the last: where
that fits best, something else is the cause."""
LEAST_VALUE = 1e-3  # information on a combination of patches from which it counts
LEAST_RATIO, LEAST_FACTOR = 1.2, 0.1
"""Of a judged run's factor over the largest of the references, at least the second, from which its ground
counts as patchier."""
PATCHIER = (
    "the ground of these runs varies more along the path than that of the references, about {:.1f} times: "
    "effects of the ground are less certain. References of this site would show them better"
)


def with_patches(
    runs: Sequence[RunResiduals],
    white: Sequence[WhitenedRun],
    references: int,
    noise: ChannelNoise,
    sigma: Array,
    jobs: int = 1,
) -> tuple[list[WhitenedRun], Array]:
    """Judged runs whitened with the patches of their ground as well, references as they are; and the factor
    (R,) of 1 sigma of the patches of each run.

    Args:
        white: the runs without patches.
        references: number of the last runs that are references.
        sigma: (T,) first 1 sigma of the states.
    """
    count = len(runs) - references
    if not references:
        return list(white), np.zeros(count)
    parts = in_threads(jobs, lambda run, w: _by_window(run, w, noise), runs, white)
    likelihood = np.array(in_threads(jobs, lambda own, w: _log_likelihood(own, w, sigma), parts, white))
    best = likelihood.argmax(axis=1)
    factors = np.where(best < len(FACTORS) - 1, FACTORS[best], 0.0)
    usual = FACTORS[likelihood[count:].sum(axis=0).argmax()]
    more = np.sqrt(np.maximum(factors[:count] ** 2 - usual**2, 0.0))
    more[factors[:count] < _limit(factors[count:])] = 0.0
    return [*in_threads(jobs, _patched, white[:count], parts, more), *white[count:]], factors


def _by_window(run: RunResiduals, white: WhitenedRun, noise: ChannelNoise) -> list[tuple[Indices, Array]]:
    """Samples of each window, and the whitened columns (n, D) of its patches without the poses."""
    columns, out = white.without_poses(whitened_columns(run.log, noise, run.by_patch)), []
    for k in np.unique(white.window):
        mine = np.flatnonzero(white.window == k)
        out.append((mine, columns[mine][:, columns[mine].any(axis=0)]))
    return out


def _log_likelihood(parts: Sequence[tuple[Indices, Array]], white: WhitenedRun, sigma: Array) -> Array:
    """Of each of `FACTORS` but for a constant, beside states, effects and functions of the commands."""
    from scipy.linalg import block_diag

    rows = white.rows.astype(float)
    cross = np.vstack([own.T @ rows[mine] for mine, own in parts])
    inner = block_diag(*(own.T @ own for _, own in parts))
    prior = np.append(sigma**-2.0, np.full(len(white.gram) - 1 - white.states, ANY_SIZE**-2.0))
    known, B = white.gram[:-1, :-1] + np.diag(prior), cross[:, :-1]
    solved = np.linalg.solve(known, np.column_stack([B.T, white.gram[:-1, -1]]))
    values, vectors = np.linalg.eigh(inner - B @ solved[:, :-1])
    score = vectors.T @ (cross[:, -1] - B @ solved[:, -1])
    seen = values > LEAST_VALUE
    grown = 1.0 + FACTORS[:, None] ** 2 * values[seen]
    return np.asarray(-0.5 * (np.log(grown) + score[seen] ** 2 / values[seen] / grown).sum(axis=1))


def _patched(white: WhitenedRun, parts: Sequence[tuple[Indices, Array]], factor: float) -> WhitenedRun:
    """The run, white given patches of the factor."""
    if factor == 0.0:
        return white
    basis = np.zeros((len(white.window), max(own.shape[1] for _, own in parts)))
    for mine, own in parts:
        left, size, _ = np.linalg.svd(factor * own, full_matrices=False)
        basis[mine, : len(size)] = left * np.sqrt(1.0 - 1.0 / np.sqrt(1.0 + size**2))
    patched = dataclasses.replace(white, patch_basis=basis)
    rows = patched.without_patches(white.rows.astype(float))
    return dataclasses.replace(patched, rows=rows.astype(np.float32), gram=rows.T @ rows)


def patchier(factors: Array, references: int) -> float | None:
    """How many times as much as the references' the ground of the judged runs varies, by the factors of all;
    None unless it does so in each, and more than in any reference."""
    judged, normal = np.split(factors, [len(factors) - references])
    if not references or judged.min() < _limit(normal):
        return None
    return float(judged.mean() / max(normal.mean(), LEAST_FACTOR))


def _limit(normal: Array) -> float:
    """Factor from which ground is patchier than on the references, whose factors are `normal`."""
    return float(LEAST_RATIO * max(normal.max(), LEAST_FACTOR))
