"""Derivatives of runs against central differences, and what must hold of them exactly."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.twin.engine.integrate import compiled, integrate
from terrafusion.twin.engine.sensitivity import Directions, integrate_with_sensitivity
from terrafusion.twin.model.library import known_names
from terrafusion.twin.model.plant import Plant, RouteTable, SoilField
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vectors import soil_vector, vehicle_vector
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.physics.layout import INDEX, SOIL_PARAMETERS, STATES, VEHICLE_PARAMETERS
from terrafusion.twin.scenario.commands import delayed_inputs

DT_S = 0.01
needs_compiler = pytest.mark.skipif(not compiled(), reason="no C compiler")
CASES = [((name,), False) for name in known_names("soils")]
CASES += [(("asphalt", "loose_sand"), False), (("loose_sand", "mud"), True)]
BACKENDS = ["vm", pytest.param("c", marks=needs_compiler)]


def inputs(seconds: float = 6.0) -> np.ndarray:
    """Off from rest, a turn left and one right, a stop, and off again, backwards."""
    t = np.arange(round(seconds / DT_S) + 1) * DT_S
    speed = np.interp(t, [0.0, 1.0, 3.5, 4.0, 4.6, seconds], [0.0, 6.0, 6.0, 0.0, 0.0, -3.0])
    turn = 0.3 * np.sin(2.0 * np.pi * t / 3.0)
    return delayed_inputs(np.stack([speed * (1.0 - turn), speed * (1.0 + turn)], axis=1), DT_S, 0.013)


def plant(*soils: str, varied: bool = False) -> Plant:
    """Elevate on a slope, over grounds that change after 1 m."""
    table = np.array([soil_vector(load_soil(name)) for name in soils])
    at = np.array([0.8, 1.4])[: len(soils)]
    rng, response = np.random.default_rng(5), np.zeros(len(SOIL_PARAMETERS))
    for name, value in (("k_phi", 0.7), ("friction_cap", 0.4), ("shear_modulus_m", -0.5)):
        response[SOIL_PARAMETERS.index(name)] = value
    grids = rng.normal(0.0, 0.2, (6, 5)), rng.uniform(0.0, 0.5, (6, 5))
    field = SoilField(0.4, grids[0], response, grids[1], soil_vector(load_soil("loose_sand")))
    vehicle = vehicle_vector(load_vehicle("elevate"), slope_rad=0.05, aspect_rad=0.7)
    return Plant(vehicle, RouteTable("travel", at, table, field if varied else None))


def start() -> np.ndarray:
    x0 = np.zeros(len(STATES))
    x0[INDEX["yaw"]] = 0.2
    return x0


def along(p: Plant) -> tuple[tuple[str, ...], Directions]:
    """One direction for a start, for six of the vehicle's numbers and for four of each soil."""
    starts, vehicles = (
        ("yaw", "u"),
        ("mass_kg", "wheelbase_m", "radius_m", "lag_s", "cg_height_m", "dead_time_s"),
    )
    soils = ("k_phi", "exponent", "shear_modulus_m", "friction_cap")
    names = (*starts, *vehicles, *(f"{n} {k}" for k in range(len(p.route.at)) for n in soils))
    d = Directions.zeros(p, len(names))
    for m, name in enumerate(names):
        if name in starts:
            d.start[INDEX[name], m] = 1.0
        elif name in vehicles:
            i = VEHICLE_PARAMETERS.index(name)
            d.vehicle[i, m] = p.vehicle[i] if p.vehicle[i] != 0.0 else 1.0
        else:
            i, k = SOIL_PARAMETERS.index(name.split()[0]), int(name.split()[1])
            d.soil[k, i, m] = p.route.soil[k, i]
    return names, d


def shifted(p: Plant, d: Directions, m: int, step: float) -> tuple[np.ndarray, Plant]:
    """Start and plant, moved by `step` along direction m."""
    effects = {name: p.effects.get(name, 0.0) + step * values[m] for name, values in d.effects.items()}
    route = dataclasses.replace(p.route, soil=p.route.soil + step * d.soil[..., m])
    moved = Plant(p.vehicle + step * d.vehicle[:, m], route, {**p.effects, **effects})
    return start() + step * d.start[:, m], moved


def difference(p: Plant, d: Directions, m: int, step: float) -> np.ndarray:
    """Derivative by central differences, extrapolated from two steps (fourth order)."""

    def central(h: float) -> np.ndarray:
        ends = [integrate(x0, inputs(), DT_S, moved, substeps=3) for x0, moved in
                (shifted(p, d, m, h), shifted(p, d, m, -h))]  # fmt: skip
        return (ends[0] - ends[1]) / (2.0 * h)

    return (4.0 * central(0.5 * step) - central(step)) / 3.0


