"""Helpers shared by the twin's tests."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from terrafusion.twin.engine.integrate import integrate
from terrafusion.twin.model.plant import Plant, RouteTable
from terrafusion.twin.model.soil import SoilParams, load_soil
from terrafusion.twin.model.vectors import soil_vector, vehicle_vector
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.physics.layout import STATES
from terrafusion.twin.scenario.commands import delayed_inputs


@pytest.fixture
def frictionless() -> SoilParams:
    """Firm ground without any resistance to rolling."""
    firm = load_soil("asphalt")
    return dataclasses.replace(
        firm,
        pressure=dataclasses.replace(firm.pressure, k_phi_n_per_m_n2=1e18),
        resistance=dataclasses.replace(firm.resistance, rolling=0.0, viscous_ns_per_m=0.0),
    )


@pytest.fixture
def run() -> Callable[..., np.ndarray]:
    """run(soil, sides (N, 2) rad/s, ...) -> states (N, 38) at 100 Hz on one soil."""

    def call(
        soil: SoilParams | str,
        sides: np.ndarray,
        *,
        slope_rad: float = 0.0,
        start: np.ndarray | None = None,
        **kw,
    ) -> np.ndarray:
        soil = load_soil(soil) if isinstance(soil, str) else soil
        route = RouteTable("travel", np.zeros(1), soil_vector(soil)[None])
        vehicle = vehicle_vector(load_vehicle("elevate"), slope_rad=slope_rad)
        x0 = np.zeros(len(STATES)) if start is None else start
        return integrate(x0, delayed_inputs(sides, 0.01), 0.01, Plant(vehicle, route), **kw)

    return call
