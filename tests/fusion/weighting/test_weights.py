"""What the modes "robust" and "innovation" make of single measurements, by hand."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import gtsam
import numpy as np
import pytest

from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimate.estimate import WeightChange
from terrafusion.fusion.graph.gnss_factor import GnssPosition
from terrafusion.fusion.graph.key_state import KeyState
from terrafusion.fusion.graph.wheel_factor import WheelIncrement
from terrafusion.fusion.noise.policy import SensorNoise, load_policy
from terrafusion.fusion.weighting.innovation import InnovationWeighting, SageHusa, Variational
from terrafusion.fusion.weighting.robust import (
    LEAST_WEIGHT,
    RobustWeighting,
    cauchy_weight,
    reweighted,
    settled,
    truncated_weights,
)
from terrafusion.fusion.weighting.weighting import InnovationTest, Weighting, inflated, wheel_innovation_test
from terrafusion.twin.model.vehicle import load_vehicle


class Recorder:
    """The noise in force, and what is recorded."""

    def __init__(self, noise: SensorNoise) -> None:
        self.noise, self.changes = noise, list[WeightChange]()

    def record(self, change: WeightChange) -> None:
        self.changes.append(change)


def judged(
    mode: Weighting, wheels: WheelIncrement, innovation_m: float, variance_m2: float
) -> WheelIncrement:
    """The increment of 0.1 s by a mode."""
    return mode.wheels(wheels, wheel_innovation_test(3, wheels, innovation_m, variance_m2, 0.1))


def surprise(nu: list[float], predicted: float, noise: float, **more: float) -> InnovationTest:
    n = len(nu)
    unit = more.pop("unit", 1.0)
    return InnovationTest(
        5, np.array(nu), np.full(n, predicted), np.full(n, noise), np.full(n, unit), **more
    )  # fmt: skip


def increment(distance_m: float = 0.1, sigma: float = 0.02) -> WheelIncrement:
    moved = np.array([distance_m, 0.0, 0.0])
    return WheelIncrement(moved, np.array([sigma, 0.03, 0.04, 0.05]), distance_m, 0.0)


def weighting(mode: str, **options: object) -> tuple[Weighting, Recorder]:
    config = EstimatorConfig(load_vehicle("husky").rig(), "husky", mode=mode, **options)  # type: ignore[arg-type]
    recorder = Recorder(load_policy().fixed)
    kind = RobustWeighting if mode == "robust" else InnovationWeighting
    return kind(config, recorder), recorder


def test_a_wheel_increment_is_compared_with_what_is_left_of_its_innovation() -> None:
    found = wheel_innovation_test(7, increment(), 0.3, 0.0013, 0.1)
    assert found.t_ns == 7
    values = found.innovation_m, found.predicted_m2, found.noise_m2, found.unit_m
    assert [float(x[0]) for x in values] == pytest.approx([0.3, 0.0009, 0.0004, 0.1])
    assert wheel_innovation_test(7, increment(), 0.3, 0.0001, 0.1).predicted_m2[0] == 0.0
    assert inflated(increment(), 3.0).sigma.tolist() == pytest.approx([0.06, 0.03, 0.04, 0.05])


def test_unweighted_measurements_keep_their_sigma() -> None:
    plain, wheels = Weighting(), increment()
    assert judged(plain, wheels, 9.0, 1.0) is wheels
    assert plain.gnss(surprise([9.0, 9.0], 0.0, 1.0)) == (1.0, 1.0)
    assert plain.passed_nis == 0.0
    plain_test = surprise([1.0], 0.0, 1.0)
    assert (plain_test.drift_m2, plain_test.white_share) == (0.0, 1.0)


@pytest.mark.parametrize(("ratio", "recorded"), [(1.09, 0), (1.11, 1), (0.91, 0), (0.89, 1)])
def test_a_change_is_recorded_from_a_tenth_on(ratio: float, recorded: int) -> None:
    mode, recorder = weighting("innovation", innovation_method="sage_husa")
    sigma = recorder.noise.wheel_sigma_mps
    counter_m2 = 0.02**2 - (0.1 * sigma) ** 2
    nu2 = counter_m2 + 0.01 * sigma**2 * (1.0 + 100.0 * (ratio**2 - 1.0))
    before, mode_nu = recorder.noise, math.sqrt(max(nu2, 0.0))
    if nu2 < 0.0:  # a decrease beyond one step: the prediction's variance takes the rest
        judged(mode, increment(), 0.0, 0.02**2 - nu2)
    else:
        judged(mode, increment(), mode_nu, 0.02**2)
    assert recorder.noise.wheel_sigma_mps == pytest.approx(ratio * before.wheel_sigma_mps)
    assert len(recorder.changes) == recorded


def test_sage_husa_moves_by_its_gain_towards_what_an_innovation_shows() -> None:
    noise = SageHusa(2.0, 10.0, 1.7, 2.5)
    noise.update(surprise([3.0, 1.0], 1.0, 1.0, unit=2.0))  # (8 / 4 + 0 / 4) / 2 = 1
    assert noise.value == pytest.approx(1.9)
    noise.update(surprise([0.0], 0.0, 1.0))
    assert noise.value == pytest.approx(1.71)
    noise.update(surprise([0.0], 0.0, 1.0))
    assert noise.value == 1.7
    noise.update(surprise([100.0], 0.0, 1.0))
    assert noise.value == 2.5


def test_variational_noise_is_the_mean_of_its_inverse_gamma() -> None:
    """Of an exact prediction all is noise: alpha 0.9 x 5 + 1, beta 0.9 x 10 + 2."""
    noise = Variational(2.0, 10.0, 1e-9, 1e9)
    noise.update(surprise([4.0, 0.0], 0.0, 1.0, unit=2.0))
    assert noise.value == pytest.approx((9.0 + 2.0) / (4.5 + 1.0))
    noise.update(surprise([1.0], -5.0, 1.0))  # a negative variance is none
    assert noise.value == pytest.approx((0.9 * 11.0 + 0.5) / (0.9 * 5.5 + 0.5))


def test_variational_noise_is_at_its_fixed_point() -> None:
    noise, P = Variational(2.0, 4.0, 1e-9, 1e9), 0.5
    noise.update(surprise([3.0], P, 1.0))
    share = noise.value / (P + noise.value)
    wanted = 0.75 * 4.0 + 0.5 * (9.0 * share**2 + P * share)
    assert noise.value * (0.75 * 2.0 + 0.5) == pytest.approx(wanted, rel=2e-3)


def test_wheels_learn_from_what_neither_prediction_nor_counter_explains() -> None:
    """0.02 m in 0.1 s are 0.2 m/s: what the noise in force does not explain of it is the counter's."""
    mode, recorder = weighting("innovation", innovation_method="sage_husa")
    sigma = recorder.noise.wheel_sigma_mps
    counter_m2 = 0.02**2 - (0.1 * sigma) ** 2
    assert counter_m2 > 0.0
    value = sigma**2 + ((0.05**2 - 0.0009 - counter_m2) / 0.01 - sigma**2) / 100.0
    found = judged(mode, increment(), 0.05, 0.0013)
    assert recorder.noise.wheel_sigma_mps == pytest.approx(math.sqrt(value))
    assert found.sigma[0] == pytest.approx(math.sqrt(counter_m2 + 0.01 * value))
    assert found.sigma[1:].tolist() == [0.03, 0.04, 0.05]


