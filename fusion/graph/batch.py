"""Gauss-Newton over a whole chain at once: what `Chain` does keyframe by keyframe, on arrays.

All factors of GTSAM are linearised in one call, the others (wheels, GNSS positions, linear states) by
array operations, and the chain is eliminated in time order by one QR per keyframe. QR, since the normal
equations of a chain with the noise of a data sheet cannot be factored in double precision (its links are
1e9 times tighter than what ties it to the world).
"""

from collections.abc import Sequence

import gtsam
import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.graph.batch_rows import RowBlock
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.key_state import KeyState
from terrafusion.fusion.graph.keyframe_rows import carried_prior
from terrafusion.fusion.graph.triangular import (
    back_substitute,
    back_substitute_before,
    eliminated,
    triangular,
)
from terrafusion.fusion.graph.variables import insert, retracted, state_of

BLOCK = 500
"""Keyframes whose rows are held at a time."""
MOST_STEPS = 30


class BatchSmoother:
    """The keyframes of a chain and their factors, solved together.

    Attributes:
        values: poses, velocities and biases of all keyframes.
        linear: (n, 15) their linear states, as `key_state.LINEAR`.
        iterations: linearisations so far.
    """

    def __init__(self, chain: Chain, initial: Sequence[KeyState] = ()) -> None:
        """`initial` states are those of the newest keyframes; the others start at their linearisation."""
        nodes = chain.nodes
        points = [*(node.point for node in nodes[: len(nodes) - len(initial)]), *initial]
        self.dim, self.first, self.size = chain.dim, chain.first, len(nodes)
        self.values = gtsam.Values()
        for k, point in enumerate(points, self.first):
            insert(self.values, k, point)
        self.linear = np.array([point.linear for point in points])
        self.iterations = 0
        self._blocks = [
            RowBlock(nodes, self.first, k, min(k + BLOCK, self.first + self.size))
            for k in range(self.first, self.first + self.size, BLOCK)
        ]
        self._made_at, self._prior = nodes[0].point, nodes[0].prior
        self._conditionals = np.zeros((self.size - 1, self.dim, 2 * self.dim + 1))
        self._root = np.zeros((self.dim, self.dim + 1))

    def optimise(self, tolerance: float = 0.1) -> int:
        """Gauss-Newton with step halving; returns the iterations taken.

        It ends with the first step shorter than `tolerance`, in sigmas of the whole solution (the root of
        the decrease of the sum of squares).
        """
        error = self.linearise()
        for taken in range(1, MOST_STEPS + 1):
            step = self._solve()
            length = self._step_length()
            scale = 1.0
            while True:
                values, linear = self._moved(scale * step)
                if length < tolerance:
                    self.values, self.linear = values, linear
                    return taken
                trial = self._linearise(values, linear)
                if trial <= error or scale < 1e-3:
                    break
                scale *= 0.5
            if trial > error:  # no step leads down: this is as far as it goes
                self.linearise()
                return taken
            self.values, self.linear, error = values, linear, trial
        return MOST_STEPS

    def states(self) -> list[KeyState]:
        """The states of all keyframes."""
        return [state_of(self.values, k, linear) for k, linear in enumerate(self.linear, self.first)]

    def covariances(self) -> Array:
        """Marginal covariances (n, dim, dim) of all keyframes, at the last linearisation."""
        n, dim = self.size, self.dim
        out = np.empty((n, dim, dim))
        inverse = np.linalg.inv(self._root[:, :dim])
        out[-1] = inverse @ inverse.T
        for end in range(n - 1, 0, -BLOCK):
            begin = max(end - BLOCK, 0)
            inverses = np.linalg.inv(np.triu(self._conditionals[begin:end, :, :dim]))
            own = inverses @ inverses.transpose(0, 2, 1)
            gains = inverses @ self._conditionals[begin:end, :, dim : 2 * dim]
            for k in range(end - 1, begin - 1, -1):
                gain = gains[k - begin]
                out[k] = own[k - begin] + gain @ out[k + 1] @ gain.T
        return out

    def linearise(self) -> float:
        """Linearise and eliminate at the present values; the sum of squares of all whitened residuals."""
        return self._linearise(self.values, self.linear)

    def _linearise(self, values: gtsam.Values, linear: Array) -> float:
        self.iterations += 1
        dim = self.dim
        poses = gtsam.utilities.extractPose3(values)
        offset = self._made_at.local(state_of(values, self.first, linear[0]))
        known = carried_prior(self._prior, offset)
        error = float(known[:, dim] @ known[:, dim])
        for block in self._blocks:
            rows, counts = block.rows(values, linear, poses)
            error += float(np.einsum("kr,kr->", rows[:, :, -1], rows[:, :, -1]))
            for i, count in enumerate(counts, block.begin - self.first):
                stacked = rows[i + self.first - block.begin, :count]
                if i == self.size - 1:
                    own = np.delete(stacked, np.s_[dim : 2 * dim], axis=1)
                    self._root = triangular(np.vstack([known, own]))
                else:
                    self._conditionals[i], known = eliminated(stacked, known)
        return error

    def _solve(self) -> Array:
        """The step (n, dim) of all keyframes."""
        dim = self.dim
        out = np.empty((self.size, dim))
        out[-1] = back_substitute(self._root[:, :dim], self._root[:, dim])
        if self.size > 1:
            out[-2::-1] = back_substitute_before(self._conditionals[::-1], out[-1])
        return out

    def _step_length(self) -> float:
        """Root of the decrease of the sum of squares by the whole step."""
        right = self._conditionals[:, :, -1]
        return float(np.sqrt(np.einsum("kr,kr->", right, right) + np.sum(self._root[:, -1] ** 2)))

    def _moved(self, step: Array) -> tuple[gtsam.Values, Array]:
        linear = self.linear.copy()
        linear[:, : self.dim - 15] += step[:, 15:]
        return retracted(self.values, self.first, step), linear
