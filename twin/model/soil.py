"""Soil parameters of the wheel-ground model, one YAML file a terrain.

The pressure-sinkage and shear numbers are those of Bekker (1969) and Janosi
and Hanamoto (1961); `friction_cap` is the effective Coulomb coefficient of
the source study (Tab. 3). The `mud` section stands for mud that clings to the
wheels, `vibration` for what an IMU on the chassis feels.
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from terrafusion.datasets.core.config import structure
from terrafusion.datasets.core.quantity import Sourced
from terrafusion.twin.model.library import read_named
from terrafusion.twin.model.soil_table import is_published, published_soil


@dataclass(frozen=True)
class PressureSinkage:
    """Bekker: pressure p = (k_c / b + k_phi) z^n; rigid-wheel sinkage grows with slip by 1 + k_ss |s|.

    `skid_sinkage` is the same for the skid of a braked or side-slipping wheel; `multipass` is the share of
    the sinkage that the rut of the wheel ahead already has.
    """

    k_c_n_per_m_n1: Annotated[float, Sourced("N/m^(n+1)", 0.0, 1e7)]
    k_phi_n_per_m_n2: Annotated[float, Sourced("N/m^(n+2)", 1e3, 1e12)]
    exponent: Annotated[float, Sourced("", 0.1, 1.8)]
    slip_sinkage: Annotated[float, Sourced("", 0.0, 10.0)]
    contact_length_floor_m: Annotated[float, Sourced("m", 0.005, 0.5)]
    multipass: Annotated[float, Sourced("", 0.0, 1.0)] = 0.0
    skid_sinkage: Annotated[float, Sourced("", 0.0, 20.0)] = 0.0


@dataclass(frozen=True)
class Shear:
    """Janosi-Hanamoto shear under a Mohr-Coulomb limit, capped by an effective friction coefficient."""

    cohesion_pa: Annotated[float, Sourced("Pa", 0.0, 1e6)]
    friction_angle_rad: Annotated[float, Sourced("rad", 0.0, 0.9)]
    shear_modulus_m: Annotated[float, Sourced("m", 2e-4, 0.2)]
    friction_cap: Annotated[float, Sourced("", 0.01, 2.0)]


@dataclass(frozen=True)
class Passive:
    """Soil pushed by front and side of a sunken wheel: `bulldozing` times Rankine's passive pressure."""

    unit_weight_n_per_m3: Annotated[float, Sourced("N/m3", 0.0, 3e4)] = 0.0
    bulldozing: Annotated[float, Sourced("", 0.0, 20.0)] = 0.0


@dataclass(frozen=True)
class Resistance:
    """Rolling resistance torque c_rr W R of a wheel and viscous drag of the hub, per wheel."""

    rolling: Annotated[float, Sourced("", 0.0, 0.5)]
    viscous_ns_per_m: Annotated[float, Sourced("N s/m", 0.0, 1000.0)]


@dataclass(frozen=True)
class Mud:
    """Mud that clings to the wheels: a clogging state q grows by travel and slip, and is shed elsewhere.

    dq/ds = pickup (1 + churn_gain q slip^2)(1 - q) - shed q per metre of wheel travel;
    q adds the torque `torque_nm` q^4 to each wheel and the sinkage `sinkage_m` q^4.
    `suction_pa` is the pull per area of wet soil on the rear of the contact.
    """

    pickup_per_m: Annotated[float, Sourced("1/m", 0.0, 10.0)]
    churn_gain: Annotated[float, Sourced("", 0.0, 1000.0)]
    shed_per_m: Annotated[float, Sourced("1/m", 0.0, 10.0)]
    torque_nm: Annotated[float, Sourced("N m", 0.0, 1000.0)]
    sinkage_m: Annotated[float, Sourced("m", 0.0, 0.5)]
    suction_pa: Annotated[float, Sourced("Pa", 0.0, 1e5)] = 0.0


@dataclass(frozen=True)
class Vibration:
    """Vibration of the chassis at 1 m/s (rms, vertical and roll axes) and the band it lies in."""

    accel_mps2_at_1mps: Annotated[float, Sourced("m/s2", 0.0, 50.0)]
    gyro_radps_at_1mps: Annotated[float, Sourced("rad/s", 0.0, 10.0)]
    low_hz: Annotated[float, Sourced("Hz", 0.1, 500.0)]
    high_hz: Annotated[float, Sourced("Hz", 0.2, 1000.0)]


@dataclass(frozen=True)
class Validity:
    """Ranges (low, high) in which a soil's numbers hold; the module `validity` refuses what lies outside."""

    ground_pressure_pa: Annotated[tuple[float, ...], Sourced("Pa", 0.0, 1e8, size=2)] = (0.0, 1e8)
    wheel_diameter_m: Annotated[tuple[float, ...], Sourced("m", 0.0, 10.0, size=2)] = (0.0, 10.0)
    slip: Annotated[tuple[float, ...], Sourced("", -2.0, 2.0, size=2)] = (-2.0, 2.0)
    moisture_percent: Annotated[tuple[float, ...], Sourced("%", 0.0, 500.0, size=2)] | None = None

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            span = getattr(self, field.name)
            if span is not None and span[0] > span[1]:
                raise ValueError(f"validity.{field.name} must be [low, high]")


@dataclass(frozen=True)
class SoilParams:
    """A terrain under a small wheeled robot."""

    name: str
    description: str
    pressure: PressureSinkage
    shear: Shear
    resistance: Resistance
    mud: Mud
    vibration: Vibration
    passive: Passive = Passive()
    validity: Validity = Validity()

    def __post_init__(self) -> None:
        if self.vibration.high_hz <= self.vibration.low_hz:
            raise ValueError("vibration.high_hz must be above vibration.low_hz")


def load_soil(name_or_path: str | Path) -> SoilParams:
    """A soil by its terrain name in the library, from the table of published soils, or from a YAML file.

    `load_soil("mud")`, `load_soil("wong:lete_sand")` (see `soil_table`), `load_soil("my_field.yaml")`.

    Raises:
        ConfigError: unknown name (the known ones are listed), or a file that
            does not keep to the parameters' names, units and ranges.
    """
    name = str(name_or_path)
    if is_published(name):
        return structure(SoilParams, published_soil(name), file=f"soil_table.csv, {name}")
    raw, file = read_named("soils", name_or_path, kind="terrain")
    return structure(SoilParams, raw, file=file)
