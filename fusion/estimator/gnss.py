"""GNSS fixes on their way into the chain: timing, gates, weights."""

import dataclasses
import math
from collections import deque
from collections.abc import Callable

import numpy as np
from scipy.special import gammaincinv

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimate.antenna import AntennaPlaces
from terrafusion.fusion.estimate.estimate import Innovation, State
from terrafusion.fusion.estimator.alignment import KnownStart
from terrafusion.fusion.estimator.dead_reckoning import DeadReckoning, FixPair
from terrafusion.fusion.estimator.drift_watch import LEAST_SHARE
from terrafusion.fusion.estimator.fix_keyframe import AntennaMotion, keyframe_of
from terrafusion.fusion.estimator.fix_noise import OPTIMISTIC_SCATTER, FixNoise
from terrafusion.fusion.estimator.fix_prediction import PredictedFix, cut_past, without_height
from terrafusion.fusion.estimator.fix_velocity import FixVelocities
from terrafusion.fusion.estimator.gates import GateDecision, GnssGate, normalised_square
from terrafusion.fusion.estimator.map_alignment import MapAlignment, align_to_map, turn_window
from terrafusion.fusion.estimator.place_doubt import OpenHeading, rounded
from terrafusion.fusion.estimator.plausibility import BEYOND, FixPlausibility
from terrafusion.fusion.estimator.skid import SkidDetector
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.gnss_factor import GnssPosition
from terrafusion.fusion.graph.key_state import BIAS, DRIFT, SLIP, VELOCITY
from terrafusion.fusion.inputs.sample_stream import MOST_WAITING
from terrafusion.fusion.inputs.validation import GnssFix
from terrafusion.fusion.noise.policy import SensorNoise
from terrafusion.fusion.weighting.weighting import Weighting

OUTAGE_S = 2.0
UNUSED_WEIGHT = 0.01
"""A fix of which a robust loss leaves less does not end an outage."""
DOUBTFUL_YAW_SIGMA_RAD = 0.2
"""Heading sigma after the heading was corrected from the motion (assumed)."""
REPEATED_WITHIN = 8
"""Last fixes among which a new one may be a copy: of two drivers, or of a topic that is forwarded twice."""
VELOCITY_SIGMA_MPS = 0.3
"""Velocity sigma after the fixes used turned out to be far less accurate than reported (assumed)."""


