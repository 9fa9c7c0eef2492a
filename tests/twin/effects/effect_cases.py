"""What the tests of optional effects share: states all over the model, one graph of all effects, a drive."""

from __future__ import annotations

import functools

import numpy as np

from terrafusion.twin.effects.catalogue import built_in
from terrafusion.twin.effects.form import Form
from terrafusion.twin.engine.integrate import integrate
from terrafusion.twin.model.dynamics import rhs
from terrafusion.twin.model.measurement import measured
from terrafusion.twin.model.plant import Plant, RouteTable
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vectors import soil_vector, vehicle_vector
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.physics.layout import INDEX, INPUTS, STATES, VEHICLE_PARAMETERS, state_slice
from terrafusion.twin.scenario.commands import delayed_inputs, follow

ELEVATE = load_vehicle("elevate")
RADIUS_M = ELEVATE.wheel.radius_m
FORMS = list(built_in().values())
KEYS = tuple(sorted(form.parameter_key(p) for form in FORMS for p in form.parameters))
MOUNTING = np.array([0.1, 0.05, -0.1, 0.08, 0.4])
DT_S = 0.01
NAMED = 1e-30
"""A value that puts an effect into the graph and does nothing: all runs share one compiled graph."""


def named(form: Form) -> str:
    return form.key


def at(form: Form, which: str) -> dict[str, float]:
    """The form's parameters at "scale", "high" or "low"."""
    return {form.parameter_key(p): getattr(p, which) for p in form.parameters}


def vector(values: dict[str, float]) -> np.ndarray:
    return np.array([values.get(key, 0.0) for key in KEYS])


@functools.cache
def soil_of(terrain: str) -> np.ndarray:
    """The soil's numbers, read once."""
    numbers = soil_vector(load_soil(terrain))
    numbers.setflags(write=False)
    return numbers


def plant(
    terrain: str = "loose_sand", effects: dict[str, float] | None = None, slope_rad: float = 0.0
) -> Plant:
    route = RouteTable("travel", np.zeros(1), soil_of(terrain)[None])
    vehicle = vehicle_vector(ELEVATE, slope_rad=slope_rad)
    late = (effects or {}).get("dead_time/transport", 0.0)
    vehicle[VEHICLE_PARAMETERS.index("dead_time_applied_s")] += late
    return Plant(vehicle, route, effects or {})


def soil(terrain: str = "loose_sand") -> np.ndarray:
    return np.tile(soil_of(terrain), 4)


@functools.cache
def exciting() -> np.ndarray:
    """Side speeds (N, 2), 40 s: waves up to 1.1 Hz in speed and turn, a stop, reverse, a spin, top speed."""
    t = np.arange(0.0, 40.0 + DT_S / 2, DT_S)
    v = 0.8 + 0.5 * np.sin(2 * np.pi * t / 7.0) + 0.2 * np.sin(2 * np.pi * 1.1 * t)
    w = 0.6 * np.sin(2 * np.pi * t / 11.0) + 0.25 * np.sin(2 * np.pi * 0.7 * t)
    for start, end, speed, turn in (
        (12, 15, 0.0, 0.0),
        (20, 25, -0.6, None),
        (28, 32, 0.0, 1.0),
        (36, 40, 1.9, None),
    ):
        part = (t >= start) & (t < end)
        v[part] = speed
        if turn is not None:
            w[part] = turn
    v, w = follow(v, 5.0 * DT_S, 0.0), follow(w, 8.0 * DT_S, 0.0)
    half = 0.5 * ELEVATE.odometry.track_m * w
    return np.stack([v - half, v + half], axis=1) / RADIUS_M * (t > 0.0)[:, None]


def drive(
    values: dict[str, float],
    sides: np.ndarray,
    terrain: str = "loose_sand",
    start: np.ndarray | None = None,
    every: int = 1,
) -> tuple[np.ndarray, ...]:
    """States, inputs and outputs of a drive, from rest by default, in the graph of all effects.

    All rows are integrated, `every` so many-th is returned.
    """
    effects = dict.fromkeys(KEYS, NAMED) | values
    own = plant(terrain, effects)
    inputs = delayed_inputs(sides, DT_S, values.get("dead_time/transport", 0.0))
    x0 = np.zeros(len(STATES)) if start is None else start
    states, inputs = integrate(x0, inputs, DT_S, own)[::every], inputs[::every]
    return states, inputs, measured(states, inputs, own.vehicle, soil(terrain), MOUNTING, effects)


@functools.cache
def samples() -> tuple[np.ndarray, np.ndarray]:
    """States (N, X) and inputs (N, U): rest, reverse, a spin, an exciting drive, and anything."""
    rng = np.random.default_rng(3)
    run, inputs, _ = drive({}, exciting())
    rest = np.zeros((1, len(STATES)))
    back, spin = np.zeros((2, 1, len(STATES)))
    back[0, INDEX["u"]], back[0, state_slice("wheel_speed")] = -0.8, -0.8 / RADIUS_M
    spin[0, INDEX["r"]] = 0.6
    spin[0, state_slice("wheel_speed")] = np.array([-1.0, 1.0, -1.0, 1.0]) / RADIUS_M
    size = np.abs(run).max(axis=0) + 0.1
    size[[INDEX[name] for name in ("clog", "elapsed", "electric_energy", "sag_current")]] = 0.0
    anything = rng.uniform(-1.0, 1.0, (12, len(STATES))) * size
    states = np.vstack([rest, back, spin, run[150::150], anything])
    told_ = np.vstack(
        [rng.uniform(-5.0, 5.0, (3, len(INPUTS))), inputs[150::150], rng.uniform(-8, 8, (12, len(INPUTS)))]
    )
    return states, told_


@functools.cache
def all_effects():
    """f with all effects."""
    return rhs(KEYS)


def derivatives(
    values: dict[str, float],
    states: np.ndarray,
    inputs: np.ndarray,
    terrain: str = "mud",
    slope_rad: float = 0.08,
) -> np.ndarray:
    """dx/dt (N, X) in the graph of all effects."""
    vehicle = plant(terrain, slope_rad=slope_rad).vehicle
    return all_effects()(states.T, inputs.T, vehicle, soil(terrain), vector(values)).full().T


def readings(
    values: dict[str, float], states: np.ndarray, inputs: np.ndarray, terrain: str = "mud"
) -> np.ndarray:
    """Outputs (N, Y) in the graph of all effects, on a slope."""
    vehicle = plant(terrain, slope_rad=0.08).vehicle
    return measured(states, inputs, vehicle, soil(terrain), MOUNTING, dict.fromkeys(KEYS, 0.0) | values)
