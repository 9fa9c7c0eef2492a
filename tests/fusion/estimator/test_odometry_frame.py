"""The frame "odom": continuous where fixes make the map pose jump, and the same motion otherwise."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.simulate import simulate

FROM_S, TO_S, END_S = 12.0, 24.0, 30.0


@pytest.fixture(scope="module")
def run() -> Recording:
    """Wheels that count 8 % too much; the fixes are missing for a while and then lie elsewhere."""
    whole = simulate("figure_eight", terrain="asphalt", seed=1)
    assert whole.wheels is not None
    assert whole.wheels.angle_rad is not None
    assert whole.gnss is not None
    t_s = (whole.gnss.t_ns - whole.gnss.t_ns[0]) * 1e-9
    wheels = dataclasses.replace(
        whole.wheels, speed=whole.wheels.speed * 1.08, angle_rad=whole.wheels.angle_rad * 1.08
    )
    kept = whole.gnss.select(((t_s < FROM_S) | (t_s > TO_S)) & (t_s < END_S))
    moved = np.where((kept.t_ns - kept.t_ns[0]) * 1e-9 > TO_S, 2.0, 0.0)
    kept = dataclasses.replace(kept, enu_m=kept.enu_m + moved[:, None] * np.array([1.0, 0.0, 0.0]))
    return dataclasses.replace(whole, wheels=wheels, gnss=kept)


def followed(run: Recording, restored: bool = False) -> tuple[Array, Array, Array]:
    """Times (N,) s and positions (N, 2) in map and odom, at every IMU sample up to `END_S`."""
    vehicle = load_vehicle("elevate")
    config = EstimatorConfig(vehicle.rig(), vehicle.name)
    estimator, rows = Estimator(config), []
    for i, message in enumerate(run.messages()):
        if (message.t_ns - run.start_ns) * 1e-9 > END_S:
            break
        if restored and i == 4000:
            assert estimator.odometry("odom") is not None
            estimator = Estimator.restore(config, estimator.dump())
        estimator.add(message)
        here, there = estimator.odometry(), estimator.odometry("odom")
        if here is not None and there is not None:
            rows.append([(here.t_ns - run.start_ns) * 1e-9, *here.position_m[:2], *there.position_m[:2]])
    t_s, *places = np.array(rows).T
    return t_s, np.array(places[:2]).T, np.array(places[2:]).T


@pytest.fixture(scope="module")
def paths(run: Recording) -> tuple[Array, Array, Array]:
    return followed(run)


def test_fixes_move_the_map_pose_and_not_the_odometry(paths: tuple[Array, Array, Array]) -> None:
    t_s, here, there = paths
    fastest_mps = 1.5
    steps = [np.hypot(*np.diff(path, axis=0).T) for path in (here, there)]
    allowed = fastest_mps * np.diff(t_s) + 0.1
    assert steps[0].max() > 1.0
    assert (steps[1] <= allowed).all()


def test_it_begins_as_the_map_and_is_as_long(paths: tuple[Array, Array, Array]) -> None:
    t_s, here, there = paths
    assert np.allclose(here[0], there[0], atol=0.05)
    before = (t_s > FROM_S + 2.0) & (t_s < TO_S - 2.0)
    lengths = [float(np.hypot(*np.diff(path[before], axis=0).T).sum()) for path in (here, there)]
    assert lengths[0] == pytest.approx(lengths[1], rel=0.01)


def test_a_restored_estimator_goes_on_in_the_same_frame(
    run: Recording, paths: tuple[Array, Array, Array]
) -> None:
    assert paths[2].tobytes() == followed(run, restored=True)[2].tobytes()


def test_an_unknown_frame_is_refused_before_the_start_too() -> None:
    estimator = Estimator.for_vehicle("elevate")
    assert estimator.odometry("odom") is None
    with pytest.raises(ConfigError, match="neither 'map' nor 'odom'"):
        estimator.odometry("base_link")