def test_wheels_that_stand_teach_nothing() -> None:
    mode, recorder = weighting("innovation")
    before, standing = recorder.noise, increment(distance_m=-0.0049)
    assert judged(mode, standing, 0.5, 0.0013) is standing
    assert recorder.noise == before
    judged(mode, increment(distance_m=-0.0051), 0.5, 0.0013)
    assert recorder.noise != before


def test_the_noise_of_wheels_stays_within_its_span_and_its_changes_are_recorded() -> None:
    mode, recorder = weighting("innovation", innovation_method="sage_husa")
    tuned = recorder.noise.wheel_sigma_mps
    for _ in range(2000):
        judged(mode, increment(), 1.0, 0.0004)
    assert recorder.noise.wheel_sigma_mps == pytest.approx(9.0 * tuned)
    for _ in range(2000):
        judged(mode, increment(), 0.0, 0.0004)
    assert recorder.noise.wheel_sigma_mps == pytest.approx(tuned / 9.0)
    steps = [(change.before, change.after) for change in recorder.changes]
    assert steps[0][0] == tuned
    assert [after for _, after in steps[:-1]] == [before for before, _ in steps[1:]]
    assert all(abs(after - before) > 0.1 * before for before, after in steps)
    assert {(c.t_ns, c.sensor, c.unit) for c in recorder.changes} == {(3, "wheels", "m/s")}


