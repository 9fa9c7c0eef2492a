"""The benchmark runs, and what it compares keeps its order, with wide margins."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from terrafusion.twin.engine.integrate import compiled, integrate
from terrafusion.twin.engine.lanes import integrate_many
from terrafusion.twin.physics.layout import STATES
from tests.studies import engine_speed as bench

needs_compiler = pytest.mark.skipif(not compiled(), reason="no C compiler")


@needs_compiler
def test_compiled_code_is_worth_its_while() -> None:
    """Ratios of processor time on 10 s of motion; an idle machine has about 70 and 6."""
    plain = bench.single("c", 5, 10.0).cpu_s
    assert bench.single("vm", 1, 10.0).cpu_s > 5.0 * plain
    assert bench.jacobian(5, 10.0).cpu_s < 12.0 * plain


@needs_compiler
def test_runs_side_by_side_take_less_than_one_after_another() -> None:
    """The same runs both ways; measured .64 to .77 of the processor time beside other work."""
    plants, x0 = [bench.plant()] * 32, np.zeros(len(STATES))
    commands = np.array([bench.inputs(10.0, phase) for phase in np.linspace(0.0, 6.0, 32)])
    singly = bench.best(5, lambda: [integrate(x0, u, bench.DT_S, plants[0]) for u in commands])
    together = bench.best(5, lambda: integrate_many(x0, commands, bench.DT_S, plants))
    assert together.cpu_s < singly.cpu_s


def test_the_right_hand_side_given_to_scipy_is_the_twins() -> None:
    """A short Euler step of it meets the integrator's."""
    u, p = bench.inputs(0.01), bench.plant()
    x = np.random.default_rng(0).uniform(0.0, 1e-3, len(STATES))
    step = integrate(x, np.stack([u[0], u[0]]), 1e-7, p, backend="vm")[-1] - x
    np.testing.assert_allclose(step, 1e-7 * bench._plain_rhs()(x, u[0]), rtol=1e-3, atol=1e-13)


@pytest.mark.skipif(importlib.util.find_spec("mujoco") is None, reason="mujoco is not installed")
def test_the_body_given_to_mujoco_drives_as_far_as_its_wheels_turn() -> None:
    line = bench.mujoco_line()
    radius, drove = bench.load_vehicle("elevate").wheel.radius_m, float(line.remark.split()[-2])
    turned = float(bench.inputs(bench.OTHERS_S)[:, :2].mean(axis=1).sum() * bench.DT_S)
    assert drove == pytest.approx(turned * radius, rel=0.1)


def test_a_line_tells_speed_in_real_time() -> None:
    assert "100 x real time" in str(bench.Line("run", 50.0, bench.Took(0.5, 0.4)))
