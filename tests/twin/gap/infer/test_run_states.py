"""Scatter of the states from run to run, beside offsets that all runs of the robot share."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from terrafusion.twin.gap.infer.run_states import learn_state_sigma

SAMPLES = 200


def runs(count: int, bias: float, scale: float) -> list[Any]:
    """Runs that turn more to one side than to the other, with a gyro bias that scatters by `bias` and a wrong
    turning law of the given scale; noise of 1 sigma."""
    rng, out = np.random.default_rng(3), []
    for _ in range(count):
        turn = rng.normal(0.0, 0.3) + rng.normal(0.0, 0.5, SAMPLES)
        columns = np.stack([np.ones(SAMPLES), turn], axis=1)
        error = columns @ [bias * rng.normal(), scale] + rng.normal(0.0, 1.0, SAMPLES)
        rows = np.column_stack([columns, error])
        out.append(SimpleNamespace(gram=rows.T @ rows, states=1, residuals=SimpleNamespace(effects=1)))
    return out


@pytest.mark.parametrize("scale", [0.0, 10.0])
@pytest.mark.parametrize("bias", [0.3, 1.0])
def test_the_scatter_is_that_of_the_state(bias: float, scale: float) -> None:
    (sigma,) = learn_state_sigma(runs(30, bias, scale), np.array([0.5]))
    assert sigma == pytest.approx(bias, rel=0.3)


def test_one_reference_leaves_the_first_sigma() -> None:
    assert learn_state_sigma(runs(1, 1.0, 0.0), np.array([0.5])) == pytest.approx([0.5])


@pytest.mark.parametrize(("count", "bias", "sigma"), [(3, 0.4, 1.5), (3, 0.01, 0.4), (30, 0.4, 0.4)])
def test_a_data_sheet_s_sigma_holds_until_the_references_refute_it(
    count: int, bias: float, sigma: float
) -> None:
    """The accelerometers of three runs of a Husky were alike, and the next an `accel_bias`."""
    found = learn_state_sigma(runs(count, bias, 0.0), np.array([0.5]), np.array([1.5]))
    assert found == pytest.approx(sigma, rel=0.3)
    unchanged = learn_state_sigma(runs(count, bias, 0.0), np.array([0.5]), np.array([0.5]))
    assert unchanged == learn_state_sigma(runs(count, bias, 0.0), np.array([0.5]))
