"""Dilutions of precision are recognised, and true sigmas have no finding."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.checks import repair, run_checks
from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.recording import Recording
from tests.datasets.checks.test_physical_faults import lively_drive

RNG = np.random.default_rng(5)
TENTHS = RNG.integers(7, 15, 300) / 10


def with_sigma(drive: Recording, flat: np.ndarray, fix: Fix, north: float = 1.0) -> Recording:
    assert drive.gnss is not None
    sigma = np.stack([flat, north * flat, 2.0 * flat], axis=1)
    classes = np.full(len(flat), fix, dtype=np.uint8)
    return dataclasses.replace(drive, gnss=dataclasses.replace(drive.gnss, sigma_enu_m=sigma, fix=classes))


def codes(recording: Recording) -> set[str]:
    return {finding.code for finding in run_checks(recording)}


@pytest.mark.parametrize("fix", [Fix.SINGLE, Fix.DGPS, Fix.FLOAT, Fix.FIXED])
def test_dilutions_are_named(drive: Recording, fix: Fix) -> None:
    assert codes(with_sigma(drive, TENTHS, fix)) == {"sigma-dilution"}


def test_dilutions_are_named_after_a_square_root_of_a_covariance(drive: Recording) -> None:
    assert codes(with_sigma(drive, np.sqrt(TENTHS**2), Fix.SINGLE)) == {"sigma-dilution"}


def test_a_class_that_contradicts_its_sigma_is_named(drive: Recording) -> None:
    assert codes(with_sigma(drive, np.full(300, 0.9), Fix.FIXED)) == {"sigma-dilution"}


@pytest.mark.parametrize(
    ("flat", "north"),
    [
        (np.full(300, 1.5), 1.0),  # a driver's constant
        (RNG.uniform(0.7, 1.5, 300), 1.0),  # a receiver's own estimate
        (TENTHS, 1.2),  # not the same to the east and to the north
        (TENTHS / 10, 1.0),  # centimetres in steps of one
    ],
)
def test_true_sigmas_have_no_finding(drive: Recording, flat: np.ndarray, north: float) -> None:
    assert codes(with_sigma(drive, flat, Fix.SINGLE, north)) == set()


def test_the_repair_multiplies_by_the_usual_sigma_of_the_class(drive: Recording) -> None:
    repaired, done = repair(with_sigma(drive, TENTHS, Fix.SINGLE))
    assert [finding.code for finding in done] == ["sigma-dilution"]
    assert repaired.gnss is not None
    np.testing.assert_allclose(repaired.gnss.sigma_enu_m[:, 0], 3.0 * TENTHS)
    np.testing.assert_allclose(repaired.gnss.sigma_enu_m[:, 2], 6.0 * TENTHS)
    assert repair(repaired) == (repaired, [])


def test_what_would_change_nothing_is_no_repair(drive: Recording) -> None:
    (found,) = run_checks(with_sigma(drive, TENTHS, Fix.DGPS))
    assert found.repair is None


def test_fixes_that_scatter_as_they_claim_claim_metres() -> None:
    good = lively_drive()
    assert good.gnss is not None
    noise = np.random.default_rng(6).normal(0.0, 0.4, good.gnss.enu_m.shape)
    noisy = dataclasses.replace(good, gnss=dataclasses.replace(good.gnss, enu_m=good.gnss.enu_m + noise))
    claims = with_sigma(noisy, np.full(len(good.gnss), 0.4), Fix.FIXED)
    assert "sigma-dilution" not in codes(claims)
    assert "sigma-dilution" in codes(with_sigma(good, np.full(len(good.gnss), 0.4), Fix.FIXED))


def test_a_few_wild_fixes_do_not_make_the_sigmas_too_small() -> None:
    good, rng = lively_drive(), np.random.default_rng(7)
    assert good.gnss is not None
    sigma_m, noise = np.full(len(good.gnss), 0.1), rng.normal(0.0, 0.1, good.gnss.enu_m.shape)
    wild = np.where(rng.random((len(sigma_m), 1)) < 0.06, rng.normal(0.0, 12.0, noise.shape), 0.0)

    def found(errors: np.ndarray) -> set[str]:
        gnss = dataclasses.replace(good.gnss, enu_m=good.gnss.enu_m + errors)
        return codes(with_sigma(dataclasses.replace(good, gnss=gnss), sigma_m, Fix.SINGLE))

    assert "sigma-too-small" not in found(noise + wild)
    assert "sigma-too-small" in found(8.0 * noise)
