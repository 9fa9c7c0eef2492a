"""Many runs at once: each is what it is alone, whatever runs beside it."""

from __future__ import annotations

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from terrafusion.twin.effects.catalogue import moves, parameters
from terrafusion.twin.engine import native
from terrafusion.twin.engine.integrate import compiled, integrate
from terrafusion.twin.engine.lanes import integrate_many
from terrafusion.twin.engine.sensitivity import Directions, integrate_with_sensitivity
from terrafusion.twin.model.library import known_names
from terrafusion.twin.model.plant import Plant, RouteTable, SoilField
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vectors import soil_vector, vehicle_vector
from terrafusion.twin.model.vehicle import load_vehicle, vehicle_names
from terrafusion.twin.physics.layout import INDEX, SOIL_PARAMETERS, STATES
from terrafusion.twin.scenario.commands import delayed_inputs

DT_S = 0.01
needs_compiler = pytest.mark.skipif(not compiled(), reason="no C compiler")


def plants() -> list[Plant]:
    """Every soil and vehicle, a border, and a field."""
    vehicles, soils = vehicle_names(), [soil_vector(load_soil(name)) for name in known_names("soils")]
    some = []
    for k in range(max(len(vehicles), len(soils)) + 1):
        vehicle = vehicle_vector(load_vehicle(vehicles[k % len(vehicles)]), slope_rad=0.02 * k)
        some.append(Plant(vehicle, RouteTable("travel", np.zeros(1), soils[k % len(soils)][None])))
    border = RouteTable("travel", np.array([0.3, 0.6]), np.array(soils[:2]))
    response = np.zeros(len(SOIL_PARAMETERS))
    response[SOIL_PARAMETERS.index("friction_cap")] = 1.0
    grid = np.random.default_rng(2).normal(0.0, 0.3, (4, 5))
    field = SoilField(0.5, grid, response, np.abs(grid), soils[-1])
    return [
        *some,
        Plant(some[0].vehicle, border),
        Plant(some[1].vehicle, dataclasses.replace(border, field=field)),
    ]


def commands(count: int, seconds: float = 3.0) -> np.ndarray:
    """Inputs (B, N + 1, U): off, a turn, a stop."""
    t = np.arange(round(seconds / DT_S) + 1) * DT_S
    speed = np.interp(t, [0.0, 1.0, 0.7 * seconds, 0.8 * seconds], [0.0, 4.0, 4.0, 0.0])
    turns = np.linspace(-0.3, 0.3, count)
    return np.array(
        [delayed_inputs(np.stack([speed * (1 - k), speed * (1 + k)], axis=1), DT_S) for k in turns]
    )


def starts(count: int) -> np.ndarray:
    x0 = np.zeros((count, len(STATES)))
    x0[:, INDEX["yaw"]] = np.linspace(-3.0, 3.0, count)
    return x0


@needs_compiler
@pytest.mark.parametrize("jobs", [1, 2])
def test_a_run_has_the_same_bits_alone_and_among_others(jobs) -> None:
    some = plants()
    inputs, x0 = commands(len(some)), starts(len(some))
    together = integrate_many(x0, inputs, DT_S, some, jobs=jobs)
    for k, plant in enumerate(some):
        np.testing.assert_array_equal(together[k], integrate(x0[k], inputs[k], DT_S, plant), err_msg=str(k))


@needs_compiler
@pytest.mark.parametrize("order", [3, 4])
def test_in_32_bits_a_run_has_the_same_bits_alone_and_among_others(order: int) -> None:
    some = plants()
    inputs, x0 = commands(len(some)), starts(len(some))
    together = integrate_many(x0, inputs, DT_S, some, order=order, short=True)
    for k, plant in enumerate(some):
        alone = integrate_many(x0[k : k + 1], inputs[k], DT_S, [plant], order=order, short=True)
        np.testing.assert_array_equal(together[k], alone[0], err_msg=str(k))


@needs_compiler
def test_in_32_bits_a_run_that_was_stopped_goes_on_with_the_same_bits() -> None:
    """What rounding has left over is kept in the states that are returned; grounds that change with time are
    not stopped here."""
    some = [plant for plant in plants() if plant.route.is_fixed()]
    inputs, x0 = commands(len(some)), starts(len(some))
    x0[:, INDEX["x"]] = 1e3 / 3.0
    whole = integrate_many(x0, inputs, DT_S, some, short=True)
    first = integrate_many(x0, inputs[:, :121], DT_S, some, short=True)
    then = integrate_many(first[:, -1], inputs[:, 120:], DT_S, some, short=True)
    np.testing.assert_array_equal(whole[:, :121], first)
    np.testing.assert_array_equal(whole[:, 120:], then)


@needs_compiler
def test_32_bits_lose_less_than_a_millionth_of_each_state() -> None:
    """Far from the origin, too, where a step is less than what 32 bits tell apart of the place."""
    some = plants()
    inputs, x0 = commands(len(some)), starts(len(some))
    x0[:, INDEX["x"]] = 1e4
    long, short = (integrate_many(x0, inputs, DT_S, some, short=s) for s in (False, True))
    assert not np.array_equal(long, short)
    moved = [INDEX["x"], INDEX["y"], INDEX["yaw"]]
    assert np.abs(long - short)[:, :, moved].max() < 5e-5
    scale = np.abs(long).max(axis=1, keepdims=True) + 1e-2
    assert np.median(np.abs(long - short) / scale) < 1e-6


