"""Ground that varies more along the path than the references' is no gap."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.calibrate.noise import ResidualNoise
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.data.logs import prepared
from terrafusion.twin.gap.infer.detection import detect
from terrafusion.twin.gap.infer.other_drives import learn_offsets
from terrafusion.twin.gap.infer.run_states import learn_state_sigma
from terrafusion.twin.gap.null import evidence as gathering
from terrafusion.twin.gap.null.channel_noise import data_sheet_noise
from terrafusion.twin.gap.null.patchiness import LEAST_RATIO, patchier, with_patches
from terrafusion.twin.gap.null.score import score
from terrafusion.twin.gap.rollout.residuals import (
    LinearisationCache,
    RunResiduals,
    initial_state_sigma,
    run_residuals,
    whitened,
)
from terrafusion.twin.gap.rollout.shared_errors import ChannelNoise
from terrafusion.twin.model.ground import Variation
from terrafusion.twin.model.vehicle import load_vehicle
from tests.twin.gap.runs import DRIVE, run

pytestmark = pytest.mark.usefixtures("fitted_once")

CANDIDATES = Candidates.of(
    ["soil_strength", "motion_resistance", "left_right_friction", "gyro_bias", "wheel_radius", "track_width"]
)
SIGMA = initial_state_sigma(CANDIDATES)


@pytest.fixture(scope="module")
def residuals() -> RunResiduals:
    (log,), model, _ = prepared([run(1)], load_vehicle("elevate"), None)
    return run_residuals(log, LinearisationCache(model, CANDIDATES), [o.channel for o in log.observed])


def drawn(of: RunResiduals, seed: int, patches: float, effect: float) -> RunResiduals:
    """With errors of nothing but white noise, patches of the ground and a gyro bias, typical sizes."""
    rng = np.random.default_rng(seed)
    z = rng.standard_normal((len(of.log.windows), of.by_patch[0].shape[1]))
    bias, errors = 3 + of.states + CANDIDATES.keys.index("gyro_bias/constant"), []
    for observed, by_patch, columns in zip(of.log.observed, of.by_patch, of.columns, strict=True):
        window = np.searchsorted(of.log.windows[1:, 0] * 0.01, 0.5 * (observed.begin_s + observed.end_s))
        error = observed.sigma * rng.standard_normal(len(observed.sigma)) + effect * columns[:, bias]
        errors.append(error + patches * np.einsum("ij,ij->i", by_patch, z[window]))
    return dataclasses.replace(of, error=errors)


@pytest.fixture(scope="module")
def noise(residuals: RunResiduals) -> ChannelNoise:
    """White, of the data sheets' size."""
    return ChannelNoise({channel: ResidualNoise(1.0, (1.0,)) for channel in data_sheet_noise([residuals])})


def test_the_size_of_patches_is_estimated_whatever_the_effect(residuals, noise) -> None:
    """Patches of the true size in judged runs, none in references; a large gyro bias besides."""
    for effect in (0.0, 20.0):
        runs = [drawn(residuals, seed, 0.5, effect) for seed in range(3)]
        runs += [drawn(residuals, 10 + seed, 0.0, 0.0) for seed in range(3)]
        white, factors = with_patches(runs, [whitened(run, noise) for run in runs], 3, noise, SIGMA)
        assert np.all(factors[3:] <= 0.1), factors
        assert 0.35 < np.mean(factors[:3]) < 0.65, factors
        assert patchier(factors, 3) is not None
        for one in white:
            rows = one.rows.astype(float)
            np.testing.assert_allclose(one.gram, rows.T @ rows, rtol=1e-3, atol=0.5)


def test_only_what_goes_beyond_the_references_is_whitened(residuals, noise) -> None:
    runs = [drawn(residuals, seed, size, 0.0) for seed, size in enumerate((0.1, 1.0, 0.5, 0.5, 0.5))]
    plain = [whitened(one, noise) for one in runs]
    white, factors = with_patches(runs, plain, 3, noise, SIGMA)
    assert [a is b for a, b in zip(white, plain, strict=True)] == [True, False, True, True, True]
    assert patchier(factors, 3) is None


def test_patches_are_whitened(residuals, noise) -> None:
    """Errors of patches, far above the noise, become as large as it."""
    mine = drawn(residuals, 3, 1.0, 0.0)
    plain = whitened(mine, noise)
    other = drawn(residuals, 4, 0.0, 0.0)
    (white, _), _ = with_patches([mine, other], [plain, whitened(other, noise)], 1, noise, SIGMA)
    least = float(np.mean(whitened(drawn(residuals, 3, 0.0, 0.0), noise).error ** 2))
    assert float(np.mean(plain.error**2)) > 1.5 * least
    assert float(np.mean(white.error**2)) == pytest.approx(least, rel=0.1)
    np.testing.assert_allclose(white.with_patches(white.error), plain.error, atol=1e-4)


def test_what_varies_more_than_any_ground_is_something_else(residuals, noise) -> None:
    runs = [drawn(residuals, seed, size, 0.0) for seed, size in enumerate((6.0, 0.0))]
    white, factors = with_patches(runs, [whitened(one, noise) for one in runs], 1, noise, SIGMA)
    assert factors[0] == 0.0
    assert not white[0].patch_basis.size


def site(number: int, sigma: float, length_m: float) -> Recording:
    return run(number, drive=dataclasses.replace(DRIVE, variation=Variation(sigma, length_m)))


def p_value() -> tuple[float, gathering.GapEvidence]:
    judged = [site(940 + i, 0.2, 1.0) for i in range(2)]
    references = [site(960 + i, 0.1, 2.5) for i in range(5)]
    found = gathering.gather_evidence(judged, references, load_vehicle("elevate"), None, CANDIDATES, jobs=1)
    sigma = learn_state_sigma(found.references, initial_state_sigma(CANDIDATES))
    offsets = learn_offsets([score(r, sigma) for r in found.references], CANDIDATES.count)
    return detect([score(r, sigma) for r in found.runs], offsets, CANDIDATES, 0).p_value, found


def test_patchier_ground_is_no_gap(monkeypatch: pytest.MonkeyPatch) -> None:
    p, found = p_value()
    assert p > 0.05
    assert any("varies more along the path" in note for note in found.notes)
    monkeypatch.setattr(gathering, "with_patches", lambda runs, white, *_: (white, np.zeros(len(runs))))
    p, found = p_value()
    assert p <= 0.05
    assert not any("varies more along the path" in note for note in found.notes)


def test_ground_is_patchier_only_beyond_every_reference() -> None:
    assert patchier(np.array([0.5, 0.4, 0.1, 0.2, 0.0]), 3) == pytest.approx(0.45 / 0.1)
    assert patchier(np.array([0.5, 0.1, 0.1, 0.2, 0.0]), 3) is None
    assert patchier(np.array([LEAST_RATIO * 0.2 - 0.01, 0.1, 0.2, 0.2]), 3) is None
    assert patchier(np.array([0.5]), 0) is None
