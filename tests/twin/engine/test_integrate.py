"""The two backends, convergence, and what happens when a run diverges."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np
import pytest

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.twin.engine import codegen, compiler, integrate, native
from terrafusion.twin.engine.codegen import SINGLE, Variant
from terrafusion.twin.model.dynamics import rhs
from terrafusion.twin.model.library import known_names
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vectors import soil_vector, vehicle_vector
from terrafusion.twin.model.vehicle import load_vehicle, vehicle_names
from terrafusion.twin.physics.layout import INDEX, INPUTS
from terrafusion.twin.scenario import commands
from terrafusion.twin.scenario.file import load_scenario
from terrafusion.twin.simulate import simulate_run

needs_compiler = pytest.mark.skipif(compiler.find_compiler() is None, reason="no C compiler")
A_MINUTE = dataclasses.replace(load_scenario("mixed_terrain"), duration_s=60.0)


@needs_compiler
def test_compiled_and_interpreted_runs_agree() -> None:
    """60 s over a border of two grounds, with a turn."""
    c, vm = (simulate_run(A_MINUTE, backend=backend).states for backend in ("c", "vm"))
    assert np.abs(c - vm).max() < 1e-9


@pytest.mark.parametrize(("terrain", "slope"), [("loose_sand", 5.0), ("asphalt", 0.0), ("mud", 0.0)])
def test_halving_the_step_changes_almost_nothing(monkeypatch, terrain, slope) -> None:
    whole = integrate.integrate

    def states(substeps: int) -> np.ndarray:
        monkeypatch.setattr(commands, "integrate", lambda *a, **k: whole(*a, **k, substeps=substeps))
        scenario = dataclasses.replace(load_scenario("figure_eight"), duration_s=40.0)
        return simulate_run(scenario, terrain=terrain, slope_deg=slope).states

    default, half = states(3), states(6)
    assert np.abs(default[:, :2] - half[:, :2]).max() < 2e-4
    assert np.abs(default[:, 2] - half[:, 2]).max() < 2e-5


def test_order_of_convergence_is_four_where_inputs_are_smooth(run) -> None:
    t = np.arange(0.0, 5.001, 0.01)
    speed = 2.0 * np.sin(np.pi * t / 5.0) ** 2
    sides = np.stack([speed, 1.5 * speed], axis=1)
    ends = {n: run("medium_sand", sides, substeps=n)[-1, :3] for n in (4, 8, 64)}
    errors = [np.abs(ends[n] - ends[64]).max() for n in (4, 8)]
    assert errors[0] / errors[1] > 10.0


@pytest.mark.parametrize("backend", ["auto", "vm"])
def test_divergence_names_its_time(run, backend) -> None:
    sides = np.zeros((101, 2))
    sides[50:] = np.nan
    with pytest.raises(TerrafusionError, match=r"t = 0\.500 s.*diverged"):
        run("asphalt", sides, backend=backend)


def test_unknown_backend_is_an_error(run) -> None:
    with pytest.raises(TerrafusionError, match="auto, c, vm"):
        run("asphalt", np.zeros((2, 2)), backend="gpu")


def test_without_a_compiler_the_virtual_machine_runs_and_is_named(monkeypatch, caplog) -> None:
    native.forget()
    monkeypatch.setattr(compiler, "find_compiler", lambda: None)
    try:
        short = dataclasses.replace(load_scenario("straight"), duration_s=5.0)
        first, second = simulate_run(short), simulate_run(short)
    finally:
        native.forget()
    assert any("virtual machine" in note for note in first.recording.notes)
    assert sum("no C compiler" in record.message for record in caplog.records) == 1
    assert np.array_equal(first.states, second.states)


@needs_compiler
def test_the_library_is_compiled_once_and_found_again(monkeypatch, tmp_path) -> None:
    monkeypatch.setenv("TERRAFUSION_CACHE", str(tmp_path / "cache"))
    written = []
    source = codegen.source
    monkeypatch.setattr(codegen, "source", lambda variant: written.append(variant) or source(variant))
    for _ in range(2):
        native.forget()
        assert native.driver(Variant(SINGLE, (), True)) is not None
    native.forget()
    assert len(written) == len(list((tmp_path / "cache").glob("*.so"))) == 1


def test_a_library_is_not_remembered_by_names_that_do_not_tell_its_laws() -> None:
    assert codegen.follows_from("single", ["trailer/drag"]) is None
    known = {codegen.follows_from(kind, effects) for kind in "ab" for effects in ([], ["mass/at_cg"])}
    assert len(known) == 4
    assert None not in known


@needs_compiler
def test_a_compiler_that_fails_is_reported_and_replaced(monkeypatch, tmp_path, caplog) -> None:
    monkeypatch.setenv("TERRAFUSION_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(compiler, "FLAGS", ("-no-such-flag",))
    native.forget()
    assert native.driver(Variant(SINGLE, (), True)) is None
    native.forget()
    assert "could not be compiled" in caplog.text


def test_a_route_crosses_its_border_smoothly() -> None:
    states = simulate_run(A_MINUTE, noiseless=True).states
    accelerations = np.diff(states[:, INDEX["u"]]) * 100.0
    assert np.abs(accelerations).max() < 1.5


@needs_compiler
def test_a_home_that_cannot_be_written_still_gets_compiled_code(monkeypatch, tmp_path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    monkeypatch.setenv("TERRAFUSION_CACHE", str(blocked / "cache"))
    native.forget()
    assert native.driver(Variant(SINGLE, (), True)) is not None
    native.forget()


@functools.cache
def jacobian() -> Any:
    """Of the state's rate by the state."""
    import casadi as ca

    f = rhs()
    x, u, p, s = (ca.SX.sym(name, f.size1_in(i)) for i, name in enumerate(("x", "u", "p", "s")))
    return ca.Function("jacobian", [x, u, p, s], [ca.jacobian(f(x, u, p, s, []), x)])


@pytest.mark.parametrize("terrain", known_names("soils"))
@pytest.mark.parametrize("vehicle", vehicle_names())
def test_the_motor_lag_is_the_fastest_mode(terrain, vehicle) -> None:
    """What the step rests on: along a drive with turns and stops, no eigenvalue exceeds 1 / lag."""
    params = load_vehicle(vehicle)
    vectors = vehicle_vector(params), np.tile(soil_vector(load_soil(terrain)), 4)
    states = simulate_run("figure_eight", vehicle=params, terrain=terrain).states[::200]
    rest = np.zeros(len(INPUTS))
    rates = [np.abs(np.linalg.eigvals(np.array(jacobian()(row, rest, *vectors)))).max() for row in states]
    assert max(rates) < 1.01 / params.drive.lag_s