@pytest.mark.parametrize("backend", ["vm", pytest.param("c", marks=needs_compiler)])
def test_shared_inputs_and_every_so_many_th_sample(backend) -> None:
    some, inputs = plants()[:3], commands(1, 1.0)[0]
    whole = integrate_many(starts(3), np.stack([inputs] * 3), DT_S, some, backend=backend)
    thin = integrate_many(starts(3), inputs, DT_S, some, every=7, backend=backend)
    np.testing.assert_array_equal(whole[:, ::7], thin)


@pytest.mark.parametrize("backend", ["vm", pytest.param("c", marks=needs_compiler)])
def test_a_run_that_diverges_is_blank_from_there_and_leaves_the_others_alone(backend) -> None:
    some = plants()[:5]
    inputs = commands(5, 1.0)
    good = integrate_many(starts(5), inputs, DT_S, some, backend=backend)
    inputs[2, 50:] = np.nan
    mixed = integrate_many(starts(5), inputs, DT_S, some, backend=backend)
    assert np.isnan(mixed[2, 50:]).all()
    np.testing.assert_array_equal(mixed[2, :50], good[2, :50])
    np.testing.assert_array_equal(np.delete(mixed, 2, axis=0), np.delete(good, 2, axis=0))


@needs_compiler
def test_compiled_and_interpreted_runs_agree_on_every_vehicle_and_soil() -> None:
    some = plants()
    inputs, x0 = commands(len(some)), starts(len(some))
    c, vm = (integrate_many(x0, inputs, DT_S, some, backend=b) for b in ("c", "vm"))
    scale = np.abs(vm).max(axis=1, keepdims=True) + 1e-6
    assert (np.abs(c - vm) / scale).max() < 1e-9


@needs_compiler
def test_backends_agree_with_every_effect_in_the_graph() -> None:
    """All optional effects that move the robot at once, on one ground, over a border and in a field."""
    values = {k: 0.2 * min(p.scale, p.high) for k, (_, p) in parameters().items() if moves(k)}
    some = [Plant(p.vehicle, p.route, values) for p in plants()[-3:]]
    inputs, x0 = commands(3, 2.0), starts(3)
    c, vm = (integrate_many(x0, inputs, DT_S, some, backend=b) for b in ("c", "vm"))
    assert (np.abs(c - vm) / (np.abs(vm).max(axis=1, keepdims=True) + 1e-6)).max() < 1e-9
    np.testing.assert_array_equal(c[0], integrate(x0[0], inputs[0], DT_S, some[0]))

    d = Directions.zeros(some[0], len(values), values)
    for m, key in enumerate(values):
        d.effects[key][m] = 1.0
    few = inputs[0][:31]
    tangents = [integrate_with_sensitivity(x0[0], few, DT_S, some[0], d, backend=b)[1] for b in ("c", "vm")]
    scale = np.abs(tangents[1]).max(axis=0) + 1e-6
    assert (np.abs(tangents[0] - tangents[1]) / scale).max() < 1e-9


@needs_compiler
def test_backends_agree_on_steps_of_third_order() -> None:
    some = plants()
    inputs, x0 = commands(len(some)), starts(len(some))
    c, vm = (integrate_many(x0, inputs, DT_S, some, backend=b, order=3) for b in ("c", "vm"))
    assert (np.abs(c - vm) / (np.abs(vm).max(axis=1, keepdims=True) + 1e-6)).max() < 1e-9
    assert not np.array_equal(c, integrate_many(x0, inputs, DT_S, some))


@needs_compiler
@pytest.mark.parametrize(("order", "least"), [(3, 6.5), (4, 12.0)])
def test_the_error_falls_as_the_order_of_the_steps_says(order: int, least: float) -> None:
    """On a smooth command; halving the step takes away seven eighths of it, or fifteen sixteenths."""
    t = np.arange(201) * DT_S
    side = 2.0 + np.sin(2.0 * t)
    inputs = delayed_inputs(np.stack([side, 1.2 * side], axis=1), DT_S)
    x0, plant = np.zeros(len(STATES)), plants()[:1]
    x0 = integrate_many(x0, inputs, DT_S, plant, substeps=32)[0, 100]
    ends = [integrate_many(x0, inputs[100:], DT_S, plant, substeps=n, order=order)[0, -1] for n in (4, 8, 64)]
    at = [INDEX["x"], INDEX["y"], INDEX["yaw"]]
    coarse, fine = (np.linalg.norm((end - ends[2])[at]) for end in ends[:2])
    assert coarse > least * fine


def test_there_is_no_other_order() -> None:
    with pytest.raises(ValueError, match="order 2"):
        integrate_many(starts(1), commands(1), DT_S, plants()[:1], order=2)


@needs_compiler
def test_threads_do_not_disturb_each_other() -> None:
    """A driver keeps no state between calls, and drivers may be asked for from several threads."""
    native.forget()
    some = plants()
    inputs, x0 = commands(len(some)), starts(len(some))
    with ThreadPoolExecutor(4) as pool:
        threaded = list(pool.map(lambda k: integrate(x0[k], inputs[k], DT_S, some[k]), range(len(some))))
    for k, plant in enumerate(some):
        np.testing.assert_array_equal(threaded[k], integrate(x0[k], inputs[k], DT_S, plant))


def test_no_run_is_no_work_and_misshapen_inputs_are_named() -> None:
    assert integrate_many(starts(0), commands(1)[0], DT_S, []).shape[0] == 0
    with pytest.raises(ValueError, match="misshapen"):
        integrate_many(starts(2), commands(3), DT_S, plants()[:2])
