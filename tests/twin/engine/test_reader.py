"""The compiled readings of the sensors are those of the measurement graph."""

from __future__ import annotations

import numpy as np
import pytest

from terrafusion.twin.effects.catalogue import parameters
from terrafusion.twin.engine.integrate import compiled
from terrafusion.twin.engine.reader import reader
from terrafusion.twin.model.measurement import measured
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vectors import mounting_vector, soil_vector, vehicle_vector
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.physics.layout import INPUTS, STATES, WHEELS

pytestmark = pytest.mark.skipif(not compiled(), reason="no C compiler")


@pytest.mark.parametrize("count", [1, 8, 19])
@pytest.mark.parametrize("fixed", [True, False])
def test_readings_are_those_of_the_graph(count: int, fixed: bool) -> None:
    rng, robot = np.random.default_rng(count), load_vehicle("elevate")
    names = tuple(
        sorted(k for k in parameters() if k.split("/")[0] in ("mass", "gyro_scale", "imu_time_offset"))
    )
    values = np.array([0.3 * parameters()[k][1].scale for k in names])
    states, inputs = rng.normal(0.0, 0.5, (count, len(STATES))), rng.normal(0.0, 2.0, (count, len(INPUTS)))
    share = np.full((count, 1), 0.5) if fixed else rng.uniform(0.0, 1.0, (count, 1))
    one, other = (soil_vector(load_soil(name)) for name in ("grass", "gravel"))
    soil = one + share * (other - one)
    given = states, inputs, vehicle_vector(robot)
    native = reader(names, fixed)
    assert native is not None
    y = native(*given[:2], soil[0] if fixed else soil, given[2], values, mounting_vector(robot))
    named = dict(zip(names, values, strict=True))
    true = measured(*given, np.tile(soil, (1, len(WHEELS))), mounting_vector(robot), named)
    np.testing.assert_allclose(y, true, rtol=1e-9, atol=1e-9)