@pytest.mark.parametrize(("drift", "least"), [(0.0, 1.0), (0.5, 0.3), (4.0, 0.3)])
def test_fixes_are_inflated_by_what_their_innovations_show(drift: float, least: float) -> None:
    """The noise begins at what the factor gives, and the part that drifts is no noise of a fix."""
    mode, recorder = weighting("innovation", innovation_method="sage_husa")
    before = recorder.noise.gnss_inflation
    fix = surprise([6.0, -6.0], 0.0, 9.0, unit=2.0, drift_m2=4.0 * drift, white_share=least)
    scale, weight = mode.gnss(fix)
    low, high = (max(x * x * before**2 - drift, least * x * x * before**2) for x in (0.5, 50.0))
    value = min(max(2.25 + (9.0 - 2.25) / 150.0, low), high)
    now = min(value + drift, value / least)
    assert recorder.noise.gnss_inflation == pytest.approx(math.sqrt(now))
    white = [max(reported - drift, least * reported) for reported in (now, before**2)]
    assert (scale, weight) == (pytest.approx(math.sqrt(white[0] / white[1])), 1.0)
    scale, _ = mode.gnss(fix)
    again = min(max(value + (9.0 - value) / 150.0, low), high)
    then = min(again + drift, again / least)
    assert recorder.noise.gnss_inflation == pytest.approx(math.sqrt(then))
    white = [max(reported - drift, least * reported) for reported in (then, now)]
    assert scale == pytest.approx(math.sqrt(white[0] / white[1]))


def test_the_inflation_of_fixes_has_bounds() -> None:
    mode, recorder = weighting("innovation", innovation_method="sage_husa")
    tuned = recorder.noise.gnss_inflation
    for nu, bound in ((1e9, 50.0), (0.0, 0.5)):
        for _ in range(3000):
            mode.gnss(surprise([nu, nu], 0.0, 1.0))
        assert recorder.noise.gnss_inflation == pytest.approx(bound * tuned)
    for _ in range(3):  # from the bound, not from where they would have been without it
        mode.gnss(surprise([1e3, 1e3], 0.0, 1.0))
    assert recorder.noise.gnss_inflation > 50.0 * tuned * 0.999
    mode.gnss(surprise([0.0, 0.0], 0.0, 1.0))
    assert recorder.noise.gnss_inflation == pytest.approx(50.0 * tuned * math.sqrt(1.0 - 1.0 / 150.0))


def test_cauchy_weights_settle_where_the_update_leaves_their_residual() -> None:
    """Of an exact prediction: 1 / (1 + r^2 / c^2), r over both axes; an uncertain one takes the blame."""
    assert cauchy_weight(surprise([3.0, 4.0], 0.0, 1.0), 5.0) == pytest.approx(0.5)
    assert cauchy_weight(surprise([6.0, 8.0], 0.0, 4.0), 5.0) == pytest.approx(0.5)
    assert cauchy_weight(surprise([5.0], 1e6, 1.0), 5.0) == pytest.approx(1.0, abs=1e-6)
    assert cauchy_weight(surprise([1e9], 0.0, 1.0), 5.0) == LEAST_WEIGHT


def test_wheels_are_doubted_once_and_believed_again_once() -> None:
    mode, recorder = weighting("robust", robust_loss="cauchy")
    c = 12.0
    for nu in (0.1, 0.9, 0.9, 0.1, 0.1):
        w = 1.0 / (1.0 + (nu / 0.02 / c) ** 2)
        found = judged(mode, increment(), nu, 0.0004)
        assert found.sigma.tolist() == pytest.approx([0.02 / math.sqrt(w), 0.03, 0.04, 0.05])
    doubted, believed = recorder.changes
    assert (doubted.t_ns, doubted.sensor, doubted.before) == (3, "wheels", 1.0)
    assert doubted.after == pytest.approx(1.0 / (1.0 + (45.0 / c) ** 2))
    assert doubted.reason == "cauchy loss: increments doubted, innovation 0.900 m"
    assert (believed.before, believed.after) == (0.5, pytest.approx(1.0 / (1.0 + (5.0 / c) ** 2)))
    assert "believed again, innovation 0.100 m" in believed.reason


