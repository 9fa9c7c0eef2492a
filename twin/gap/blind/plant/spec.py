"""Inputs of a run of the plant, and the numbers of many runs stacked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.twin.gap.blind.plant.parameters import CHANGES
from terrafusion.twin.model.soil import SoilParams
from terrafusion.twin.model.vehicle import VehicleParams

Array = NDArray[np.float64]

SPREAD_RADIUS, SPREAD_DRAG = 0.002, 0.1
"""How robots of one type differ (1 sigma, assumed): wheel radii, and rolling drag of each wheel."""


@dataclass(frozen=True)
class Segment:
    """Commanded twist: v + v_amplitude sin(2 pi hz t), likewise the yaw rate; t from the segment's start."""

    duration_s: float
    v_mps: float = 0.0
    yaw_rate_radps: float = 0.0
    v_amplitude_mps: float = 0.0
    yaw_rate_amplitude_radps: float = 0.0
    hz: float = 0.0


@dataclass(frozen=True)
class GroundSpread:
    """How the ground of a run differs from its soil's numbers (standard deviations of logarithms, assumed).

    `between` is drawn once a run; `within` is a field of the place, correlated over `length_m`.
    """

    between: float = 0.08
    within: float = 0.10
    length_m: float = 2.5


@dataclass(frozen=True)
class RunSpec:
    """One run.

    Attributes:
        drive: commanded segments.
        heading_rad: at the start, from east to the left.
        seed: of ground, sensors and everything else that differs from run to run.
        robot_seed: of what differs from robot to robot of one type.
        changes: by name of `parameters.CHANGES`.
        noiseless: exact sensors, even ground, a robot as its data sheet has it.
    """

    vehicle: VehicleParams
    soil: SoilParams
    drive: tuple[Segment, ...]
    heading_rad: float = 0.0
    seed: int = 0
    robot_seed: int = 0
    changes: Mapping[str, float] = field(default_factory=dict)
    ground: GroundSpread = GroundSpread()
    noiseless: bool = False

    def __post_init__(self) -> None:
        unknown = set(self.changes) - set(CHANGES)
        if unknown:
            raise ConfigError(f"unknown parameter '{min(unknown)}'", remedy="see plant/parameters.py")
        if self.soil.mud.pickup_per_m > 0.0:
            raise ConfigError("mud that clogs the wheels is not in this plant", channel=self.soil.name)

    def duration_s(self) -> float:
        return sum(segment.duration_s for segment in self.drive)

    def stream(self, name: str) -> np.random.Generator:
        """Random numbers for one purpose; those of another do not change when this one draws more."""
        return np.random.default_rng([self.seed, *name.encode()])


def stacked_numbers(specs: Sequence[RunSpec]) -> dict[str, Array]:
    """Numbers (B,) of all runs by name, radii and drag of each wheel (4, B), changes as `change_<name>`."""
    numbers = [_numbers(spec) for spec in specs]
    table = {name: np.array([row[name] for row in numbers]) for name in numbers[0]}
    for change in CHANGES:
        table[f"change_{change}"] = np.array([spec.changes.get(change, 0.0) for spec in specs])
    spread = np.stack([_spread(spec) for spec in specs], axis=-1)
    table["radius_m"] = table["radius_m"] * (1.0 + SPREAD_RADIUS * spread[0])
    table["drag_gain"] = np.exp(SPREAD_DRAG * spread[1])
    return table


def _spread(spec: RunSpec) -> Array:
    if spec.noiseless:
        return np.zeros((2, 4))
    return np.random.default_rng([spec.robot_seed, 4]).normal(size=(2, 4))


def _numbers(spec: RunSpec) -> dict[str, float]:
    body, wheel, drive = spec.vehicle.body, spec.vehicle.wheel, spec.vehicle.drive
    pressure, shear, passive = spec.soil.pressure, spec.soil.shear, spec.soil.passive
    battery = spec.vehicle.battery
    return {
        "mass_kg": body.mass_kg, "inertia_kgm2": body.yaw_inertia_kgm2, "wheelbase_m": body.wheelbase_m,
        "track_m": body.track_m, "cg_forward_m": body.cg_forward_m, "cg_left_m": body.cg_left_m,
        "cg_height_m": body.cg_height_m,
        "radius_m": wheel.radius_m, "width_m": wheel.width_m, "wheel_inertia_kgm2": wheel.inertia_kgm2,
        "grouser_m": wheel.grouser_height_m,
        "ratio": drive.gear_ratio, "efficiency": drive.gear_efficiency,
        "no_load_radps": drive.no_load_speed_radps, "stall_nm": drive.stall_torque_nm,
        "limit_nm": drive.torque_limit_nm, "supply_v": drive.supply_v,
        "loop_p": drive.speed_loop_p_nms, "loop_i": drive.speed_loop_i_nm, "lag_s": drive.lag_s,
        "dead_s": drive.dead_time_s, "no_load_a": drive.no_load_current_a,
        "open_v": drive.supply_v if battery is None else battery.full_v,
        "inner_ohm": 0.0 if battery is None else battery.resistance_ohm,
        "stiffness": pressure.k_c_n_per_m_n1 / wheel.width_m + pressure.k_phi_n_per_m_n2,
        "exponent": pressure.exponent, "skid_sinkage": pressure.skid_sinkage,
        "digs": float(pressure.slip_sinkage > 0.0), "multipass": pressure.multipass,
        "patch_m": pressure.contact_length_floor_m,
        "cohesion_pa": shear.cohesion_pa, "tan_friction": float(np.tan(shear.friction_angle_rad)),
        "modulus_m": shear.shear_modulus_m, "cap": shear.friction_cap,
        "unit_weight": passive.unit_weight_n_per_m3, "bulldozing": passive.bulldozing,
        "rolling": spec.soil.resistance.rolling, "viscous": spec.soil.resistance.viscous_ns_per_m,
        "heading_rad": spec.heading_rad,
    }  # fmt: skip
