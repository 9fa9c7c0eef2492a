"""Square-root smoothing of a chain of keyframes made of GTSAM factors.

A localisation graph is a chain: every factor touches one keyframe or two that follow each other.
Eliminating keyframes in time order by QR costs the same at every step, and only keyframes whose factors or
linearisation changed are eliminated again (the idea of iSAM2, Kaess et al. 2012, IJRR 31(2)). Old
keyframes of the fixed lag are dropped, their information stays as a prior (exact marginalisation). With
nothing dropped the chain is what `batch` solves.

Keyframe k has the state X(k) Pose3 body to world, V(k) velocity in the world (m/s), B(k) IMU bias
(accelerometer, gyro), then the linear states of `key_state.LINEAR`; the tangent has this order. Pose,
velocity and bias are GTSAM variables; the linear states live in the chain alone.
"""

import bisect
import functools
from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np
from scipy.linalg import lapack

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.graph.batch_rows import RowBlock
from terrafusion.fusion.graph.gauss_markov import MarkovStep
from terrafusion.fusion.graph.gnss_factor import GnssPosition
from terrafusion.fusion.graph.key_state import DIM, NAV, ON_DEMAND, VELOCITY, KeyState
from terrafusion.fusion.graph.keyframe_rows import carried_prior, link_rows, measured_rows, own_rows
from terrafusion.fusion.graph.node import Node
from terrafusion.fusion.graph.triangular import (
    back_substitute,
    back_substitute_before,
    covariance_before,
    eliminated,
    triangular,
)
from terrafusion.fusion.graph.variables import erase, insert, retracted, state_of, update
from terrafusion.fusion.graph.velocity_factor import GnssVelocity
from terrafusion.fusion.graph.wheel_factor import WheelIncrement

_ZERO = np.zeros(3)