@needs_compiler
@pytest.mark.parametrize(("soils", "varied"), CASES)
def test_derivatives_meet_central_differences(soils, varied) -> None:
    """With a turn, a stop and a way back; each state by its own largest derivative."""
    p = plant(*soils, varied=varied)
    names, d = along(p)
    _, tangents = integrate_with_sensitivity(start(), inputs(), DT_S, p, d, substeps=3)
    # A large step bends, a small one costs digits; in a field it must keep the wheels within its cells, where
    # its gradient does not jump.
    steps, allowed = ((1e-6, 1e-5), 2e-5) if varied else ((1e-6, 1e-5, 1e-4, 1e-3), 1e-6)
    for m, name in enumerate(names):
        errors = []
        for step in steps:
            expected = difference(p, d, m, step)
            scale = np.abs(expected).max(axis=0) + 1e-6 * np.abs(expected).max()
            errors.append((np.abs(tangents[:, :, m] - expected) / scale).max())
        assert min(errors) < allowed, name


@needs_compiler
@pytest.mark.parametrize(("soils", "varied"), [(("mud",), False), (("loose_sand", "mud"), True)])
def test_the_virtual_machine_gives_the_same_derivatives(soils, varied) -> None:
    """The first 3 s, over the border of the grounds."""
    p = plant(*soils, varied=varied)
    _, d = along(p)
    of = {
        b: integrate_with_sensitivity(start(), inputs()[:301], DT_S, p, d, backend=b, substeps=3)
        for b in ("c", "vm")
    }
    for c, vm in zip(of["c"], of["vm"], strict=True):
        scale = np.abs(vm).max(axis=0) + 1e-9
        assert (np.abs(c - vm) / scale).max() < 1e-9


@pytest.mark.parametrize("backend", BACKENDS)
def test_states_are_those_of_the_plain_run_and_nothing_changes_along_nothing(backend) -> None:
    p = plant("asphalt", "loose_sand", varied=True)
    few = inputs(2.0)
    states, tangents = integrate_with_sensitivity(
        start(), few, DT_S, p, Directions.zeros(p, 3), backend=backend
    )
    np.testing.assert_array_equal(states, integrate(start(), few, DT_S, p, backend=backend))
    assert tangents.shape == (len(few), len(STATES), 3)
    assert not tangents.any()


@needs_compiler
def test_derivatives_are_linear_in_the_direction_and_independent_of_their_number() -> None:
    """19 directions take more than one block; weights 3 and -2 join two of them."""
    p, weights = plant("asphalt", "loose_sand"), np.array([3.0, -2.0])
    _, d = along(p)
    many = [np.concatenate([a, a, a], axis=-1)[..., :19] for a in (d.start, d.vehicle, d.soil)]
    _, tangents = integrate_with_sensitivity(start(), inputs(3.0), DT_S, p, Directions(*many))
    _, joined = integrate_with_sensitivity(
        start(), inputs(3.0), DT_S, p, Directions(*((a[..., 2:4] @ weights)[..., None] for a in many))
    )
    expected = tangents[..., 2:4] @ weights
    np.testing.assert_allclose(joined[..., 0], expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_array_equal(tangents[..., d.count :], tangents[..., : 19 - d.count])


@needs_compiler
def test_every_so_many_th_sample_is_what_it_is_among_all() -> None:
    p = plant("loose_sand")
    _, d = along(p)
    whole = integrate_with_sensitivity(start(), inputs(1.0), DT_S, p, d)
    some = integrate_with_sensitivity(start(), inputs(1.0), DT_S, p, d, every=7)
    for a, b in zip(whole, some, strict=True):
        np.testing.assert_array_equal(a[::7], b)


def test_misshapen_directions_are_named() -> None:
    p = plant("loose_sand")
    d = dataclasses.replace(Directions.zeros(p, 2), vehicle=np.zeros((3, 2)))
    with pytest.raises(ValueError, match="'vehicle' have shape"):
        integrate_with_sensitivity(start(), inputs(1.0), DT_S, p, d)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_derivative_that_diverges_names_its_time(backend) -> None:
    p = plant("loose_sand")
    few = inputs(1.0)
    few[50:] = np.nan
    with pytest.raises(TerrafusionError, match=r"t = 0\.500 s.*diverged"):
        integrate_with_sensitivity(start(), few, DT_S, p, Directions.zeros(p, 1), backend=backend)
