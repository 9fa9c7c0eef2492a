"""The classifier of a robot's own grounds by the spectrum of vibration."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.terrain.classifier import LikelihoodTable, TerrainModel
from terrafusion.fusion.terrain.features import Window
from terrafusion.fusion.terrain.spectrum import BANDS_HZ, FLOOR, LEVELS, band_levels
from terrafusion.fusion.training.spectrum_fit import fit_spectrum
from terrafusion.fusion.training.train_detector import draft, features_of


def window(seed: int, rate_hz: float = 100.0, tone: tuple[int, float] | None = None, **fields: Any) -> Window:
    """Noise on all axes, and on one of six axes a tone of so many hertz."""
    n = int(rate_hz)
    t_s = np.arange(n) / rate_hz
    signals = 0.1 * np.random.default_rng(seed).normal(size=(n, 6))
    if tone is not None:
        signals[:, tone[0]] += np.sin(2.0 * np.pi * tone[1] * t_s)
    known = {"wheel_speed_mps": 1.0, "speed_mps": 1.0, "yaw_rate_wheels_radps": None} | fields
    return Window(
        dt_s=0.5, imu_t_s=t_s, gyro_radps=signals[:, :3], accel_mps2=signals[:, 3:],
        wheel_speed_rate_mps2=0.0, yaw_rate_gyro_radps=0.0, **known,
    )  # fmt: skip


def tones(axis: int, hz: float, count: int = 120) -> list[Window]:
    return [window(1000 * axis + seed, tone=(axis, hz)) for seed in range(count)]


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("band", range(1, len(BANDS_HZ)))
def test_a_tone_raises_the_level_of_its_axis_and_band(axis: int, band: int) -> None:
    hz = float(np.mean(BANDS_HZ[band]))
    raised = band_levels(window(1, tone=(axis, hz))) - band_levels(window(1))
    assert int(np.argmax(raised)) == 6 * band + axis


def test_levels_are_those_at_1_mps() -> None:
    slow, fast = (band_levels(window(2, speed_mps=v, wheel_speed_mps=v)) for v in (0.5, 2.0))
    assert slow - fast == pytest.approx(np.full(LEVELS, 0.5 * np.log10(4.0)))


def test_bands_above_a_slow_imu_and_missing_samples_are_unknown() -> None:
    slow = band_levels(window(3, rate_hz=30.0)).reshape(len(BANDS_HZ), 6)
    assert np.isfinite(slow).all(axis=1).tolist() == [2.1 * high <= 30.0 for _, high in BANDS_HZ]
    gap = window(3)
    gap.imu_t_s[50:] += 1.0
    assert np.isnan(band_levels(gap)).all()


@pytest.fixture(scope="module")
def model() -> TerrainModel:
    """Of two grounds that shake as strongly, one in roll, one along x: the shipped features add x to y."""
    made = {"cobbles": tones(3, 8.0), "track": tones(4, 8.0)}
    levels = {ground: np.array([band_levels(w) for w in windows]) for ground, windows in made.items()}
    fitted = draft({ground: features_of(windows) for ground, windows in made.items()}, "husky")
    return TerrainModel(
        fitted.classes, fitted.unknown, 2.0, 25.0, fitted.vehicles, spectrum=fit_spectrum(levels)
    )


def evidence(model: TerrainModel, one: Window) -> Array:
    return LikelihoodTable(model, ("track", "unknown", "cobbles")).of_window(one)


def test_the_spectrum_tells_grounds_apart_that_shake_as_strongly(model: TerrainModel) -> None:
    for seed in range(500, 510):
        assert int(np.argmax(evidence(model, window(seed, tone=(3, 8.0))))) == 2
        assert int(np.argmax(evidence(model, window(seed, tone=(4, 8.0))))) == 0


def test_what_shakes_like_no_ground_is_unknown(model: TerrainModel) -> None:
    strong = window(7, tone=(3, 8.0))
    strong.accel_mps2[:] *= 100.0
    assert int(np.argmax(evidence(model, strong))) == 1


def test_without_levels_the_densities_decide(model: TerrainModel) -> None:
    one = window(8)
    one.imu_t_s[50:] += 1.0
    one.slip, one.slip_sigma = 0.1, 0.01
    table = LikelihoodTable(model, ("track", "unknown", "cobbles"))
    found = table.of_window(one)
    assert np.isfinite(found).all()
    assert found[0] == pytest.approx(found[2]), "no ground of the training showed slip"


def test_another_robot_does_not_use_it(model: TerrainModel) -> None:
    assert model.for_vehicle("warthog").spectrum is None


@given(st.lists(st.floats(-10.0, 10.0) | st.just(float("nan")), min_size=LEVELS, max_size=LEVELS))
def test_probabilities_sum_to_one_above_their_floor(levels: list[float]) -> None:
    made = {"a": np.full((9, LEVELS), -1.0), "b": np.full((9, LEVELS), 1.0), "c": np.full((9, LEVELS), 0.0)}
    classifier = fit_spectrum(made)
    assert classifier is not None
    log_p = classifier.log_probabilities(np.array(levels))
    if log_p is None:
        assert np.isnan(levels).all()
        return
    assert np.exp(log_p).sum() == pytest.approx(1.0)
    assert np.exp(log_p).min() >= FLOOR * (1.0 - 1e-9)


def test_grounds_without_a_common_level_have_no_classifier() -> None:
    low, high = np.full((9, LEVELS), np.nan), np.full((9, LEVELS), np.nan)
    low[:, 0], high[:, 1] = 1.0, 1.0
    assert fit_spectrum({"a": low, "b": high}) is None
