"""The classifier of a robot's own grounds by the spectrum of vibration."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.fusion.terrain.change_alarm import ChangeAlarm
from terrafusion.fusion.terrain.classifier import LikelihoodTable, TerrainModel, load_terrain_model
from terrafusion.fusion.terrain.detector import TerrainDetector
from terrafusion.fusion.terrain.features import BANDS_HZ, Window
from terrafusion.fusion.terrain.spectrum import FLOOR, LEVELS, log_probabilities
from terrafusion.fusion.training.spectrum_fit import alarm_precision, fit_spectrum
from terrafusion.fusion.training.train_detector import draft, features_of, write_model


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
    raised = window(1, tone=(axis, hz)).bands - window(1).bands
    assert int(np.argmax(raised)) == 6 * band + axis


def test_levels_are_those_at_1_mps() -> None:
    slow, fast = (window(2, speed_mps=v, wheel_speed_mps=v).bands for v in (0.5, 2.0))
    assert slow - fast == pytest.approx(np.full(LEVELS, 0.5 * np.log10(4.0)))


def test_bands_above_a_slow_imu_and_missing_samples_are_unknown() -> None:
    slow = window(3, rate_hz=30.0).bands.reshape(len(BANDS_HZ), 6)
    assert np.isfinite(slow).all(axis=1).tolist() == [2.1 * high <= 30.0 for _, high in BANDS_HZ]
    gap = window(3)
    gap.imu_t_s[50:] += 1.0
    assert np.isnan(gap.bands).all()


@pytest.fixture(scope="module")
def model() -> TerrainModel:
    """Of two grounds that shake as strongly, one in roll, one along x: the shipped features add x to y."""
    made = {"cobbles": tones(3, 8.0), "track": tones(4, 8.0)}
    levels = {ground: np.array([w.bands for w in windows]) for ground, windows in made.items()}
    fitted = draft({ground: features_of(windows) for ground, windows in made.items()}, "husky")
    return TerrainModel(
        fitted.classes, fitted.unknown, 2.0, 25.0, fitted.vehicles, spectrum=fit_spectrum(levels)
    )


def evidence(model: TerrainModel, one: Window) -> Array:
    assert model.spectrum is not None
    table = LikelihoodTable(model, ("track", "unknown", "cobbles"))
    return table.of_window(one, model.spectrum.log_odds(one))


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
    found = evidence(model, one)
    assert np.isfinite(found).all()
    assert found[0] == pytest.approx(found[2]), "no ground of the training showed slip"


def test_another_robot_does_not_use_it(model: TerrainModel) -> None:
    assert model.for_vehicle("warthog").spectrum is None


@given(st.lists(st.floats(-50.0, 50.0), min_size=2, max_size=9))
def test_probabilities_sum_to_one_above_their_floor(log_odds: list[float]) -> None:
    p = np.exp(log_probabilities(np.array(log_odds)))
    assert p.sum() == pytest.approx(1.0)
    assert p.min() >= FLOOR * (1.0 - 1e-9)


def test_grounds_without_a_common_level_have_no_classifier() -> None:
    low, high = np.full((9, LEVELS), np.nan), np.full((9, LEVELS), np.nan)
    low[:, 0], high[:, 1] = 1.0, 1.0
    assert fit_spectrum({"a": low, "b": high}) is None


def alarms(precision: Array, log_odds: Array) -> list[int]:
    alarm = ChangeAlarm(precision)
    return [i for i, one in enumerate(log_odds) if alarm.raised(one)]


def test_the_alarm_is_raised_at_a_change_and_once() -> None:
    log_odds = 0.1 * np.random.default_rng(0).normal(size=(60, 2))
    log_odds[30:] += 3.0
    precision = np.eye(2) / 0.1**2 / 30.0
    assert alarms(precision, log_odds) == [30]
    assert alarms(precision, log_odds[:30]) == []
    assert alarms(np.zeros((2, 2)), log_odds) == []


def test_false_alarms_come_as_often_as_trained() -> None:
    rng = np.random.default_rng(1)
    runs = [[window(int(s)) for s in rng.integers(0, 1 << 30, 80)] for _ in range(12)]
    levels = np.array([w.bands for run in runs for w in run])
    classifier = fit_spectrum({"even": levels[::2], "odd": levels[1::2]})
    assert classifier is not None
    precision = alarm_precision(classifier, runs[:9])
    fresh = [[window(int(s)) for s in rng.integers(0, 1 << 30, 80)] for _ in range(25)]
    odds = [np.array([classifier.log_odds(w) for w in run]) for run in fresh]
    found = sum(len(alarms(precision, one)) for one in odds)
    assert 1 <= found <= 40  # of 2000 windows, of which 17 are meant to
    assert not alarm_precision(classifier, runs[:1]).any(), "too few to know"


def test_a_detector_begins_anew_after_the_alarm(model: TerrainModel) -> None:
    assert model.spectrum is not None
    precision = alarm_precision(model.spectrum, [tones(3, 8.0), tones(4, 8.0)])
    quick = dataclasses.replace(
        model, temperature=20.0, spectrum=dataclasses.replace(model.spectrum, alarm=precision)
    )
    slow = dataclasses.replace(model, temperature=20.0)
    route = [*tones(3, 8.0, 40), *tones(4, 8.0, 40)]
    named = []
    for one in (quick, slow):
        detector = TerrainDetector(one, ("track", "unknown", "cobbles"))
        found = [int(detector.update(w).argmax()) for w in route]
        assert found[39] == 2
        assert found[-1] == 0
        named.append(found.index(0, 40) - 40)
    assert named[0] <= 1 < named[1]


def test_a_model_file_with_a_broken_classifier_is_refused(model: TerrainModel, tmp_path: Path) -> None:
    path = tmp_path / "model.yaml"
    write_model(dataclasses.replace(model, made_by="a test"), path)
    again = load_terrain_model(path).spectrum
    assert again is not None
    assert model.spectrum is not None
    assert again.weights == pytest.approx(model.spectrum.weights, rel=1e-5)
    text = path.read_text()
    for old, new, what in (
        (
            "alarm:\n    cobbles: [",
            "alarm:\n    gravel: [",
            "'spectrum.alarm' has not the grounds of 'classes'",
        ),
        ("alarm:\n    cobbles: [", "alarm:\n    cobbles: [1.0, ", "'spectrum.alarm' is not square"),
        ("scale: [", "scale: [-", "'spectrum.scale' must be positive"),
    ):
        assert old in text
        path.write_text(text.replace(old, new))
        with pytest.raises(ConfigError, match=what):
            load_terrain_model(path)


def test_classes_that_lack_a_ground_of_the_model_are_refused(model: TerrainModel) -> None:
    with pytest.raises(ConfigError, match="lack cobbles of the terrain model"):
        TerrainDetector(model, ("track", "unknown"))
