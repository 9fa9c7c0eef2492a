"""The live API in any order, with values and times as no driver should send them: a rule-based machine.

`TestLive` is a small fixed part; `python -m tests.studies run fuzz` runs many.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.messages import (
    GnssSample,
    ImuSample,
    MagnetometerSample,
    Message,
    SteeringSample,
    TerrainSample,
    WheelSample,
)
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.estimator.notes import notes_of
from terrafusion.twin.scenario.scenario import DriveSegment, Scenario
from terrafusion.twin.simulate import simulate

MODES = ("fixed", "robust", "adaptive", "innovation")
SECOND_NS = 10**9

NUMBERS = st.one_of(
    st.floats(-3.0, 3.0),
    st.floats(),
    st.sampled_from([1e300, -1e300, 1e-300, 9000.0, 1e6, 99.0, float("inf"), float("nan"), None, "x", True]),
    st.sampled_from([[1.0], [], {}, b"1", 1j, 10**400, np.float32(1.0), np.array(["a"]), object]),
)
THREE = st.one_of(
    st.lists(st.floats(-2.0, 2.0), min_size=3, max_size=3),
    st.lists(st.floats(-1e4, 1e4), min_size=3, max_size=3),
    st.lists(NUMBERS, min_size=3, max_size=3),
    NUMBERS,
)
AHEAD = st.one_of(
    st.integers(-20_000_000, 20_000_000),
    st.integers(-12 * SECOND_NS, 12 * SECOND_NS),
    st.sampled_from([3600 * SECOND_NS, -3600 * SECOND_NS, 2**63, -(2**63), 2**80]),
)
NO_TIMES = st.sampled_from([None, 0.5, float("nan"), "1", [1], np.array([1]), np.datetime64("NaT"), True])
FIXES = st.sampled_from([None, "fixed", "single", "none", 0, 1, 4, 99, "?", 1.5])
GROUNDS = st.one_of(
    st.dictionaries(st.sampled_from(["mud", "loose_sand", "asphalt", "lava", 1]), NUMBERS, max_size=3),
    NUMBERS,
)
NAMES = st.sampled_from([("left", "right"), ("body",), ("a", "b"), (), ("front_left", "rear_right"), (1, 2)])


@functools.cache
def drive() -> list[Message]:
    """Messages of a short drive with a bend."""
    legs = (DriveSegment(2.0), DriveSegment(10.0, v_mps=1.0, yaw_rate_radps=0.1))
    return list(simulate(Scenario("short", 10.0, drive=legs), seed=1, vehicle="elevate").messages())


@functools.cache
def running(mode: str) -> tuple[Estimator, bytes, int]:
    """An estimator in the middle of the drive as a dump, and how many messages it has had."""
    cut = int(0.6 * len(drive()))
    estimator = Estimator.for_vehicle("elevate", mode)
    for message in drive()[:cut]:
        estimator.add(message)
    return estimator, estimator.dump(), cut


class LiveMachine(RuleBasedStateMachine):
    """Calls in any order; each is used, left out, or refused with a `DataError`, and the next one works."""

    def __init__(self) -> None:
        super().__init__()
        self.estimator = Estimator.for_vehicle("elevate")
        self.at = self.shift_ns = 0
        self.newest_ns = self.state_ns = drive()[0].t_ns
        self.ahead = 0

    @initialize(mode=st.sampled_from(MODES), begun=st.booleans())
    def start(self, mode: str, begun: bool) -> None:
        if begun:
            first, dump, self.at = running(mode)
            self.estimator = Estimator.restore(first.config, dump)
        else:
            self.estimator = Estimator.for_vehicle("elevate", mode)

    def now_ns(self) -> int:
        return drive()[min(self.at, len(drive()) - 1)].t_ns + self.shift_ns

    def call(self, method: str, *given: Any) -> bool:
        """One call; False where it is refused."""
        refused = ""
        try:
            getattr(self.estimator, method)(*given)
        except DataError as error:
            refused = str(error)
        assert "\n" not in refused
        assert len(refused) < 1500
        return not refused

    def stamp(self, ahead_ns: int) -> int:
        """A time, of which the machine remembers whether it can set the clock of the estimator on."""
        t_ns = self.now_ns() + ahead_ns
        if SECOND_NS // 2 < ahead_ns < 2**62:
            self.ahead += 1
            self.newest_ns = max(self.newest_ns, t_ns)
        return t_ns

    @rule(count=st.integers(1, 60))
    def valid(self, count: int) -> None:
        for message in drive()[self.at : self.at + count]:
            self.call("add", message._replace(t_ns=message.t_ns + self.shift_ns))
            self.at += 1

    @rule(ahead=AHEAD, gyro=THREE, accel=THREE)
    def imu(self, ahead: int, gyro: Any, accel: Any) -> None:
        self.call("add_imu", self.stamp(ahead), gyro, accel)

    @rule(ahead=AHEAD, sides=st.tuples(NUMBERS, NUMBERS, NUMBERS, NUMBERS))
    def wheels(self, ahead: int, sides: tuple[Any, ...]) -> None:
        self.call("add_wheels", self.stamp(ahead), *sides)

    @rule(ahead=AHEAD, enu=THREE, sigma=THREE, velocity=THREE, sigma_v=NUMBERS, fix=FIXES)
    def gnss(self, ahead: int, enu: Any, sigma: Any, velocity: Any, sigma_v: Any, fix: Any) -> None:
        self.call("add_gnss", self.now_ns() + ahead, enu, sigma, velocity, sigma_v, fix)

    @rule(ahead=AHEAD, one=NUMBERS, two=NUMBERS, three=THREE, grounds=GROUNDS)
    def others(self, ahead: int, one: Any, two: Any, three: Any, grounds: Any) -> None:
        t = self.now_ns() + ahead
        self.call("add_command", t, one)
        self.call("add_pressure", t, two)
        self.call("add_magnetic_field", t, three)
        self.call("add_terrain", t, grounds)
        self.call("add_steering", self.stamp(ahead), one, two)

    @rule(t=NO_TIMES, three=THREE, one=NUMBERS)
    def no_time(self, t: Any, three: Any, one: Any) -> None:
        assert not self.call("add_imu", t, three, three)
        assert not self.call("add_wheels", t, one, one)
        assert not self.call("add_gnss", t, three, three)

    @rule(ahead=AHEAD, three=THREE, one=NUMBERS, names=NAMES, fix=FIXES, grounds=GROUNDS)
    def messages(self, ahead: int, three: Any, one: Any, names: Any, fix: Any, grounds: Any) -> None:
        t = self.stamp(ahead)
        odd: list[Any] = [
            ImuSample(t, three, three),
            WheelSample(t, three, names, "mps", one),
            GnssSample(t, three, three, fix, three, one),
            SteeringSample(t, one, names),
            TerrainSample(t, "mud", "camera", grounds),
            MagnetometerSample(t, three),
            three,
        ]
        for message in odd:
            self.call("add", message)

    @rule(position=THREE, yaw=NUMBERS, sigma=NUMBERS)
    def known_start(self, position: Any, yaw: Any, sigma: Any) -> None:
        self.call("set_start", position, yaw, sigma, sigma)

    @rule()
    def dumped(self) -> None:
        data = self.estimator.dump()
        self.estimator = Estimator.restore(self.estimator.config, data)
        assert self.estimator.dump() == data

    @rule(frame=st.sampled_from(["map", "odom"]))
    def read(self, frame: str) -> None:
        state = self.estimator.odometry(frame)
        assert state is None or np.isfinite(state.position_m).all()
        assert isinstance(self.estimator.status, str)
        assert all(isinstance(note, str) for note in notes_of(self.estimator))

    @precondition(lambda self: self.at > 0)
    @rule()
    def finish(self) -> None:
        self.estimator.finish()

    @invariant()
    def finite_and_forward(self) -> None:
        state = self.estimator.latest()
        if state is None:
            return
        assert state.t_ns >= self.state_ns, "time runs backwards"
        self.state_ns = state.t_ns
        for values in (state.position_m, state.velocity_mps, state.covariance, state.slip):
            assert np.isfinite(values).all()
        assert (np.diag(state.covariance) > 0.0).all()

    def teardown(self) -> None:
        """Valid messages work again: at once, or, where stamps agreed that time has jumped, from there on."""
        if self.ahead >= 3:
            self.shift_ns += max(0, self.newest_ns - self.now_ns()) + 20 * SECOND_NS
            self.state_ns = min(self.state_ns, self.now_ns())
        rest = drive()[-400:]
        first_ns = self.now_ns() - rest[0].t_ns + 1
        before = self.state_ns
        used = [self.call("add", m._replace(t_ns=m.t_ns + first_ns)) for m in rest]
        state = self.estimator.latest()
        assert sum(used[-100:]) == 100, "valid messages are refused"
        if state is not None:
            self.finite_and_forward()
            assert state.t_ns > before, "no new state of valid messages"