class Chain:
    """Keyframes `first` ... `last`, solved by sequential QR.

    A keyframe is appended with the factors that link it to its predecessor; unary factors may be added to
    any keyframe still held. `solve` updates the newest keyframe, `smooth` the newest few. `archive` is a
    second chain that keeps all factors, for a batch solution. The states of a calibration are estimated
    only with `calibrate`; without, tangents end before them.
    """

    RELINEARISE = np.array([0.02] * 3 + [np.inf] * 6 + [0.5] * 3 + [0.05] * 3)
    """Change of a state (rad, m, m/s, m/s2, rad/s) beyond which its factors are linearised again. Position,
    velocity and the linear states enter the factors (nearly) linearly and never require it.
    """

    def __init__(self, archive: "Chain | None" = None, calibrate: bool = False) -> None:
        self.archive = archive
        self.dim = DIM if calibrate else DIM - len(ON_DEMAND)
        self.first = 0
        self.nodes: list[Node] = []
        self.values = gtsam.Values()
        self._inserted = 0  # `values` has the keyframes before this one; an archive, never solved, has none
        self._dirty = 0
        self._anchor: tuple[int, KeyState, Array] | None = None
        self._root = np.zeros((self.dim, self.dim + 1))

    @property
    def last(self) -> int:
        """Index of the newest keyframe."""
        return self.first + len(self.nodes) - 1

    def append(
        self,
        t_ns: int,
        point: KeyState,
        link: gtsam.NonlinearFactorGraph | None = None,
        markov: MarkovStep | None = None,
        wheels: WheelIncrement | None = None,
        gyro_radps: Array = _ZERO,
        accel_mps2: Array = _ZERO,
        preintegrated: bool = False,
    ) -> int:
        """Add a keyframe with its initial state and its factors to the one before; returns its index.

        `link` must touch X, V and B of both keyframes; `markov` links the linear states.
        """
        link = link if link is not None else gtsam.NonlinearFactorGraph()
        parts = link, markov, wheels, gyro_radps, accel_mps2, preintegrated
        self.nodes.append(Node(point, t_ns, np.zeros((0, self.dim + 1)), np.zeros(self.dim), *parts))
        if len(self.nodes) > 1:
            self._dirty = min(self._dirty, self.last - 1)
        if self.archive is not None:
            self.archive.append(t_ns, point, *parts)
        return self.last

    def add(self, k: int, factor: gtsam.NonlinearFactor) -> None:
        """Add a factor of GTSAM that touches keyframe k alone."""
        for node in self._changed(k):
            node.unary.add(factor)

    def add_fix(self, k: int, fix: GnssPosition) -> None:
        """Add a GNSS position to keyframe k."""
        for node in self._changed(k):
            node.fixes.append(fix)

    def add_velocity(self, k: int, velocity: GnssVelocity) -> None:
        """Add a GNSS velocity to keyframe k."""
        for node in self._changed(k):
            node.velocities.append(velocity)

    def drop_velocities(self, since_ns: int) -> None:
        """Drop the GNSS velocities of all keyframes from a time on."""
        begin = bisect.bisect_left(self.nodes, since_ns, key=lambda node: node.t_ns)
        for node in self.nodes[begin:]:
            node.velocities.clear()
        self._dirty = min(self._dirty, self.first + begin)
        if self.archive is not None:
            self.archive.drop_velocities(since_ns)

    def replace_fix(self, k: int, old: GnssPosition, new: GnssPosition) -> None:
        """Replace a GNSS position of keyframe k by one of another weight."""
        for node in self._changed(k):
            node.fixes[node.fixes.index(old)] = new

    def revise(
        self,
        k: int,
        markov: MarkovStep | None = None,
        wheels: WheelIncrement | None = None,
        link: gtsam.NonlinearFactorGraph | None = None,
    ) -> None:
        """Another Markov step, wheel increment or link into keyframe k, not the first."""
        self._changed(k - 1)  # with which the link is eliminated
        for node in self._changed(k):
            node.markov, node.wheels = markov or node.markov, wheels or node.wheels
            node.link = node.link if link is None else link

    def _changed(self, k: int) -> list[Node]:
        """Keyframe k, here and in the archive, of which a factor is about to change."""
        self._dirty = min(self._dirty, k)
        return [self.node(k), *(self.archive._changed(k) if self.archive is not None else ())]

    def node(self, k: int) -> Node:
        """Keyframe k, one of those held."""
        return self.nodes[k - self.first]

    def at_or_after(self, t_ns: int) -> int | None:
        """The first keyframe at or after a time; None when there is none, or older ones were dropped."""
        i = bisect.bisect_left(self.nodes, t_ns, key=lambda node: node.t_ns)
        if i == len(self.nodes) or (i == 0 and self.nodes[0].t_ns != t_ns):
            return None
        return self.first + i

    def state(self, k: int) -> KeyState:
        """Best state of keyframe k as of the last `solve` (newest) or `smooth` (all)."""
        return self.node(k).state()

    @functools.cached_property
    def covariance(self) -> Array:
        """Marginal covariance (dim, dim) of the newest keyframe, read-only; dropped with the root."""
        inverse, info = lapack.dtrtri(self._root[:, : self.dim])
        if info:
            raise ArithmeticError(f"keyframe {self.last} is not determined by its factors")
        covariance = np.asarray(inverse @ inverse.T)
        covariance.flags.writeable = False
        return covariance

    def covariance_at(self, k: int) -> Array:
        """Marginal covariance (dim, dim) of keyframe k, as of the last `solve` or `smooth`."""
        covariance = self.covariance
        for node in self.nodes[-2 : k - self.last - 2 : -1]:
            assert node.conditional is not None
            covariance = covariance_before(node.conditional, covariance)
        return covariance

    def solve(self, window: int) -> None:
        """Update the newest keyframe; if that moves it far, the newest `window` of them."""
        self._eliminate_all()
        if (np.abs(self.nodes[-1].delta[NAV]) > self.RELINEARISE).any():
            self.smooth(window)

    def smooth(self, window: int, iterations: int = 4) -> None:
        """Update the newest `window` keyframes; if one has moved far, linearise all held again.

        All, because a factor between a keyframe that was moved and one that was not would be linearised
        about a step that nobody took; far from the start that step is metres.
        """
        begin = max(self.last - window + 1, self.first)
        for _ in range(iterations):
            self._eliminate_all()
            solved = self._back_substitute_to(begin)
            deltas = np.abs([node.delta for node in self.nodes[begin - self.first :]])
            if not (deltas[:, NAV] > self.RELINEARISE).any():
                return
            self._back_substitute_to(self.first, solved)
            self._relinearise()
        self._eliminate_all()
        self._back_substitute_to(begin)

    def _eliminate_all(self) -> None:
        """Eliminate what changed, and solve for the newest keyframe."""
        last = self.last
        if self._dirty > last:
            return
        self._insert_new()
        for k in range(max(self._dirty, self.first), last):
            self._eliminate(k)
        node = self.nodes[-1]
        # What elimination leaves of the keyframes before is a triangle: alone it is the root itself.
        alone = len(self.nodes) > 1 and not measured_rows(node, last, self.values)
        self._root = node.prior if alone else triangular(own_rows(node, last, self.values))
        node.delta = back_substitute(self._root[:, : self.dim], self._root[:, self.dim])
        self._dirty = last + 1
        vars(self).pop("covariance", None)

    def forget(self, keep: int) -> None:
        """Drop the oldest keyframes until `keep` are left; their information stays as a prior."""
        while len(self.nodes) > keep and self._dirty > self.first:
            self._erase_before(self.first + 1)
            self.nodes.pop(0)
            self.first += 1

    def _erase_before(self, end: int) -> None:
        for k in range(self.first, min(end, self._inserted)):
            erase(self.values, k)

    def restart(
        self,
        extra_variance: Array,
        k: int | None = None,
        anew: Sequence[int] = (),
        at: KeyState | None = None,
    ) -> None:
        """Drop all before keyframe k (by default the newest); its marginal stays as prior, with
        `extra_variance` (dim,) added. Of the states `anew` only that variance stays. The newest may go on
        from another state, `at`.

        For an estimate that has proved wrong: what comes next may move it freely, and does not bend the
        past.
        """
        self._eliminate_all()
        k = self.last if k is None else k
        node = self.node(k)
        known = self._root if k == self.last else triangular(own_rows(node, k, self.values))
        inverse, _ = lapack.dtrtri(known[:, : self.dim])
        mean = inverse @ known[:, self.dim]
        stays = ~np.isin(np.arange(self.dim), anew)
        marginal = inverse @ inverse.T * np.outer(stays, stays)
        root = np.linalg.inv(np.linalg.cholesky(marginal + np.diag(extra_variance)))
        # Keyframes that follow keep their linearisation, so keyframe k must keep its own, too.
        shift = mean if k == self.last else np.zeros(self.dim)
        point, prior = at or node.point.retract(shift), np.hstack([root, (root @ (mean - shift))[:, None]])
        fresh = Node(point, node.t_ns, prior, np.zeros(self.dim))
        fresh.gyro_radps, fresh.accel_mps2 = node.gyro_radps, node.accel_mps2
        self._erase_before(k)
        self.nodes, self.first, self._dirty = [fresh, *self.nodes[k - self.first + 1 :]], k, k
        self._anchor = None
        self._publish(k)
        self._eliminate_all()

    def turn(self, yaw_rad: float, from_m: Array, to_m: Array) -> None:
        """Turn the whole window about the vertical, and shift it so that the point `from_m` comes to `to_m`.

        Motion between keyframes is the same in every frame: only the prior of the first keyframe changes.
        """
        R = gtsam.Rot3.Rz(yaw_rad).matrix()
        moved = gtsam.Pose3(gtsam.Rot3(R), to_m - R @ from_m)
        for k, node in enumerate(self.nodes, self.first):
            self._move(k)
            pose = moved.compose(node.point.pose)
            node.point = replace(node.point, pose=pose, velocity=R @ node.point.velocity)
            self._publish(k)
        self.nodes[0].prior[:, VELOCITY] = self.nodes[0].prior[:, VELOCITY] @ R.T
        self._anchor, self._dirty = None, self.first
        self._eliminate_all()

    def rebuild(self) -> None:
        """Rebuild the variables of GTSAM from the keyframes."""
        self.values, self._inserted = gtsam.Values(), self.first
        self._insert_new()

    def set_prior(self, sigmas: Array) -> None:
        """Prior of the first keyframe at its initial state, independent 1 sigmas (dim,)."""
        self._anchor = None
        self.nodes[0].prior = np.hstack([np.diag(1.0 / np.asarray(sigmas)), np.zeros((self.dim, 1))])
        self._dirty = self.first

    def _insert_new(self) -> None:
        """Insert the variables of the keyframes that GTSAM does not have yet."""
        self._inserted = max(self._inserted, self.first)
        for k, node in enumerate(self.nodes[self._inserted - self.first :], self._inserted):
            insert(self.values, k, node.point)
        self._inserted = self.last + 1

    def _carry_prior(self) -> None:
        """Move the prior of the first keyframe to its estimate.

        It cannot be linearised again: it stays a Gaussian in the coordinates `KeyState.local` about where it
        was made.
        """
        node = self.nodes[0]
        if self._anchor is None or self._anchor[0] != self.first:
            self._anchor = (self.first, node.point, node.prior)
        _, made_at, rows = self._anchor
        node.prior = carried_prior(rows, made_at.local(node.state()))

    def _move(self, k: int) -> None:
        """Make the current estimate of keyframe k its linearisation point."""
        node = self.node(k)
        if k == self.first:
            self._carry_prior()
        node.point = node.state()
        node.delta = np.zeros(self.dim)
        self._publish(k)

    def _relinearise(self) -> None:
        """Make the estimates of all keyframes held their linearisation points, and eliminate anew."""
        self._carry_prior()
        self.values = retracted(self.values, self.first, (node.delta for node in self.nodes))
        for k, node in enumerate(self.nodes, self.first):
            linear = node.point.linear.copy()
            linear[: self.dim - NAV.stop] += node.delta[NAV.stop :]
            node.point, node.delta = state_of(self.values, k, linear), np.zeros(self.dim)
        block = RowBlock(self.nodes, self.first, self.first, self.last + 1)
        rows, counts = block.rows(self.values, np.array([node.point.linear for node in self.nodes]))
        for node, after, own, count in zip(self.nodes, self.nodes[1:], rows, counts, strict=False):
            node.conditional, after.prior = eliminated(own[:count], node.prior)
        self._dirty = self.last

    def _publish(self, k: int) -> None:
        self._insert_new()
        update(self.values, k, self.node(k).point)

    def _stacked(self, k: int) -> Array:
        """Prior and all whitened rows over keyframes k and k + 1, shape (m, 2 dim + 1)."""
        node, after = self.node(k), self.node(k + 1)
        link = link_rows(node, after, k + 1, self.values)
        stacked = own_rows(node, k, self.values, len(link), width=2)
        stacked[len(stacked) - len(link) :] = link
        return stacked

    def _eliminate(self, k: int) -> None:
        R = triangular(self._stacked(k))
        self.node(k).conditional = R[: self.dim]
        self.node(k + 1).prior = R[self.dim : 2 * self.dim, self.dim :]

    def _back_substitute_to(self, begin: int, solved: int | None = None) -> int:
        """Solve for the keyframes from `begin` on, those from `solved` on (the newest) being so; `begin`."""
        solved = self.last if solved is None else solved
        nodes = self.nodes[begin - self.first : solved - self.first][::-1]
        conditionals = (node.conditional for node in nodes if node.conditional is not None)
        found = back_substitute_before(conditionals, self.node(solved).delta)
        for node, delta in zip(nodes, found, strict=True):
            node.delta = delta
        return begin
