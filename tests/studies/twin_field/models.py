"""The models that are compared, fitted on the same forks by the same criterion."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.model.library import known_names
from terrafusion.twin.model.soil import SoilParams, load_soil
from terrafusion.twin.model.vehicle import VehicleParams
from tests.studies.twin_field import kinematic
from tests.studies.twin_field.fitting import cost
from tests.studies.twin_field.forks import N_FUTURE, Forks
from tests.studies.twin_field.twin_model import ACTUATION, GROUND, TwinModel, calibrated

Array = NDArray[np.float64]

FIRM = "asphalt"
"""Ground the uncalibrated twin takes where the library does not know the one that is told."""
TWIN, TWIN_NOMINAL, BEST_KINEMATIC = "twin", "twin, nominal", "ICR + lag"


class Model(Protocol):
    """Anything that predicts the motion from forks."""

    def predict(self, forks: Forks) -> Array:
        """(F, N_FUTURE + 1, 3) forward speed, sideways speed, yaw rate."""
        ...


@dataclass(frozen=True)
class Hold:
    """What moves goes on as it does."""

    def predict(self, forks: Forks) -> Array:
        """(F, N_FUTURE + 1, 3)."""
        return np.repeat(forks.start()[:, None], N_FUTURE + 1, axis=1)


def nominal_soil(ground: str) -> SoilParams:
    """The library's soil of that name, else its firm one."""
    return load_soil(ground if ground in known_names("soils") else FIRM)


def for_wheels(vehicle: VehicleParams, ground: str, forks: Forks) -> dict[str, Model]:
    """All models for measured wheel speeds, by name, fitted on training forks.

    Args:
        vehicle: nominal parameters.
        ground: of the forks, chooses the soil the twin starts from.
        forks: to fit on.

    The twin is fitted from the ground's soil and from the firm one; the better fit is kept. The slopes of
    its misfit lead nowhere where all wheels slide.
    """
    nominal = TwinModel.nominal(vehicle, nominal_soil(ground), commanded=False)
    firm = TwinModel.nominal(vehicle, load_soil(FIRM), commanded=False)
    starts = (nominal, firm) if nominal_soil(ground).name != FIRM else (nominal,)
    found = [calibrated(start, GROUND, forks) for start in starts]
    return {
        **_kinematic(vehicle, forks, lagged=False),
        TWIN_NOMINAL: nominal,
        TWIN: min(found, key=lambda model: cost(model.predict(forks), forks)),
    }


def for_commands(vehicle: VehicleParams, forks: Forks, driven: dict[str, Model]) -> dict[str, Model]:
    """All models for commands; the twins' ground is that of the models `driven` by measured wheels.

    So the twin's motors and loops are all that is fitted here; the kinematic models' numbers, lags and
    dead time are fitted together.
    """
    nominal, twin = driven[TWIN_NOMINAL], driven[TWIN]
    assert isinstance(nominal, TwinModel)
    assert isinstance(twin, TwinModel)
    return {
        **_kinematic(vehicle, forks, lagged=True),
        TWIN_NOMINAL: dataclasses.replace(nominal, commanded=True),
        TWIN: calibrated(dataclasses.replace(twin, commanded=True), ACTUATION, forks),
    }


def _kinematic(vehicle: VehicleParams, forks: Forks, *, lagged: bool) -> dict[str, Model]:
    plain = kinematic.plain(vehicle)
    both = kinematic.radius_and_track(plain, forks)
    icr = kinematic.icr(both, forks)
    models: dict[str, Model] = {"hold": Hold(), "plain": plain, "radius, track": both, "ICR": icr}
    if lagged:
        models["plain + lag"] = kinematic.lags(plain, forks)
        models["radius, track + lag"] = kinematic.lags(both, forks)
    return models | {BEST_KINEMATIC: kinematic.lagged(icr, forks)}
