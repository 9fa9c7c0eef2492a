"""Rotation, scale and their information between points in the plane."""

from __future__ import annotations

import numpy as np
import pytest

from terrafusion.datasets.core.planar_alignment import planar_rotation


def test_planar_rotation_is_exact_for_a_turned_and_scaled_path() -> None:
    z = np.array([0.0, 1.0 + 0.2j, 2.0 - 0.1j, 2.5 + 1.0j])
    turn, information = planar_rotation(
        z, 5.0 - 3.0j + 0.8 * np.exp(2.1j) * z, np.array([1.0, 2.0, 1.0, 3.0])
    )
    assert turn / information == pytest.approx(0.8 * np.exp(2.1j))


def test_equal_weights_are_no_weights() -> None:
    rng = np.random.default_rng(2)
    source = rng.normal(size=20) + 1j * rng.normal(size=20)
    target = source * np.exp(0.4j) + 0.1 * (rng.normal(size=20) + 1j * rng.normal(size=20))
    turn, information = planar_rotation(source, target)
    weighted, same = planar_rotation(source, target, np.ones(20))
    assert turn == pytest.approx(weighted)
    assert information == pytest.approx(same)
