"""An estimator that is fed message by message gives what a replay gives."""

from __future__ import annotations

import dataclasses
from collections import deque
from typing import Any

import numpy as np
import pytest

from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.datasets.core.messages import (
    CommandSample,
    GnssSample,
    ImuSample,
    Message,
    SteeringSample,
    TerrainSample,
    WheelSample,
)
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.benchmark.outage_plan import until
from terrafusion.fusion.config.sensor_config import SensorConfig
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.estimator.notes import notes_of
from terrafusion.fusion.inputs.streams import MOST_INCOMPLETE
from terrafusion.fusion.replay import replay
from terrafusion.twin.simulate import simulate


@pytest.fixture(scope="module")
def drive() -> Recording:
    return simulate("straight", terrain="grass")


def test_messages_give_the_bits_of_a_replay(drive: Recording) -> None:
    estimator = Estimator.for_vehicle("elevate")
    for message in drive.messages():
        estimator.add(message)
    estimator.finish()
    state, estimate = estimator.latest(), replay(drive).estimate
    assert state is not None
    assert state.t_ns == estimate.trajectory.t_ns[-1]
    assert np.array_equal(state.position_m, estimate.trajectory.position_m[-1])
    assert np.array_equal(state.covariance, estimate.trajectory.covariance[-1])


def test_rows_with_missing_values_are_left_out(drive: Recording) -> None:
    estimator = Estimator.for_vehicle("elevate")
    nan = np.full(3, np.nan)
    estimator.add(ImuSample(drive.start_ns, nan, nan))
    estimator.add(GnssSample(drive.start_ns, nan, nan, 4, None, np.nan))
    assert not estimator.imu.t_ns


def test_a_driver_that_warms_up_for_long_is_no_other_imu() -> None:
    estimator, nan = Estimator.for_vehicle("elevate"), np.full(3, np.nan)
    for i in range(2 * MOST_INCOMPLETE):
        estimator.add(ImuSample(i * 5_000_000, nan, nan))
    assert not estimator.imu.t_ns


def test_an_imu_of_one_axis_has_to_be_declared() -> None:
    """As six axes are expected, it would give no estimate, without a word."""
    log = until(simulate("figure_eight", terrain="asphalt", seed=1), 40.0)
    assert log.imu is not None
    gyro = log.imu.gyro_radps.copy()
    gyro[:, :2] = np.nan
    log = dataclasses.replace(
        log, imu=dataclasses.replace(log.imu, gyro_radps=gyro, accel_mps2=np.full_like(gyro, np.nan))
    )
    estimator = Estimator.for_vehicle("elevate")
    with pytest.raises(DataError, match=r"none of the first 1000 samples has all six axes.*sensors=log"):
        deque(map(estimator.add, log.messages()), maxlen=0)
    declared = Estimator.for_vehicle("elevate", sensors=log)
    for message in log.messages():
        declared.add(message)
    declared.finish()
    state, estimate = declared.latest(), replay(log).estimate
    assert state is not None
    assert np.array_equal(state.position_m, estimate.trajectory.position_m[-1])


def test_body_speed_where_both_sides_are_expected_is_refused(drive: Recording) -> None:
    message = WheelSample(drive.start_ns, np.array([1.0]), ("mean",), "mps", None)
    with pytest.raises(DataError, match="body speed alone"):
        Estimator.for_vehicle("elevate").add(message)
    Estimator.for_vehicle("elevate", sensors=SensorConfig(sides=False)).add(message)
    with pytest.raises(ConfigError, match="sensors are declared by a str"):
        Estimator.for_vehicle("elevate", sensors="gyro_z")  # type: ignore[arg-type]


def test_what_is_no_message_is_refused(drive: Recording) -> None:
    with pytest.raises(DataError, match="no message"):
        Estimator.for_vehicle("elevate").add(dataclasses)  # type: ignore[arg-type]


SIDES = ("left", "right")


@pytest.mark.parametrize(
    "message",
    [
        ImuSample(0, None, None),  # type: ignore[arg-type]
        ImuSample(0, np.zeros(1), np.zeros(1)),
        GnssSample(0, np.zeros(2), np.ones(3), 4, None, np.nan),
        WheelSample(0, np.ones(2), ("a", "b"), "mps", None),
        WheelSample(0, np.ones(1), SIDES, "mps", None),
        WheelSample(0, np.ones(2), SIDES, "radps", np.ones(1)),
        CommandSample(0, [], 0.0),  # type: ignore[arg-type]
    ],
    ids=lambda m: type(m).__name__,
)
def test_a_message_that_holds_something_else_is_refused(message: Message) -> None:
    with pytest.raises(DataError):
        Estimator.for_vehicle("elevate").add(message)


def test_lists_will_do_and_odd_probabilities_are_none() -> None:
    estimator = Estimator.for_vehicle("elevate")
    estimator.add(ImuSample(0, [0.0, 0.0, 0.0], [0.0, 0.0, 9.8]))  # type: ignore[arg-type]
    estimator.add(WheelSample(0, [1.0, 1.0], SIDES, "mps", None))  # type: ignore[arg-type]
    estimator.add(TerrainSample(0, "mud", "camera", 3))  # type: ignore[arg-type]
    estimator.add(TerrainSample(0, "mud", "camera", {"mud": None}))  # type: ignore[dict-item]
    estimator.add(SteeringSample(0, None, ("front",)))  # type: ignore[arg-type]
    assert len(estimator.imu.t_ns) == len(estimator.wheels.t_ns) == 1


def test_what_a_camera_gives_without_probabilities_is_counted() -> None:
    estimator = Estimator.for_vehicle("elevate")
    for source, given in (
        ("camera", None), ("camera", {}), ("camera", {"mud": np.nan}), ("camera", {"mud": 0.9}),
        ("annotation", None), ("simulation", {"mud": 1.0}),
    ):  # fmt: skip
        estimator.add(TerrainSample(10**9, "mud", source, given))
    assert any("3 samples of terrain left out: without prob" in note for note in notes_of(estimator))


@pytest.mark.parametrize(
    "start",
    [
        ("x", 0.0, 0.1, 0.1),
        (None, 0.0, 0.1, 0.1),
        ([0.0] * 3, 0.0, None, 0.1),
        ([1e300] * 3, 0.0, 1.0, 1.0),
        ([0.0] * 3, 0.0, 1e300, 0.1),
        ([0.0] * 3, 1e16, 0.1, 0.1),
    ],
)
def test_a_start_that_is_none_is_refused(start: tuple[Any, ...]) -> None:
    with pytest.raises(DataError):
        Estimator.for_vehicle("elevate").set_start(*start)
