"""An estimator that is fed message by message gives what a replay gives."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.messages import GnssSample, ImuSample
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.estimator.estimator import Estimator
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


def test_what_is_no_message_is_refused(drive: Recording) -> None:
    with pytest.raises(DataError, match="no message"):
        Estimator.for_vehicle("elevate").add(dataclasses)  # type: ignore[arg-type]