def test_fixes_are_doubted_by_the_loss_in_force() -> None:
    mode, recorder = weighting("robust", robust_loss="cauchy")
    assert mode.passed_nis == 3.75**2
    assert mode.gnss(surprise([8.0, 0.0], 0.0, 1.0)) == (pytest.approx(math.sqrt(2.0)), pytest.approx(0.5))
    assert mode.gnss(surprise([6.0, 8.0], 0.0, 1.0))[1] == pytest.approx(1.0 / (1.0 + 100.0 / 64.0))
    assert [change.reason for change in recorder.changes] == ["cauchy loss: fix doubted, 10.0 m off"]
    mode, recorder = weighting("robust", robust_loss="gnc")
    assert mode.gnss(surprise([8.0, 0.0], 1.0, 3.0)) == (1.0, 1.0)  # exactly c = 4 sigma
    assert mode.gnss(surprise([8.0, 0.1], 1.0, 3.0)) == (pytest.approx(LEAST_WEIGHT**-0.5), LEAST_WEIGHT)
    assert recorder.changes[0].after == LEAST_WEIGHT


def test_truncated_weights_are_those_of_the_paper() -> None:
    """mu = 1, c^2 = 4: all below 2, none from 8 on, between them sqrt(8 / r^2) - 1."""
    assert truncated_weights(np.array([0.0, 2.0, 4.0, 8.0, 9.0]), 4.0, 1.0).tolist() == pytest.approx(
        [1.0, 1.0, math.sqrt(2.0) - 1.0, LEAST_WEIGHT, LEAST_WEIGHT]
    )
    half = np.array([1.0, LEAST_WEIGHT])
    assert settled(np.array([9.0, 9.1]), half, 9.0)  # half of them believed, one exactly at the bound


def test_a_weight_moves_the_horizontal_sigma_alone() -> None:
    fix = GnssPosition(np.zeros(3), np.zeros(3), np.array([2.0, 3.0, 4.0]), weight=0.25)
    found = reweighted(fix, 1.0)
    assert (found.weight, found.sigma_m.tolist()) == (1.0, [1.0, 1.5, 4.0])
    assert fix.sigma_m.tolist() == [2.0, 3.0, 4.0]


class Window:
    """Stands for a chain whose fixes do not move its states."""

    def __init__(self, errors: list[float], weights: list[float]) -> None:
        self.first = 10
        fixes = [
            reweighted(GnssPosition(np.array([e, 0.0, 0.0]), np.zeros(3), np.array([0.5, 0.5, 9.0])), w)
            for e, w in zip(errors, weights, strict=True)
        ]
        self.nodes = [dataclasses.make_dataclass("Node", ["t_ns", "fixes"])(100 + i, [f]) for i, f in
                      enumerate(fixes)]  # fmt: skip

    def smooth(self, count: int, iterations: int) -> None:
        assert count == len(self.nodes)

    def state(self, k: int) -> KeyState:
        assert 0 <= k - self.first < len(self.nodes)
        return KeyState(gtsam.Pose3(), np.zeros(3), gtsam.imuBias.ConstantBias(), np.zeros(15))

    def node(self, k: int) -> Any:
        return self.nodes[k - self.first]

    def replace_fix(self, k: int, old: GnssPosition, new: GnssPosition) -> None:
        node = self.node(k)
        node.fixes = [new if fix is old else fix for fix in node.fixes]

    def weights(self) -> list[float]:
        return [fix.weight for node in self.nodes for fix in node.fixes]


@pytest.mark.parametrize("before", [[1.0] * 5, [1.0, 1.0, LEAST_WEIGHT, 1.0, 1.0]])
def test_a_window_of_fixes_is_weighted_all_or_nothing(before: list[float]) -> None:
    """The scale is 4 sigmas of 0.5 m: 1.9 m is believed, 2.1 m is not, whatever was thought before."""
    mode, recorder = weighting("robust", robust_loss="gnc")
    window = Window([0.0, 0.1, 1.9, 2.1, 50.0], before)
    mode.revisit(window)  # type: ignore[arg-type]
    assert window.weights() == [1.0, 1.0, 1.0, LEAST_WEIGHT, LEAST_WEIGHT]
    assert [fix.sigma_m[0] for node in window.nodes for fix in node.fixes] == pytest.approx(
        [0.5, 0.5, 0.5, 500.0, 500.0]
    )
    told = {change.t_ns: change.reason for change in recorder.changes}
    assert told.pop(103) == "gnc loss: fix doubted, 4.2 sigma over the window off"
    assert told.pop(104) == "gnc loss: fix doubted, 100.0 sigma over the window off"
    assert [why.split(",")[0] for why in told.values()] == ["gnc loss: fix believed again"] * (
        before[2] < 1.0
    )


def test_only_gnc_revisits_fixes() -> None:
    window = Window([0.0, 50.0], [1.0, 1.0])
    weighting("robust", robust_loss="cauchy")[0].revisit(window)  # type: ignore[arg-type]
    assert window.weights() == [1.0, 1.0]
