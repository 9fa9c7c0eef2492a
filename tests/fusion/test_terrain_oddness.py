"""Ground between the known ones: told by its windows on average, not by any one of them."""

from __future__ import annotations

import dataclasses
from statistics import mean

import numpy as np
import pytest

from terrafusion.fusion.terrain.classifier import LEAST_SEEN, LikelihoodTable, load_terrain_model
from terrafusion.fusion.terrain.detector import ODD_WINDOWS, TerrainDetector
from terrafusion.fusion.terrain.drives import windows_of
from terrafusion.fusion.terrain.features import FEATURES, MIN_SPEED_MPS, Window, extract
from terrafusion.fusion.weights.policy import load_policy
from terrafusion.twin.simulate import simulate

CLASSES = load_policy().names()
MODEL = load_terrain_model()
TABLE = LikelihoodTable(MODEL, CLASSES)
NONE = np.zeros(len(FEATURES))


def drive_on(terrain: str, seed: int = 91) -> list[Window]:
    recording = simulate("staircase", seed=seed, terrain=terrain)
    windows, _ = windows_of(recording, np.random.default_rng(seed))
    return [w for w in windows if w.ground_speed_mps() > MIN_SPEED_MPS]


def unknown_share(windows: list[Window], detector: TerrainDetector | None = None) -> float:
    detector = detector or TerrainDetector(MODEL, CLASSES)
    named = [CLASSES[int(np.argmax(detector.update(w)))] for w in windows]
    return mean(name == "unknown" for name in named[2 * ODD_WINDOWS :])


@pytest.mark.parametrize("ground", list(MODEL.classes))
def test_oddness_is_the_squared_distance_over_the_features_seen(ground: str) -> None:
    mixture = MODEL.classes[ground]
    k = int(np.argmax(mixture.log_weight))
    centre, root = mixture.mean[k], np.linalg.cholesky(mixture.covariance[k])
    assert TABLE.oddness(centre, NONE) < 0.5
    rng = np.random.default_rng(4)
    drawn = [TABLE.oddness(centre + root @ rng.normal(size=len(FEATURES)), NONE) for _ in range(400)]
    assert 0.8 < mean(drawn) <= 1.1  # of the likeliest Gaussian, which may be another, nearer one
    assert TABLE.oddness(centre + 20.0 * root @ np.ones(len(FEATURES)), NONE) > 10.0


def test_few_features_do_not_tell() -> None:
    values = np.zeros(len(FEATURES))
    values[LEAST_SEEN - 1 :] = np.nan
    assert np.isnan(TABLE.oddness(values, NONE))
    assert np.isnan(
        LikelihoodTable(MODEL.for_vehicle("husky"), CLASSES).oddness(np.zeros(len(FEATURES)), NONE)
    )


@pytest.mark.parametrize("terrain", ["snow", "gravel"])
def test_ground_that_no_class_has_becomes_unknown(terrain: str) -> None:
    windows = drive_on(terrain)
    assert unknown_share(windows) > 0.7
    without = dataclasses.replace(MODEL, odd_limit=1e6)
    assert unknown_share(windows, TerrainDetector(without, CLASSES)) < 0.2


@pytest.mark.parametrize("terrain", list(MODEL.classes))
def test_known_ground_stays_known(terrain: str) -> None:
    assert unknown_share(drive_on(terrain)) < 0.05


def test_the_last_windows_are_part_of_the_state() -> None:
    windows = drive_on("grass")
    whole, first = TerrainDetector(MODEL, CLASSES), TerrainDetector(MODEL, CLASSES)
    for w in windows[:30]:
        whole.update(w)
        first.update(w)
    second = TerrainDetector(MODEL, CLASSES)
    second.restore(first.state())
    for w in windows[30:]:
        np.testing.assert_array_equal(whole.update(w), second.update(w))
    assert whole.state() == second.state()


def test_windows_without_what_tells_leave_the_judgement_as_it_is() -> None:
    detector, windows = TerrainDetector(MODEL, CLASSES), drive_on("grass")
    for w in windows[:60]:
        detector.update(w)
    before = detector.state()["odd"]
    blind = dataclasses.replace(
        windows[60], imu_t_s=np.empty(0), gyro_radps=np.empty((0, 3)), accel_mps2=np.empty((0, 3))
    )
    assert np.isfinite(extract(blind)[0]).sum() < LEAST_SEEN
    detector.update(blind)
    assert detector.state()["odd"] == before
