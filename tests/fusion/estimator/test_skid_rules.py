"""The skid detector's rules, on a chain that only records what it is told."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np
import pytest

from terrafusion.fusion.estimator.skid import SkidDetector, driving
from terrafusion.fusion.graph.key_state import LINEAR, VELOCITY, KeyState
from terrafusion.fusion.graph.wheel_factor import WheelIncrement
from terrafusion.fusion.noise.policy import load_policy

S, DT_S, SPEED = 10**9, 0.5, 3.0
NOISE = load_policy().fixed


def moving(speed_mps: float) -> KeyState:
    velocity = np.array([speed_mps, 0.0, 0.0])
    return KeyState(gtsam.Pose3(), velocity, gtsam.imuBias.ConstantBias(), np.zeros(len(LINEAR)))


def rolled(distance_m: float) -> WheelIncrement:
    return WheelIncrement(np.array([distance_m, 0.0, 0.0]), np.full(4, 0.01), distance_m, 0.0)


@dataclass
class Node:
    t_ns: int
    wheels: WheelIncrement | None
    point: KeyState = field(default_factory=lambda: moving(SPEED))
    link: str = "as measured"


class Recorder:
    """Keyframes 4 to 10, half a second apart; the robot goes at 3 m/s, its wheels roll 0.2 m back in each."""

    dim, first, last = 21, 4, 10

    def __init__(self, wheels: WheelIncrement | None = None) -> None:
        own = rolled(-0.2) if wheels is None else wheels
        self.nodes = [Node(round(i * DT_S * S), own) for i in range(self.first, self.last + 1)]
        self.calls: list[tuple[Any, ...]] = []

    def at_or_after(self, t_ns: int) -> int | None:
        return next((i + self.first for i, node in enumerate(self.nodes) if node.t_ns >= t_ns), None)

    def node(self, k: int) -> Node:
        return self.nodes[k - self.first]

    def restart(self, doubt: np.ndarray, begin: int) -> None:
        self.calls.append(("restart", doubt, begin))

    def revise(self, i: int, wheels: WheelIncrement | None, link: object) -> None:
        self.calls.append(("revise", i, wheels, link))

    def smooth(self, count: int) -> None:
        self.calls.append(("smooth", count))


def refuted(
    chain: Recorder, slide: SkidDetector, refused: list[tuple[float, float]], since_ns: int | None = 3 * S,
    sigma_m: float = 0.1,
) -> bool:  # fmt: skip
    """Rejected fixes of keyframe 10, after one that was used at keyframe 6."""
    return slide.test_wheels(chain, 10, since_ns, [np.array(r) for r in refused], sigma_m, NOISE)  # type: ignore[arg-type]


SHARE = 9.0 / 9.09
"""Of the time that counts as driven at 3 m/s."""


def test_two_rejected_fixes_free_velocity_and_wheels() -> None:
    chain, slide = Recorder(), SkidDetector()
    assert refuted(chain, slide, [(1.0, 0.0), (2.0, 0.0)])
    (restart, *revised, smooth) = chain.calls
    doubt = np.zeros(21)
    doubt[VELOCITY][:2] = 1.0  # 2 m in 2 s
    assert restart[0] == "restart"
    assert restart[2] == 6
    assert restart[1] == pytest.approx(doubt)
    assert [call[1] for call in revised] == [7, 8, 9, 10]
    assert smooth == ("smooth", 5)
    assert slide.rate_m2ps == pytest.approx(0.5 * 4.0 / (2.0 * SHARE))
    assert slide.refutations == 1
    for _, _, wheels, link in revised:
        assert link is None
        assert wheels.sigma[:2] ** 2 == pytest.approx(0.01**2 + 1.0 * DT_S)  # over all of the time
        assert wheels.sigma[2] == 0.01


def test_one_fix_refutes_only_in_a_skid_that_it_exceeds() -> None:
    chain, slide = Recorder(), SkidDetector()
    assert not refuted(chain, slide, [(2.0, 0.0)])
    slide.rate_m2ps = 0.25
    assert refuted(chain, slide, [(2.0, 0.0)])
    assert [call[0] for call in chain.calls] == ["revise"] * 4 + ["smooth"]
    assert slide.rate_m2ps == pytest.approx(0.5 * 4.0 / (2.0 * SHARE))
    again = Recorder()
    assert not refuted(again, slide, [(1.99, 0.0)])
    assert not again.calls
    assert slide.refutations == 1


def test_two_fixes_that_the_rate_explains_free_the_velocity_alone() -> None:
    chain, slide = Recorder(), SkidDetector()
    slide.rate_m2ps = 9.0
    assert refuted(chain, slide, [(2.0, 0.0), (2.0, 0.0)])
    assert chain.calls[0][0] == "restart"
    assert slide.rate_m2ps == 9.0
    assert all(call[2].sigma == pytest.approx(np.full(4, 0.01)) for call in chain.calls[1:-1])


def test_a_skid_by_the_drift_alone_is_not_one_by_rejected_fixes() -> None:
    slide, moved_m = SkidDetector(), [np.array([1.0, 0.0])] * 2
    assert slide.test_wheels(Recorder(), 10, 3 * S, moved_m, 0.1, NOISE, rejected=False)  # type: ignore[arg-type]
    assert (slide.refutations, slide.suspicions) == (0, 1)
    assert slide.rate_m2ps > 0.0
    assert not slide.by_rejection
    assert refuted(Recorder(), slide, [(2.0, 0.0), (3.0, 0.0)])
    assert slide.by_rejection
    slide.undo(Recorder())  # type: ignore[arg-type]
    assert not slide.by_rejection


@pytest.mark.parametrize(("degrees", "found"), [(0.0, True), (59.0, True), (61.0, False), (180.0, False)])
def test_the_last_two_lie_on_one_side(degrees: float, found: bool) -> None:
    angle = math.radians(degrees)
    refused = [(-5.0, 0.0), (0.5, 0.0), (2.0 * math.cos(angle), 2.0 * math.sin(angle))]
    assert refuted(Recorder(), SkidDetector(), refused) == found


@pytest.mark.parametrize(("sigma_m", "reach_m"), [(0.1, 7.1), (1.0, 9.8)])
def test_no_fix_beyond_what_wheels_and_speed_reach(sigma_m: float, reach_m: float) -> None:
    """Four times 0.2 m, 3 m/s for 2 s, three sigmas."""
    for off_m, found in ((reach_m - 0.01, True), (reach_m + 0.01, False)):
        slide = SkidDetector()
        assert refuted(Recorder(), slide, [(1.0, 0.0), (off_m, 0.0)], sigma_m=sigma_m) == found
        assert slide.refutations == found


@pytest.mark.parametrize("speed_mps", [0.0, 0.02])
def test_a_robot_that_hardly_moves_has_not_skidded_far(speed_mps: float) -> None:
    """Fixes of a coarse receiver drift by half a metre while it stands."""
    chain, slide = Recorder(rolled(speed_mps * DT_S)), SkidDetector()
    for node in chain.nodes:
        node.point = moving(speed_mps)
    refuted(chain, slide, [(0.4, 0.0), (0.5, 0.0)], sigma_m=1.5)
    after_20_s_m2 = 20.0 * slide.rate_m2ps * driving(moving(1.0), rolled(DT_S), DT_S)
    assert after_20_s_m2 < 9.0
    for _, _, wheels, _ in (call for call in chain.calls if call[0] == "revise"):
        assert wheels.sigma[0] < 0.1


def test_nothing_is_refuted_before_the_first_fix_or_without_wheels() -> None:
    assert not refuted(Recorder(), SkidDetector(), [(1.0, 0.0), (2.0, 0.0)], since_ns=None)
    chain = Recorder()
    for node in chain.nodes:
        node.wheels = None
    assert not refuted(chain, SkidDetector(), [(1.0, 0.0), (2.0, 0.0)])
    assert not chain.calls


def test_keyframes_without_wheels_are_left_as_they_are() -> None:
    chain = Recorder()
    chain.nodes[4].wheels = None  # keyframe 8
    assert refuted(chain, SkidDetector(), [(1.0, 0.0), (2.0, 0.0)])
    assert [call[1] for call in chain.calls if call[0] == "revise"] == [7, 9, 10]


def test_a_fix_newer_than_the_chain_begins_at_its_start() -> None:
    chain = Recorder()
    assert refuted(chain, SkidDetector(), [(1.0, 0.0), (2.0, 0.0)], since_ns=60 * S)
    assert [call[1] for call in chain.calls if call[0] == "revise"] == [5, 6, 7, 8, 9, 10]


def test_a_refutation_is_taken_back_whole() -> None:
    chain, slide = Recorder(), SkidDetector()
    slide.rate_m2ps = 0.25
    wheels = chain.nodes[5].wheels
    assert refuted(chain, slide, [(1.0, 0.0), (2.0, 0.0)])
    chain.calls.clear()
    slide.undo(chain)  # type: ignore[arg-type]
    assert chain.calls == [("revise", i, wheels, "as measured") for i in (7, 8, 9, 10)]
    assert (slide.rate_m2ps, slide.refutations) == (0.25, 0)
    slide.restart()
    assert slide.rate_m2ps == 0.0


@pytest.mark.parametrize(
    ("wheel_mps", "robot_mps", "share"),
    [(0.0, 0.0, 0.0), (0.3, 0.0, 0.5), (0.0, 0.3, 0.5), (-3.0, 0.3, SHARE), (0.3, 3.0, SHARE)],
)
def test_the_faster_of_robot_and_wheels_drives(wheel_mps: float, robot_mps: float, share: float) -> None:
    assert driving(moving(robot_mps), rolled(wheel_mps * 0.2), 0.2) == pytest.approx(share)
    assert driving(moving(robot_mps), None, 0.2) == pytest.approx(robot_mps**2 / (robot_mps**2 + 0.09))


def test_a_skid_fades_with_the_time_that_is_driven() -> None:
    slide = SkidDetector()
    slide.rate_m2ps = 0.5
    wheels = slide.with_extra_variance(rolled(3.0), moving(3.0), 1.0)
    rate = 0.5 * math.exp(-SHARE / 20.0)
    assert slide.rate_m2ps == pytest.approx(rate)
    assert wheels.sigma[0] ** 2 == pytest.approx(0.01**2 + rate * SHARE)


def test_without_fixes_a_robot_skids_as_much_as_it_usually_did() -> None:
    """The mean rate of the drive, of which half a minute without a skid is assumed, after 5 s of driving."""
    slide = SkidDetector()
    for k in range(1, 31):
        slide.rate_m2ps = 0.5
        slide.with_extra_variance(rolled(3.0), moving(3.0), 1.0)
        slide.accepted(k * S, np.zeros(2), np.zeros(2), 1e9)
    slide.rate_m2ps, quiet = 0.0, rolled(3.0)
    for _ in range(5):
        assert slide.with_extra_variance(quiet, moving(3.0), 1.0) is quiet
    slide.with_extra_variance(quiet, moving(3.0), 1.0)
    loose = slide.with_extra_variance(quiet, moving(3.0), 1.0)
    passed_s = 30.0 * SHARE
    usual = 0.5 * math.exp(-SHARE / 20.0) * passed_s / (30.0 + passed_s)
    assert loose.sigma[0] ** 2 == pytest.approx(0.01**2 + usual * SHARE)
    slide.accepted(99 * S, np.zeros(2), np.zeros(2), 0.04)
    assert slide.with_extra_variance(quiet, moving(3.0), 1.0) is quiet


def test_a_skid_that_was_a_wrong_heading_is_none_of_the_usual() -> None:
    slide, quiet = SkidDetector(), rolled(3.0)
    slide.rate_m2ps = 0.5
    slide.with_extra_variance(quiet, moving(3.0), 1.0)
    slide.accepted(S, np.zeros(2), np.zeros(2), 1e9)
    slide.restart()
    for _ in range(9):
        assert slide.with_extra_variance(quiet, moving(3.0), 1.0) is quiet


def test_accepted_fixes_move_the_rate_by_what_their_innovations_tell() -> None:
    """Half of the product with the one before, or of what is more than predicted, whichever is less."""
    slide = SkidDetector()
    slide.rate_m2ps, predicted = 0.5, np.array([0.1, 0.2])

    def step(t_s: float, innovation: tuple[float, float], fix_m2: float = 0.04) -> tuple[float, float]:
        slide.with_extra_variance(rolled(3.0), moving(3.0), 1.0)
        before = slide.rate_m2ps
        slide.accepted(round(t_s * S), np.array(innovation), predicted, fix_m2)
        return before, slide.rate_m2ps

    def told(before: float, more_m2: float) -> float:
        return before + (1.0 - math.exp(-SHARE / 10.0)) * 0.5 * more_m2 / SHARE

    before, after = step(1.0, (1.0, 0.0))
    assert after == pytest.approx(told(before, 0.0))  # none came before it
    before, after = step(2.0, (0.5, 0.5))
    assert after == pytest.approx(told(before, 0.5 - 0.3))  # its own is less than the product
    before, after = step(3.0, (0.5, -0.7))
    assert after == pytest.approx(told(before, 0.25 - 0.35))
    before, after = step(3.0, (9.0, 9.0))
    assert after == before, "an older fix tells nothing"
    before, after = step(4.0, (0.0, 0.0), fix_m2=20.0 * before)
    assert after == before, "nor does one whose own variance is larger than what the rate adds up to"
    for k in range(5, 60):
        step(k, (0.0, 0.0))
    assert slide.rate_m2ps == 0.0


def test_coarse_fixes_speak_up_to_a_square_metre() -> None:
    for fix_m2, speaks in ((1.0, True), (1.01, False)):
        slide = SkidDetector()
        slide.rate_m2ps = 0.01
        slide.with_extra_variance(rolled(3.0), moving(3.0), 1.0)
        before = slide.rate_m2ps
        slide.accepted(S, np.zeros(2), np.full(2, 1e-3), fix_m2)
        assert (slide.rate_m2ps < before) == speaks


def test_a_rate_below_a_square_centimetre_a_second_is_none() -> None:
    for rate, left in ((1.2e-4, True), (1.0e-4, False)):
        slide = SkidDetector()
        slide.rate_m2ps = rate
        slide.with_extra_variance(rolled(3.0), moving(3.0), 1.0)
        slide.accepted(S, np.zeros(2), np.zeros(2), 0.04)
        assert (slide.rate_m2ps > 0.0) == left


def test_without_a_skid_the_wheels_are_as_measured() -> None:
    own = rolled(0.3)
    assert SkidDetector().with_extra_variance(own, moving(1.0), 0.1) is own
