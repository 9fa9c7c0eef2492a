"""The twin as a model of forks: its wheels driven as measured, or its motors told what was commanded."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.twin.engine.integrate import integrate
from terrafusion.twin.model.plant import Plant, RouteTable
from terrafusion.twin.model.soil import SoilParams
from terrafusion.twin.model.vectors import soil_vector, vehicle_vector
from terrafusion.twin.model.vehicle import VehicleParams
from terrafusion.twin.physics.layout import INDEX, SOIL_PARAMETERS, STATES, VEHICLE_PARAMETERS, state_slice
from terrafusion.twin.scenario.commands import delayed_inputs
from tests.studies.joined_windows import DT_S
from tests.studies.twin_field.fitting import Bounded, fit
from tests.studies.twin_field.forks import N_PAST, Forks

Array = NDArray[np.float64]

HEAVY = 100.0
"""Wheels that are to turn as measured get this many times their inertia: the ground hardly slows them."""
FOLLOW_S = 0.01
"""Time constant with which they follow; the inputs are sent ahead by as much."""
LAG_S = 0.005
"""The motors' lag in all runs here."""
NO_LIMIT_NM = 1e5
SUBSTEPS_DRIVEN, SUBSTEPS = 8, 15
"""RK4 steps a sample; heavy wheels allow longer ones (tested against the default step)."""
TORQUE_MEMORY = 5
"""Samples over which the torque at the fork is averaged."""
WORKERS = 2


@dataclass(frozen=True)
class Freedom:
    """A number of the twin that a calibration may change, its range, and how far it is thought to be off.

    `names` are entries of `VEHICLE_PARAMETERS` or `SOIL_PARAMETERS`, or optional effects. All are multiplied
    by the same factor within (low, high), or, where `added`, get the same amount within (low, high) added.
    `doubt` is the standard deviation of the logarithm of the factor, or of the amount: it decides what the
    drives leave open and hardly moves what they tell.
    """

    names: tuple[str, ...]
    low: float
    high: float
    doubt: float
    added: bool = False


GROUND = (
    Freedom(("radius_m",), 0.8, 1.2, 0.05),
    Freedom(("tan_friction", "friction_cap"), 0.02, 2.0, 1.0),
    Freedom(("shear_modulus_m",), 0.05, 50.0, 1.5),
    Freedom(("k_phi",), 0.05, 20.0, 1.5),
    Freedom(("viscous_ns_per_m",), 0.0, 300.0, 20.0, added=True),
    Freedom(("cg_forward_m",), -0.3, 0.3, 0.05, added=True),
    Freedom(("cg_left_m",), -0.2, 0.2, 0.02, added=True),
    Freedom(("wheelbase_m",), 0.7, 1.4, 0.1),
    Freedom(("yaw_inertia_kgm2",), 0.3, 3.0, 0.3),
    Freedom(("wheel_radius_asymmetry/sides",), -0.1, 0.1, 0.02, added=True),
)
"""What wheel speeds and the body's motion tell of the ground, of the weight and of the tyres.

The wheelbase is an effective one: tyres and rockers move the load about.
"""

ACTUATION = (
    Freedom(("loop_p_nms",), 0.02, 20.0, 1.5),
    Freedom(("loop_i_nm",), 0.005, 20.0, 1.5),
    Freedom(("dead_time_s",), 0.0, 0.6, 0.2, added=True),
    Freedom(("torque_limit_nm", "stall_torque_nm"), 0.1, 5.0, 0.7),
    Freedom(("no_load_radps",), 0.5, 3.0, 0.3),
    Freedom(("rolling",), 0.2, 10.0, 0.7),
)
"""What commands tell besides, once the ground is known."""


