"""The second terramechanics: other laws on the same measured plate, and physics in it as in the first."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.twin.effects.alternative_terramechanics import (
    PLATE_M,
    hyperbolic_share,
    reece_modulus,
    second_terramechanics,
)
from terrafusion.twin.model.dynamics import rhs
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.physics.layout import INDEX, STATES
from terrafusion.twin.physics.terramechanics import WheelShape, static_sinkage
from terrafusion.twin.scenario.file import load_scenario
from terrafusion.twin.simulate import simulate_run
from tests.twin.effects.effect_cases import plant, samples, soil

SHORT = dataclasses.replace(load_scenario("figure_eight"), duration_s=20.0)


def derivatives(share: float, states: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    (key,) = second_terramechanics()
    vehicle = plant("loose_sand").vehicle
    return rhs((key,))(states.T, inputs.T, vehicle, soil("loose_sand"), [share]).full().T


@given(
    k_c=st.floats(0.0, 1e5), k_phi=st.floats(1e4, 1e7), n=st.floats(0.2, 1.6), z=st.floats(1e-3, 0.1)
)  # fmt: skip
def test_both_laws_press_alike_on_the_plate(k_c: float, k_phi: float, n: float, z: float) -> None:
    bekker = (k_c / PLATE_M + k_phi) * z**n
    assert float(reece_modulus(k_c, k_phi, n, PLATE_M, n)) * z**n == pytest.approx(bekker, rel=1e-9)


@pytest.mark.parametrize(("n", "deeper"), [(0.5, False), (1.5, True)])
def test_a_wide_wheel_is_borne_better_below_n_of_one_and_worse_above(n: float, deeper: bool) -> None:
    shape = WheelShape(0.175, 0.145)
    bekker = float(static_sinkage(0.0, 1e6, n, 80.0, shape))
    reece = float(static_sinkage(0.0, reece_modulus(0.0, 1e6, n, 0.145, n), n, 80.0, shape))
    assert (reece > bekker) is deeper


@given(x=st.floats(0.02, 1e3))
def test_the_hyperbola_never_shears_harder_than_the_exponential(x: float) -> None:
    assert 0.6 < float(hyperbolic_share(x)) <= 1.0


def test_both_shear_laws_are_as_stiff_at_first_and_as_strong_in_the_end() -> None:
    assert float(hyperbolic_share(0.02)) == pytest.approx(1.0, abs=0.01)
    assert float(hyperbolic_share(1e4)) == pytest.approx(1.0, abs=0.002)
    j = np.linspace(0.0, 3.0, 30001)
    means = [np.trapezoid(tau, j) for tau in (j / (1.0 + j), 1.0 - np.exp(-j))]
    assert float(hyperbolic_share(3.0)) == pytest.approx(means[0] / means[1], rel=1e-6)


def test_a_share_of_zero_leaves_the_first_laws() -> None:
    states, inputs = samples()
    vehicle = plant("loose_sand").vehicle
    plain = rhs()(states.T, inputs.T, vehicle, soil("loose_sand"), []).full().T
    own = [i for name, i in INDEX.items() if not name.startswith(("command", "play"))]
    np.testing.assert_allclose(derivatives(0.0, states, inputs)[:, own], plain[:, own], rtol=1e-9, atol=1e-9)


def test_derivatives_are_finite_everywhere_and_differ_from_the_first_laws() -> None:
    states, inputs = samples()
    second = derivatives(1.0, states, inputs)
    assert np.isfinite(second).all()
    changed = np.abs(second - derivatives(0.0, states, inputs)).max(axis=0) > 1e-6
    assert {"u", "wheel_speed_front_left"} <= {STATES[i] for i in np.flatnonzero(changed)}


def test_energy_is_never_created() -> None:
    """Work of the motors >= kinetic and potential energy gained since the rest, at every moment."""
    run = simulate_run(SHORT, terrain="loose_sand", slope_deg=5.0, effects=second_terramechanics())
    body = load_vehicle("elevate").body
    u, v, r, x, work = (run.states[:, INDEX[name]] for name in ("u", "v", "r", "x", "motor_work"))
    kinetic = 0.5 * body.mass_kg * (u**2 + v**2) + 0.5 * body.yaw_inertia_kgm2 * r**2
    potential = body.mass_kg * GRAVITY_MPS2 * np.sin(np.radians(5.0)) * (x - x[0])
    assert potential.max() > 10.0
    assert (work - work[0] - (kinetic - kinetic[0]) - potential > -1e-3).all()


def test_a_robot_on_a_slope_slips_otherwise_than_by_the_first_laws() -> None:
    steep = dataclasses.replace(load_scenario("straight"), duration_s=20.0)
    first, second = (
        simulate_run(steep, terrain="loose_sand", slope_deg=8.0, effects=effects, noiseless=True)
        for effects in (None, second_terramechanics())
    )
    slips = [run.slip[run.t_s > 10.0].mean() for run in (first, second)]
    assert 0.0 < min(slips) < max(slips) < 1.0
    assert slips[1] > slips[0] + 0.05


def test_left_and_right_are_alike() -> None:
    scenario = dataclasses.replace(load_scenario("straight"), duration_s=10.0)
    run = simulate_run(scenario, terrain="medium_sand", effects=second_terramechanics(), noiseless=True)
    assert np.abs(run.states[:, INDEX["yaw"]]).max() < 1e-9