class GnssUpdater:
    """Holds fixes until a keyframe has passed them, gates position and height separately and adds their
    factors.

    Attributes:
        waiting: fixes not yet used, oldest first.
        local: the graph was started without GNSS, or with an `open_heading` at a known place, and is not yet
            aligned with the map.
        alignment: with the map, once known; unaligned: how many fixes came until then.
        velocities: their velocities.
        rejected, too_late: how many fixes the gate rejected, or came after their keyframe was dropped.
        turned: how often the heading was corrected from the motion.
        fix_noise: of the fixes, as they show it.
        last_used_ns: time of the newest fix in the graph.
    """

    def __init__(
        self,
        config: EstimatorConfig,
        report: Callable[[Innovation], None],
        weighting: Weighting,
        skid: SkidDetector,
    ) -> None:
        self.weighting, self.skid = weighting, skid
        self.antenna_m = np.array(config.rig.sensors.gnss.antenna_m)
        self.nominal_antenna_m = self.antenna_m.copy()
        self.antenna_places = AntennaPlaces.fixed(tuple(self.antenna_m.tolist()))
        self.delay_s = 0.0
        # Quantiles of chi-square, without scipy.stats: its import takes half a second.
        self.gate = GnssGate(2.0 * float(gammaincinv(1.0, config.gnss_gate)))
        self.height_gate = GnssGate(2.0 * float(gammaincinv(0.5, config.gnss_gate)))
        self.fix_noise = FixNoise(config.rig.sensors.gnss)
        self.track = DeadReckoning(self.antenna_m)
        self.turned, self._applied_scale = 0, 1.0
        self._bias_sigma = config.rig.sensors.imu.bias_sigma
        self.waiting: list[GnssFix] = []
        self._recent = deque[tuple[int, float, float]](maxlen=REPEATED_WITHIN)
        self.local = False
        self.open_heading: OpenHeading | None = None
        self.alignment: MapAlignment | None = None
        self._local_fixes: list[GnssFix] = []
        self.unaligned = 0
        self.rejected = 0
        self.too_late = 0
        self.last_used_ns: int | None = None
        self._unchecked: GnssFix | None = None
        self._pair: FixPair | None = None
        self.velocities = FixVelocities()
        self.plausible = FixPlausibility()
        self._report = report
        self._seen, self._share = 0, 0.0

    def queue(self, fix: GnssFix) -> None:
        """Take a fix in, in any order of time; one that came already is left out."""
        east_m, north_m, _ = fix.enu_m.tolist()
        same = fix.t_ns, east_m, north_m
        if same in self._recent:
            return
        self._recent.append(same)
        if self.delay_s:
            fix = dataclasses.replace(fix, t_ns=fix.t_ns - round(self.delay_s * 1e9))
        fix = self.fix_noise.believable(fix)
        self.waiting.append(fix)
        if len(self.waiting) > 1 and fix.t_ns < self.waiting[-2].t_ns:
            self.waiting.sort(key=lambda f: f.t_ns)
        if len(self.waiting) > MOST_WAITING:
            del self.waiting[0]
            self.too_late += 1

    def correct(self, t_ns: int, antenna_m: Array, delay_s: float) -> None:
        """Correct the lever arm, body x and y (2,), from `t_ns` on, and the lateness of the stamps."""
        self.antenna_m = self.nominal_antenna_m + np.append(antenna_m, 0.0)
        late_ns = round(delay_s * 1e9)
        self.antenna_places = self.antenna_places.then(t_ns, tuple(self.antenna_m.tolist()), late_ns)
        self.track.lever = complex(self.antenna_m[0], self.antenna_m[1])
        earlier_ns, self.delay_s = late_ns - round(self.delay_s * 1e9), delay_s
        self.waiting = [dataclasses.replace(fix, t_ns=fix.t_ns - earlier_ns) for fix in self.waiting]

    def refuse_waiting(self, fitting: list[GnssFix]) -> None:
        """Drop waiting fixes that do not fit those that have given the start."""
        kept = {id(fix) for fix in fitting}
        before = len(self.waiting)
        self.waiting = [fix for fix in self.waiting if id(fix) in kept]
        self.rejected += before - len(self.waiting)

    def forget(self, before_ns: int) -> None:
        """Drop waiting fixes from before a time: no keyframe will hold them."""
        held = [fix for fix in self.waiting if fix.t_ns >= before_ns]
        self.too_late += len(self.waiting) - len(held)
        self.waiting = held

    def have_new(self) -> bool:
        """Whether fixes came since the last call."""
        changed = len(self.waiting) != self._seen
        self._seen = len(self.waiting)
        return changed

    def is_outage(self, t_ns: int) -> bool:
        """Whether no fix has come for long; one that comes late is as old as its delay."""
        used_ns = self.last_used_ns
        return used_ns is None or (t_ns - used_ns) * 1e-9 > OUTAGE_S + max(self.delay_s, 0.0)

    @property
    def unplaced(self) -> bool:
        """Whether the path is local from its first position on."""
        return self.local and self.open_heading is None

    def place(self, start: KnownStart) -> None:
        """Begin a local path at the place that the waiting fixes gave, with an open heading."""
        self.local = True
        self.open_heading = OpenHeading(start.position_m, start.yaw_sigma_rad, self.waiting[-1].t_ns)

    def widened(self, state: State) -> State:
        """A state with the doubt of implausible fixes and of an open heading."""
        state = self.plausible.widened(state, self.track.reach_m)
        if self.local and self.open_heading is not None:
            state = self.open_heading.widened(state)
        return rounded(state)

    def update(self, chain: Chain, noise: SensorNoise) -> bool:
        """Use every waiting fix that the newest keyframe has passed; True when a factor was added.

        A fix belongs to the first keyframe after it.
        """
        used = False
        self.fix_noise.test_wheels(chain, self.skid, noise)
        self.track.step(chain, self.skid.rate_m2ps > 0.0)
        self.plausible.watch(chain.nodes[-1].t_ns)
        while self.waiting and self.waiting[0].t_ns <= chain.nodes[-1].t_ns:
            fix = self.waiting.pop(0)
            k = keyframe_of(fix, chain)
            if k is None:
                self.too_late += 1
            elif self.local:
                used |= self._use_local(chain, fix, noise)
            elif self._implausible(chain, k, fix):
                self.rejected += 1
            else:
                self._learn_noise(chain, fix)
                if self._change_class(chain, k, fix) or used or k < chain.last:
                    chain.smooth(max(chain.last - k + 2, 1))
                used |= self._add_fix(chain, k, fix, noise)
                if self._within_reach:
                    self._unchecked = fix
        if self.velocities.undo_wrong(chain, noise, self._bias_sigma):
            self.skid.restart()
            used = True
        self.fix_noise.drift.fresh = used and self._share >= LEAST_SHARE
        if used:
            self.weighting.revisit(chain)
        return used

    def _use_local(self, chain: Chain, fix: GnssFix, noise: SensorNoise) -> bool:
        """Use a fix while the path is local: it may align it with the map, unless it gave its place."""
        self.unaligned += 1
        self.track.add(fix)
        self._local_fixes += [fix] if chain.archive is not None else []
        gave_place = self.open_heading is not None and fix.t_ns <= self.open_heading.until_ns
        return not gave_place and self._align(chain, fix, noise)

    def _learn_noise(self, chain: Chain, fix: GnssFix) -> None:
        """What the newest fix shows of the noise of fixes, and of friction."""
        if self._pair is not None:
            self.track.keep(self._pair)
            self.velocities.test(self._pair, fix, self.fix_noise.scale)
        self.fix_noise.learn(self.track.scatter(), self.track.white_share())
        if self.fix_noise.scale > OPTIMISTIC_SCATTER * self._applied_scale:
            self._doubt_used(chain, fix)
        if self.skid.friction is not None:
            self.skid.friction.score_fix(fix, self.fix_noise.scale)

    def _implausible(self, chain: Chain, k: int, fix: GnssFix) -> bool:
        """Whether a fix must not be used whatever the gate says of it."""
        self._pair, place = self.track.pair(fix), self._antenna(chain, k)
        if self._pair is None:
            return False
        refused = self.plausible.refusal(self._pair, place)
        if refused is None:
            return False
        if self.plausible.mirrored:
            self.track.keep(self._pair)
        off = self._pair.fix - place
        innovation = np.array([off.real, off.imag])
        R = chain.state(k).rotation[:2]
        S = R @ chain.covariance_at(k)[3:6, 3:6] @ R.T + np.diag(fix.sigma_m[:2] ** 2)
        nis = normalised_square(innovation, S)
        self._report(Innovation(fix.t_ns, "gnss", np.append(innovation, np.nan), nis, 2, False, refused))
        return True

    def _antenna(self, chain: Chain, k: int) -> complex:
        """The antenna at keyframe k by the estimate, east + i north, m."""
        east_m, north_m, _ = chain.state(k).place_of(self.antenna_m).tolist()
        return complex(east_m, north_m)

    def _gated(self, chain: Chain, predicted: PredictedFix) -> tuple[GateDecision, float]:
        """Verdict of the gate and of plausibility on the newest fix, and the normalised square."""
        verdict, nis = self.gate.test(predicted.innovation_m[:2], predicted.S_m2)
        if verdict is GateDecision.REJECT and nis <= self.weighting.passed_nis:
            return GateDecision.ACCEPT, nis
        if verdict is GateDecision.ACCEPT or self._pair is None:
            return verdict, nis
        place, noise = self._antenna(chain, predicted.k), self.fix_noise
        if self.plausible.rejected(self._pair, place, self.track, noise.scale, noise.white):
            return GateDecision.REACQUIRE, nis
        return (verdict if self._within_reach else GateDecision.REJECT), nis

    def _align(self, chain: Chain, fix: GnssFix, noise: SensorNoise) -> bool:
        """Align a path that was begun without fixes with the map; True once they determine how."""
        self.alignment = align_to_map(chain, self.track, fix, self.antenna_m, self.fix_noise.drift.sigma_m)
        if self.alignment is None:
            return False
        self.local, self.last_used_ns = False, fix.t_ns
        if chain.archive is not None:
            self._add_local_fixes(chain.archive, noise.gnss_inflation * self.fix_noise.scale)
        return True

    def _add_local_fixes(self, archive: Chain, inflation: float) -> None:
        """Fixes that came before the path lay on the map, for the batch solution."""
        for fix in self._local_fixes:
            k = keyframe_of(fix, archive)
            if k is None:
                continue
            at = AntennaMotion.of(archive, k, fix, self.antenna_m)
            sigma, share = self.fix_noise.of(fix, inflation)
            position = GnssPosition(fix.enu_m, at.lever_m, sigma, share, at.velocity_mps)
            known = math.isfinite(fix.enu_m[2] + sigma[2])
            archive.add_fix(k, position if known else without_height(position, archive.state(k)))

    def _doubt_used(self, chain: Chain, fix: GnssFix) -> None:
        """Doubt what fixes of a far too small sigma have made of the window, once their scatter is known."""
        first, ratio = self._applied_scale == 1.0, self.fix_noise.scale / self._applied_scale
        self._applied_scale = self.fix_noise.scale
        for k, node in enumerate(chain.nodes, chain.first):
            for old in node.fixes[:]:
                wider = old.sigma_m * np.array([ratio, ratio, 1.0])
                chain.replace_fix(k, old, dataclasses.replace(old, sigma_m=wider))
        if first:  # later fixes were weighted by their scatter, if by too little of it
            self._doubt_window(chain, fix)
        chain.smooth(len(chain.nodes))

    def _doubt_window(self, chain: Chain, fix: GnssFix) -> None:
        sigma_m = self.fix_noise.scale * fix.horizontal_sigma_m
        doubt = np.zeros(chain.dim)
        doubt[2] = min(DOUBTFUL_YAW_SIGMA_RAD, sigma_m / max(self.track.extent_m(), 1e-3)) ** 2
        doubt[3:5], doubt[VELOCITY] = sigma_m**2, VELOCITY_SIGMA_MPS**2
        doubt[BIAS], doubt[DRIFT] = self._bias_sigma**2, self.fix_noise.drift.sigma_m**2
        chain.restart(doubt, chain.first)

    def _change_class(self, chain: Chain, k: int, fix: GnssFix) -> bool:
        """Restart the drift where the class of fix changes; True when it does."""
        step = chain.node(k).markov
        if not self.fix_noise.changes_class(fix) or step is None:
            return False
        chain.revise(k, step.restarted(slice(1, 3)))
        self.fix_noise.drift.restart()
        return True

    def correct_heading(self, chain: Chain, noise: SensorNoise) -> bool:
        """Turn the window where motion and fixes agree on another heading; True when it turned."""
        fix, self._unchecked = self._unchecked, None
        if fix is None:
            return False
        yaw_sigma = float(np.sqrt(chain.covariance[2, 2]))
        turn = self.track.heading_correction(yaw_sigma, self.fix_noise.scale)
        if turn is None:
            return False
        k = chain.at_or_after(fix.t_ns)
        if k is None:
            return False
        doubt = np.zeros(chain.dim)
        doubt[2] = DOUBTFUL_YAW_SIGMA_RAD**2
        doubt[VELOCITY], doubt[BIAS] = 1.0, self._bias_sigma**2
        doubt[SLIP], doubt[DRIFT] = noise.slip_sigma**2, self.fix_noise.drift.sigma_m**2
        turn_window(chain, k, fix, turn, self.antenna_m, self.fix_noise.scale, doubt)
        self.track.restart()
        self.skid.restart()
        self.turned += 1
        return True

    def _add_fix(self, chain: Chain, k: int, fix: GnssFix, noise: SensorNoise) -> bool:
        """Test a fix at keyframe k, once more if it refutes the wheels, and use it; False when rejected."""
        predicted = self._predicted(chain, k, fix, noise)
        verdict, nis = self._gated(chain, predicted)
        refuted = verdict is GateDecision.REJECT and self._refutes_wheels(chain, k, fix, noise)
        if refuted:
            predicted = self._predicted(chain, k, fix, noise)
            verdict, nis = self._gated(chain, predicted)
        used, weighted = verdict is not GateDecision.REJECT, predicted
        if verdict is not GateDecision.REACQUIRE:
            of = self.fix_noise
            test = predicted.innovation_test(of.scale, of.drift.sigma_m, of.white)
            weighted = predicted.weighted(*self.weighting.gnss(test))
        why = "" if used or self._within_reach else BEYOND
        self._report(Innovation(fix.t_ns, "gnss", predicted.innovation_m, nis, 2, used, why))
        if not used:
            if refuted:
                self.skid.undo(chain)
            self.rejected += 1
            return False
        if self._pair is not None:
            self.plausible.accepted(self._pair, verdict is GateDecision.REACQUIRE)
        own_m2 = float(predicted.own_m2.sum())
        self.skid.accepted(fix.t_ns, predicted.innovation_m[:2], predicted.S_m2.diagonal(), own_m2)
        self._add_factors(chain, weighted, verdict, noise.gnss_inflation)
        return True

    def _predicted(self, chain: Chain, k: int, fix: GnssFix, noise: SensorNoise) -> PredictedFix:
        inflation = noise.gnss_inflation * self.fix_noise.scale
        white_m, self._share = self.fix_noise.of(fix, inflation)
        return PredictedFix.of(chain, k, fix, self.antenna_m, white_m, self._share, fix.sigma_m * inflation)

    def _add_factors(self, chain: Chain, used: PredictedFix, verdict: GateDecision, inflation: float) -> None:
        """Position, with its height where its gate accepts it, and velocity of a fix."""
        k, position, off_m = used.k, used.position, used.innovation_m
        cut = cut_past(chain, used, verdict)
        known = math.isfinite(off_m[2] + position.sigma_m[2])
        if known:
            gated, _ = self.height_gate.test(off_m[2:], used.predicted_m2[2:, 2:] + position.sigma_m[2] ** 2)
            known = gated is not GateDecision.REJECT
        chain.add_fix(k, position if known else without_height(position, used.state))
        velocity = self.velocities.factor(chain, used, self.antenna_m, inflation)
        if velocity is not None:
            chain.add_velocity(k, velocity)
        if cut:
            chain.smooth(chain.last - k + 1)
            chain.restart(np.zeros(chain.dim), k)
        if position.weight > UNUSED_WEIGHT:
            self.last_used_ns = max(used.fix.t_ns, self.last_used_ns or used.fix.t_ns)

    @property
    def _within_reach(self) -> bool:
        """Whether the robot can have driven to the newest fix."""
        return self._pair is None or self._pair.usable

    def _refutes_wheels(self, chain: Chain, k: int, fix: GnssFix, noise: SensorNoise) -> bool:
        """Whether the fixes just rejected refute the wheels; see `SkidDetector.test_wheels`."""
        if not (self._within_reach and self.track.smooth_at(fix.t_ns)):
            return False
        refused, sigma_m = [off for off, _ in self.gate.rejected], fix.horizontal_sigma_m
        if not self.skid.test_wheels(chain, k, self.last_used_ns, refused, sigma_m, noise):
            return False
        self.gate.rejected.pop()  # it is tested again
        return True
