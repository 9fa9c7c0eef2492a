"""The detector on drives of the twin, and its promises to the estimator."""

from __future__ import annotations

import dataclasses
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.fusion.noise.policy import load_policy
from terrafusion.fusion.terrain.classifier import TerrainModel, load_terrain_model
from terrafusion.fusion.terrain.detector import TerrainDetector
from terrafusion.fusion.terrain.features import MIN_SPEED_MPS, Window
from terrafusion.fusion.training.detector_scores import LabelledRoute, changes_in, evaluate, splice
from terrafusion.fusion.training.simulated_runs import Condition, Grid, windows_of
from terrafusion.fusion.training.train_detector import TrainingPlan, calibrate, run_windows, train
from terrafusion.twin.executors import Workers
from terrafusion.twin.simulate import simulate

CLASSES = load_policy().names()
MODEL = load_terrain_model()


@pytest.fixture(scope="module")
def route() -> LabelledRoute:
    """Patches of eight drives with a seed that neither training, calibration nor scoring use."""
    grid = Grid(("figure_eight",), (0.0, 3.0), (15.0,), (77,))
    return splice(run_windows(grid.conditions(), Workers(None), None, lambda: None), patches=30, seed=77)


def window(seed: int = 0, **changes: float | None) -> Window:
    rng = np.random.default_rng(seed)
    plain = Window(
        dt_s=0.5, imu_t_s=np.arange(100) / 100.0, gyro_radps=0.1 * rng.normal(size=(100, 3)),
        accel_mps2=rng.normal(size=(100, 3)), wheel_speed_mps=1.0, wheel_speed_rate_mps2=0.0, speed_mps=0.9,
        yaw_rate_wheels_radps=0.0, yaw_rate_gyro_radps=0.0, slip=0.1, slip_sigma=0.04,
    )  # fmt: skip
    return dataclasses.replace(plain, **changes)  # type: ignore[arg-type]


def test_grounds_are_told_apart_and_changes_seen_within_two_seconds(route: LabelledRoute) -> None:
    scores = evaluate([(MODEL, route)])
    assert scores.macro_f1 > 0.95
    assert scores.ece < 0.05
    assert scores.unknown_share < 0.05
    assert scores.switch_delay_s[1] <= 2.0
    assert scores.switches_missed == 0.0
    assert scores.false_switches_per_min < 0.5
    assert scores.update_ms < 2.0


def test_grounds_are_told_apart_without_slip(route: LabelledRoute) -> None:
    windows = [dataclasses.replace(w, slip=None, slip_sigma=None) for w in route.windows]
    assert evaluate([(MODEL, dataclasses.replace(route, windows=windows))]).macro_f1 > 0.9


def test_a_ground_left_out_of_the_model_becomes_unknown(route: LabelledRoute) -> None:
    fewer = {name: mixture for name, mixture in MODEL.classes.items() if name != "asphalt"}
    labels = np.where(route.labels == "asphalt", "unknown", route.labels)
    scores = evaluate(
        [(dataclasses.replace(MODEL, classes=fewer), dataclasses.replace(route, labels=labels))]
    )
    assert scores.confusion[-1][-1] > 0.8


def test_the_twins_own_route_over_five_grounds() -> None:
    recording = simulate("mixed_terrain", seed=77)
    stream = Condition("mixed_terrain", "mixed", 0.0, 0.0, 77).stream("estimator")
    scores = evaluate([(MODEL, changes_in(*windows_of(recording, stream)))])
    assert scores.macro_f1 > 0.9
    assert scores.switch_delay_s[2] <= 3.0


def test_training_on_a_few_drives_tells_held_out_ones() -> None:
    plan = TrainingPlan(
        seeds=1, scenarios=("staircase", "figure_eight"), slopes_deg=(0.0,), payloads_kg=(0.0,)
    )
    ticks: list[None] = []
    model, scores = train(plan, lambda: ticks.append(None))
    assert len(ticks) == plan.runs() == 24
    assert scores.macro_f1 > 0.85
    assert set(model.classes) == {"asphalt", "medium_sand", "loose_sand", "mud"}
    assert model.scores["macro_f1"] == round(scores.macro_f1, 4)