@dataclass(frozen=True, eq=False)
class TwinModel:
    """The twin of one vehicle on one ground.

    Attributes:
        vehicle: (V,) `VEHICLE_PARAMETERS`.
        soil: (S,) `SOIL_PARAMETERS`.
        commanded: whether the inputs are commands to the motors, not measured wheel speeds.
        effects: optional effects by name.
    """

    vehicle: Array
    soil: Array
    commanded: bool
    effects: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def nominal(cls, vehicle: VehicleParams, soil: SoilParams, *, commanded: bool) -> TwinModel:
        """By the library's numbers."""
        return cls(vehicle_vector(vehicle), soil_vector(soil), commanded)

    def predict(self, forks: Forks) -> Array:
        """(F, N_FUTURE + 1, 3) forward speed, sideways speed, yaw rate of the body origin from each fork on.

        Raises:
            TerrafusionError: a run diverged.
        """
        with ThreadPoolExecutor(WORKERS) as pool:
            return np.stack(list(pool.map(lambda k: self._one(forks, k), range(len(forks)))))

    def _one(self, forks: Forks, k: int) -> Array:
        motion = forks.motion[k]
        inputs = self._sides(forks.inputs_radps[k], motion, forks.given_turn)
        past = self._sides(forks.past_radps[k], motion, forks.given_turn)
        driven = self._plant(driven=True)
        before = _integrated(
            self._start(past[0], motion[0]), delayed_inputs(past, DT_S, -FOLLOW_S), driven, SUBSTEPS_DRIVEN
        )
        start = self._corrected(before[-1], motion[N_PAST])
        if self.commanded:
            late = float(self.vehicle[_V["dead_time_s"]])
            future = delayed_inputs(inputs, DT_S, late)[N_PAST:]
            start = self._at_work(start, before, future[0, :2], driven.vehicle)
            states = _integrated(start, future, self._plant(driven=False), SUBSTEPS)
        else:
            states = _integrated(
                start, delayed_inputs(inputs[N_PAST:], DT_S, -FOLLOW_S), driven, SUBSTEPS_DRIVEN
            )
        turn = states[:, INDEX["r"]]
        forward = states[:, INDEX["u"]] + turn * self.vehicle[_V["cg_left_m"]]
        aside = states[:, INDEX["v"]] - turn * self.vehicle[_V["cg_forward_m"]]
        return np.stack([forward, aside, motion[N_PAST:, 2] if forks.given_turn else turn], axis=1)

    def _plant(self, *, driven: bool) -> Plant:
        vehicle = self.vehicle.copy()
        vehicle[_V["lag_s"]] = LAG_S
        vehicle[_V["dead_time_applied_s"]] = vehicle[_V["dead_time_s"]]
        if driven:
            inertia = HEAVY * vehicle[_V["wheel_inertia_kgm2"]]
            vehicle[_V["wheel_inertia_kgm2"]] = inertia
            vehicle[_V["loop_p_nms"]] = inertia / FOLLOW_S
            vehicle[_V["loop_i_nm"]] = inertia / FOLLOW_S
            vehicle[_V["stall_torque_nm"]] = vehicle[_V["torque_limit_nm"]] = NO_LIMIT_NM
            vehicle[_V["no_load_radps"]] *= 100.0
            vehicle[_V["battery_ohm"]] = 0.0
        return Plant(vehicle, RouteTable("travel", np.zeros(1), self.soil[None]), self.effects)

    def _sides(self, sides: Array, motion: Array, given_turn: bool) -> Array:
        """Side speeds; where the log knows their mean only, they turn the body about as the gyro says."""
        if not given_turn:
            return sides
        track, base, radius = (self.vehicle[_V[n]] for n in ("track_m", "wheelbase_m", "radius_m"))
        # Centres of rotation of four wheels on dry friction: track + base^2 / track apart.
        half = 0.5 * (track + base * base / track) / radius * motion[: len(sides), 2]
        return np.stack([sides[:, 0] - half, sides[:, 1] + half], axis=1)

    def _start(self, sides: Array, motion: Array) -> Array:
        x = np.zeros(len(STATES))
        x[state_slice("wheel_speed")] = np.tile(sides, 2)
        return self._corrected(x, motion)

    def _corrected(self, x: Array, motion: Array) -> Array:
        """The state with the true forward speed and yaw rate, where they are known."""
        out = x.copy()
        turn = motion[2]
        out[INDEX["r"]] = turn
        if np.isfinite(motion[0]):
            out[INDEX["u"]] = motion[0] - turn * self.vehicle[_V["cg_left_m"]]
        return out

    def _at_work(self, x: Array, before: Array, command: Array, driven: Array) -> Array:
        """The state with the motors at the torque that moved the wheels so far, their loops asking for it.

        The torque is that of the past second with the wheels driven as measured, less what turned their
        added inertia.
        """
        out, count = x.copy(), TORQUE_MEMORY
        speed, torque = state_slice("wheel_speed"), state_slice("torque")
        spun = (
            driven[_V["wheel_inertia_kgm2"]]
            * (before[-1, speed] - before[-1 - count, speed])
            / (count * DT_S)
        )
        steady = 0.5 * (before[-1 - count : -1, torque] + before[-count:, torque]).mean(axis=0) - spun
        gears = self.vehicle[_V["gear_ratio"]] * self.vehicle[_V["gear_efficiency"]]
        limit = gears * self.vehicle[_V["torque_limit_nm"]]
        steady = np.clip(steady, -limit, limit)
        error = np.tile(command, 2) - out[speed]
        out[torque] = steady
        out[state_slice("speed_error")] = (steady - self.vehicle[_V["loop_p_nms"]] * error) / self.vehicle[
            _V["loop_i_nm"]
        ]
        return out


_V = {name: i for i, name in enumerate(VEHICLE_PARAMETERS)}
_S = {name: i for i, name in enumerate(SOIL_PARAMETERS)}


def _integrated(start: Array, inputs: Array, plant: Plant, substeps: int) -> Array:
    """States (N + 1, X); where an odd set of numbers is too stiff for the step, with a quarter of it."""
    try:
        return integrate(start, inputs, DT_S, plant, substeps=substeps)
    except TerrafusionError:
        return integrate(start, inputs, DT_S, plant, substeps=4 * substeps)


def changed(model: TwinModel, freedoms: Sequence[Freedom], values: Array) -> TwinModel:
    """The model with its numbers changed: `values` (P,) are logarithms of factors, or amounts added."""
    vehicle, soil, effects = model.vehicle.copy(), model.soil.copy(), dict(model.effects)
    for freedom, value in zip(freedoms, values.tolist(), strict=True):
        for name in freedom.names:
            if "/" in name:
                effects[name] = effects.get(name, 0.0) + value
                continue
            vector, index = (vehicle, _V) if name in _V else (soil, _S)
            old = vector[index[name]]
            vector[index[name]] = old + value if freedom.added else old * np.exp(value)
    return dataclasses.replace(model, vehicle=vehicle, soil=soil, effects=effects)


def calibrated(model: TwinModel, freedoms: Sequence[Freedom], forks: Forks, *, rounds: int = 20) -> TwinModel:
    """The model with the freedoms fitted on the forks by the common criterion."""
    numbers = [
        Bounded(0.0, f.low, f.high) if f.added else Bounded(0.0, float(np.log(f.low)), float(np.log(f.high)))
        for f in freedoms
    ]
    doubts = np.array([f.doubt for f in freedoms])
    found = fit(
        numbers, lambda p: changed(model, freedoms, p).predict(forks), forks, doubts=doubts, rounds=rounds
    )
    return changed(model, freedoms, found)
