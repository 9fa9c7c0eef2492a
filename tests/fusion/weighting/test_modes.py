"""The modes "robust" and "innovation": their mathematics, and what they do on drives of the twin."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.benchmark.outage_plan import until
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.noise.labels import GroundLabels
from terrafusion.fusion.noise.modes import ModeTuning, NoiseTuning, load_modes
from terrafusion.fusion.noise.policy import load_policy
from terrafusion.fusion.replay import ReplayResult, replay
from terrafusion.fusion.weighting.adaptive import UPDATE_NS, TerrainNoise
from terrafusion.fusion.weighting.innovation import SageHusa, Variational
from terrafusion.fusion.weighting.robust import LEAST_WEIGHT, cauchy_weight, settled, truncated_weights
from terrafusion.fusion.weighting.weighting import InnovationTest
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.simulate import simulate
from tests.studies.mode_tuning import (
    DRIVES,
    MIXED,
    MODE_OF,
    Lesson,
    Training,
    fingerprint,
    loss,
    tune,
    write_modes,
)

METHODS = ("cauchy", "gnc", "sage_husa", "variational")


@pytest.fixture(scope="module")
def whole_sand() -> Recording:
    return simulate("figure_eight", terrain="loose_sand", seed=7)


@pytest.fixture(scope="module")
def sand(whole_sand: Recording) -> Recording:
    return until(whole_sand, 42.0)


@pytest.fixture(scope="module")
def exact() -> Recording:
    """Its first 40 s have turns both ways, and changes of speed."""
    return until(simulate("figure_eight", terrain="asphalt", noiseless=True), 40.0)


def run(recording: Recording, method: str, **options: object) -> ReplayResult:
    mode, variant = MODE_OF[method]
    return replay(recording, mode=mode, settings=variant, **options)  # type: ignore[arg-type]


def surprise(innovation: float, predicted: float, noise: float) -> InnovationTest:
    return InnovationTest(
        0, np.array([innovation]), np.array([predicted]), np.array([noise]), np.array([1.0])
    )


def with_fixes(recording: Recording, error_m: np.ndarray, claimed_m: float | None = None) -> Recording:
    """Fixes moved by `error_m` (n, 2) from 15 s on, claiming another sigma if told to."""
    gnss = recording.gnss
    assert gnss is not None
    enu, sigma = gnss.enu_m.copy(), gnss.sigma_enu_m.copy()
    late = (gnss.t_ns - recording.start_ns) * 1e-9 > 15.0
    enu[late, :2] += error_m[late]
    if claimed_m is not None:
        sigma[:] = claimed_m
    return dataclasses.replace(recording, gnss=dataclasses.replace(gnss, enu_m=enu, sigma_enu_m=sigma))


def errors_m(result: ReplayResult) -> np.ndarray:
    assert result.scores.errors is not None
    return result.scores.errors.distance_m()


@given(st.floats(-5.0, 5.0), st.floats(1e-3, 4.0), st.floats(0.5, 5.0))
def test_the_cauchy_weight_is_at_the_minimum_of_its_loss(nu: float, predicted: float, c: float) -> None:
    """One state seen once: the reweighted update agrees with a search for the least prior + Cauchy cost."""
    if (
        8.0 * predicted > c * c
    ):  # the cost may have two minima where the prior is weaker than the loss is concave
        predicted = c * c / 8.0
    w = cauchy_weight(surprise(nu, predicted, 1.0), c)

    def cost(x: float) -> float:
        return x * x / predicted + c * c * np.log1p((nu - x) ** 2 / c**2)

    best = minimize_scalar(cost, bounds=(-6.0, 6.0), method="bounded", options={"xatol": 1e-9}).x
    assert nu * predicted / (predicted + 1.0 / w) == pytest.approx(best, abs=2e-3)


@given(st.lists(st.floats(0.0, 1e4), min_size=1, max_size=20), st.floats(0.5, 30.0), st.floats(1e-6, 1e6))
def test_gnc_weights_fall_with_the_residual_and_end_as_all_or_nothing(
    squares: list[float], c2: float, mu: float
) -> None:
    r2 = np.sort(squares)
    w = truncated_weights(r2, c2, mu)
    assert ((w >= LEAST_WEIGHT) & (w <= 1.0)).all()
    assert (np.diff(w) <= 1e-9).all()
    clear = (r2 < 0.99 * c2) | (r2 > 1.01 * c2)
    final = truncated_weights(r2, c2, 1e9)
    assert (final[clear] == np.where(r2 < c2, 1.0, LEAST_WEIGHT)[clear]).all()


def test_weights_are_settled_only_where_residuals_agree_and_most_are_believed() -> None:
    r2 = np.array([1.0, 2.0, 50.0])
    assert settled(r2, np.array([1.0, 1.0, LEAST_WEIGHT]), 9.0)
    assert not settled(r2, np.array([1.0, 1.0, 1.0]), 9.0)
    assert not settled(np.array([1.0, 50.0, 50.0]), np.array([1.0, LEAST_WEIGHT, LEAST_WEIGHT]), 9.0)
    assert settled(np.zeros(0), np.zeros(0), 9.0)


@pytest.mark.parametrize("kind", [SageHusa, Variational])
@pytest.mark.parametrize("true_sigma", [0.3, 3.0])
def test_innovations_tell_the_noise_they_were_drawn_with(kind: type, true_sigma: float) -> None:
    rng = np.random.default_rng(3)
    noise = kind(1.0, 300.0, 1e-4, 1e4)
    for _ in range(4000):
        nu = rng.normal() * np.sqrt(true_sigma**2 + 0.05)
        noise.update(surprise(nu, 0.05, noise.value))
    assert np.sqrt(noise.value) == pytest.approx(true_sigma, rel=0.2)


@pytest.mark.parametrize("kind", [SageHusa, Variational])
def test_followed_noise_stays_in_its_bounds(kind: type) -> None:
    noise = kind(1.0, 10.0, 0.25, 4.0)
    for nu, bound in ((100.0, 4.0), (0.0, 0.25)):
        for _ in range(200):
            noise.update(surprise(nu, 0.0, noise.value))
        assert noise.value == bound


@pytest.mark.parametrize("method", METHODS)
def test_exact_data_give_exact_estimates(exact: Recording, method: str) -> None:
    result = run(exact, method)
    assert np.nanmax(errors_m(result)) < 0.01


@pytest.mark.parametrize("method", METHODS)
def test_same_input_gives_the_same_bits(sand: Recording, method: str) -> None:
    begin = until(sand, 20.0)
    first, again = (run(begin, method, outages=[Outage(12.0, 6.0)]).estimate for _ in range(2))
    assert first.trajectory.position_m.tobytes() == again.trajectory.position_m.tobytes()
    assert first.changes == again.changes


@pytest.mark.parametrize("method", ["cauchy", "gnc"])
def test_outliers_hardly_move_the_robust_mode(sand: Recording, method: str) -> None:
    """A fifth of the fixes 30 m off, any way round: each is refused or doubted, with a reason."""
    rng = np.random.default_rng(5)
    assert sand.gnss is not None
    n = len(sand.gnss)
    angle = rng.uniform(0.0, 2.0 * np.pi, n)
    error = 30.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1) * (rng.random(n) < 0.2)[:, None]
    clean, spoilt = run(sand, method), run(with_fixes(sand, error), method)
    assert np.nanmedian(errors_m(spoilt)) < np.nanmedian(errors_m(clean)) + 0.02
    assert np.nanmax(errors_m(spoilt)) < 0.5
    doubted = [c for c in spoilt.estimate.changes if c.sensor == "gnss" and c.after < 0.5]
    assert len(doubted) > 0.05 * n  # the gate refuses others
    assert all("fix doubted" in c.reason and c.after < c.before for c in doubted)


@pytest.mark.parametrize("method", ["sage_husa", "variational"])
def test_innovation_finds_the_noise_of_fixes_that_claim_too_little(
    whole_sand: Recording, method: str
) -> None:
    """They claim 3 m and are 30 m off: the normalised square comes back into its band.

    The scatter seen against dead reckoning does most of this already, in every mode (`inputs/track.py`).
    """
    rng = np.random.default_rng(5)
    assert whole_sand.gnss is not None
    liar = with_fixes(whole_sand, 30.0 * rng.normal(size=(len(whole_sand.gnss), 2)), claimed_m=3.0)

    def late_nis(result: ReplayResult) -> float:
        nis = [i.nis / i.dof for i in result.estimate.innovations if i.sensor == "gnss"]
        return float(np.median(nis[len(nis) // 2 :]))

    wary = load_modes().fixed.gnss_factor ** 2  # the tuned row believes fixes less than they scatter
    assert (
        0.3 < wary * late_nis(run(liar, method)) < 1.5
    )  # the median of chi-square over 2 degrees of freedom is 0.69


def test_unknown_modes_and_variants_are_refused() -> None:
    rig = load_vehicle("husky").rig()
    for settings in ({"mode": "magic"}, {"robust_loss": "huber"}, {"innovation_method": "guess"}):
        with pytest.raises(ConfigError, match="unknown"):
            EstimatorConfig(rig, **settings)  # type: ignore[arg-type]


def test_untuned_fixed_mode_is_the_fixed_noise_of_the_policy(sand: Recording) -> None:
    row = load_policy().fixed
    assert NoiseTuning().applied(row) == row
    untuned = replay(sand, mode="fixed", settings={"tuning": ModeTuning()}).estimate
    assert all(series[0] == getattr(row, name) for name, series in untuned.weights.items())


def test_adaptive_applies_its_factors_to_all_classes(sand: Recording) -> None:
    own, others = (
        ModeTuning(adaptive=NoiseTuning(2.0, 1.5, 3.0)),
        ModeTuning(fixed=NoiseTuning(3.0, 3.0, 3.0)),
    )
    log = until(sand, 25.0)
    plain, moved, same = (replay(log, settings={"tuning": t}).estimate for t in (ModeTuning(), own, others))
    assert plain.trajectory.position_m.tobytes() == same.trajectory.position_m.tobytes()
    np.testing.assert_allclose(moved.weights["gnss_inflation"], 3.0 * plain.weights["gnss_inflation"])
    row, tuned = (
        load_policy().blend([0.2] * 5),
        own.adaptive.applied_to_policy(load_policy()).blend([0.2] * 5),
    )
    assert tuned.wheel_sigma_mps == pytest.approx(2.0 * row.wheel_sigma_mps)
    assert row.slip_sigma < tuned.slip_sigma < 1.5 * row.slip_sigma  # the spread of the means has no factor


def test_a_robot_unknown_to_the_terrain_model_begins_with_the_noise_of_fixed() -> None:
    config = EstimatorConfig(load_vehicle("husky").rig(), "husky")
    fixed, adaptive = TerrainNoise(dataclasses.replace(config, mode="fixed")), TerrainNoise(config)
    assert adaptive.policy.classes["unknown"] == fixed.noise
    assert max(adaptive.posterior(), key=adaptive.posterior().__getitem__) == "unknown"


def test_the_tuning_file_is_read_as_it_was_written(tmp_path: Path) -> None:
    file = tmp_path / "modes.yaml"
    write_modes(load_modes(), file, "a test")
    assert load_modes(file) == load_modes()


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("wheel_c:", "wheel_d:", "unknown key 'cauchy.wheel_d'"),
        ("terrafusion.modes/1", "terrafusion.modes/9", "schema"),
        ("gnc:", "gmc:", "unknown key 'gmc'"),
        ("gnss_factor: ", "gnss_factor: -", "gnss_factor"),
    ],
)
def test_a_wrong_tuning_file_is_refused(tmp_path: Path, old: str, new: str, said: str) -> None:
    file = tmp_path / "modes.yaml"
    write_modes(load_modes(), file, "a test")
    file.write_text(file.read_text().replace(old, new, 1))
    with pytest.raises(ConfigError, match=said):
        load_modes(file)


def test_the_shipped_tuning_was_made_from_these_drives() -> None:
    assert load_modes().inputs_sha256 == fingerprint()
    assert min(drive.seed for drive in (*DRIVES, *MIXED)) >= 1000


def test_tuning_never_makes_the_training_loss_worse() -> None:
    """A search keeps what helps, however long the drive is."""
    lesson = Training("figure_eight", "mud", 0.0, 1002).lesson()
    drives = [Lesson(until(lesson.recording, 17.0), Outage(11.0, 5.0))]
    tuned = tune(drives, ModeTuning(), ["fixed"])
    assert loss(drives, "fixed", tuned) <= loss(drives, "fixed", ModeTuning())


def test_a_robot_the_model_does_not_know_has_the_pooled_noise_until_evidence_comes() -> None:
    """That row was fitted to all grounds, and has the doubt between them in it: it holds to the last bit
    until one is more likely than not."""
    weights, pooled = (
        Estimator.for_vehicle("warthog").weights,
        load_modes().fixed.applied(load_policy().fixed),
    )
    assert weights.noise == pooled
    classes = weights.detector.classes
    sigmas = []
    for i in range(40):
        weights.external(i * UPDATE_NS, {name: float(name == "mud") for name in classes})
        assert (weights.noise == pooled) == (weights.posterior()["mud"] <= 0.5)
        sigmas.append(weights.noise.slip_sigma)
    assert sigmas == sorted(sigmas)
    assert weights.posterior()["mud"] > 0.99
    assert weights.noise.slip_sigma == pytest.approx(weights.policy.classes["mud"].slip_sigma, rel=0.02)


def test_a_label_of_a_ground_is_taken_as_it_is_on_any_robot() -> None:
    config = Estimator.for_vehicle("warthog").config
    told = dataclasses.replace(config, labels=GroundLabels((0,), ("mud",)))
    weights = Estimator(told).weights
    weights.begin(0)
    assert weights.noise == weights.policy.classes["mud"]


def test_on_firm_ground_adaptive_is_as_good_as_fixed() -> None:
    """A robot that the model does not know, on a firm winding drive: its grounds slip alike."""
    log = until(simulate("figure_eight", vehicle="warthog", terrain="asphalt", seed=2), 62.0)
    outage = [Outage(40.0, 20.0)]
    one, other = (replay(log, mode=mode, outages=outage).scores.outages[0] for mode in ("adaptive", "fixed"))
    assert one.end_error_m is not None
    assert other.end_error_m is not None
    assert one.end_error_m < other.end_error_m + 0.05