def test_calibration_cools_a_model_that_is_too_sure(route: LabelledRoute) -> None:
    sure = {name: dataclasses.replace(m, covariance=0.3 * m.covariance) for name, m in MODEL.classes.items()}
    calibrated = calibrate(dataclasses.replace(MODEL, classes=sure), route)
    assert calibrated.temperature > MODEL.temperature
    assert evaluate([(calibrated, route)]).unknown_share < 0.1


@given(st.lists(st.tuples(st.integers(0, 5), st.floats(-2.0, 3.0), st.floats(0.0, 2.0)), max_size=6))
def test_probabilities_sum_to_one(steps: list[tuple[int, float, float]]) -> None:
    detector = TerrainDetector(MODEL, CLASSES)
    for seed, slip, dt in steps:
        p = detector.update(window(seed, slip=slip, dt_s=dt))
        assert np.isfinite(p).all()
        assert (p > 0).all()
        assert p.sum() == pytest.approx(1.0, abs=1e-12)


def test_standing_keeps_the_class() -> None:
    detector = TerrainDetector(MODEL, CLASSES)
    for seed in range(5):
        before = detector.update(window(seed))
    for _ in range(1000):
        after = detector.update(window(wheel_speed_mps=0.0, speed_mps=0.01))
    assert np.array_equal(after, before)


def test_a_camera_is_evidence_but_not_proof() -> None:
    detector = TerrainDetector(MODEL, CLASSES)
    mud = CLASSES.index("mud")
    start = detector.probabilities
    once = detector.fuse(np.eye(len(CLASSES))[mud])
    assert once.argmax() == mud
    assert once[mud] < 0.6
    assert detector.fuse(np.ones(len(CLASSES))) == pytest.approx(once, abs=1e-4)
    assert start == pytest.approx(np.full(len(CLASSES), 0.2))


def test_a_lying_camera_is_mostly_outvoted_by_the_ground(route: LabelledRoute) -> None:
    detector = TerrainDetector(MODEL, CLASSES)
    right = []
    for w, label in zip(route.windows[:800], route.labels, strict=False):
        true = CLASSES.index(str(label))
        detector.fuse(np.eye(len(CLASSES))[(true + 1) % len(CLASSES)])
        p = detector.update(w)
        if w.ground_speed_mps() > MIN_SPEED_MPS:
            right.append(p.argmax() == true)
    assert len(right) > 200
    assert np.mean(right) > 0.85


@pytest.mark.parametrize(
    "odd", [[0.5, 0.5], [np.nan] * 5, [-1.0, 1.0, 1.0, 0.0, 0.0], [0.0] * 5, [np.inf, 0, 0, 0, 0]]
)
def test_what_is_no_probability_is_refused(odd: list[float]) -> None:
    with pytest.raises(DataError, match="class probabilities"):
        TerrainDetector(MODEL, CLASSES).fuse(odd)


def test_classes_only_a_camera_knows_are_allowed() -> None:
    classes = (*CLASSES, "ice")
    detector = TerrainDetector(MODEL, classes)
    for seed in range(3):
        detector.update(window(seed))
    for _ in range(30):
        p = detector.fuse(np.eye(6)[5])
    assert p.argmax() == 5
    with pytest.raises(ConfigError, match="unknown"):
        TerrainDetector(MODEL, ("asphalt", "mud"))
    with pytest.raises(ConfigError, match="differ"):
        TerrainDetector(MODEL, ("mud", "mud", "unknown"))


def best_time_s(model: TerrainModel, w: Window) -> float:
    detector = TerrainDetector(model, CLASSES)
    times = []
    for _ in range(100):
        begin = time.process_time()
        detector.update(w)
        times.append(time.process_time() - begin)
    return float(np.median(times))


def test_one_update_is_cheap() -> None:
    # 0.2 ms on an idle core; the bound leaves room for a busy one.
    assert best_time_s(MODEL, window()) < 2e-3
