"""What a diagnosis refuses, in one line."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.gap.data.logs import prepared
from terrafusion.twin.gap.diagnose import diagnose
from tests.twin.gap.runs import runs
from tests.twin.gap.test_diagnose import VEHICLE

pytestmark = pytest.mark.usefixtures("fitted_once")


@pytest.fixture(scope="module")
def references() -> list[Recording]:
    return runs(100, 6)


def test_nonsense_is_refused(references: list[Recording]) -> None:
    with pytest.raises(DataError, match="no run"):
        diagnose([], references, VEHICLE)
    renamed = dataclasses.replace(references[0], name="again")
    with pytest.raises(DataError, match="again: the same log as run100; give each once"):
        diagnose(references[:1], [renamed, *references[1:]], VEHICLE)
    assert references[0].motor is not None
    motor = dataclasses.replace(references[0].motor, current_a=references[0].motor.current_a + 1.0)
    assert diagnose(references[:1], [dataclasses.replace(renamed, motor=motor)], VEHICLE).references
    with pytest.raises(ConfigError, match="unknown effect"):
        diagnose(references[:1], references[1:], VEHICLE, effects=["wheels_fell_off"])
    for significance in (np.nan, 0.0, 0.9):
        with pytest.raises(ConfigError, match="significance"):
            diagnose(references[:1], references[1:], VEHICLE, significance=significance)


def test_a_soil_for_a_ground_that_no_log_has_is_refused(references: list[Recording]) -> None:
    given = {"gravel": "gravel", "grvel": "mud"}
    with pytest.raises(ConfigError, match="no log drives on 'gravel'; their grounds: loose_sand"):
        prepared(references[:1], VEHICLE, given)
    unnamed = dataclasses.replace(references[0], terrain=None, terrain_name="")
    with pytest.raises(ConfigError, match="they name none, so give one soil for all logs"):
        prepared([unnamed], VEHICLE, given)


def test_channels_that_a_log_lacks_are_noted_as_left_out(references: list[Recording]) -> None:
    bare = dataclasses.replace(references[1], gnss=None)
    logs, _, notes = prepared([references[0], bare], VEHICLE, None)
    assert [len(log.observed) for log in logs] == [len(logs[1].observed)] * 2
    assert any("run101" in note and "gnss_east_m" in note for note in notes)
    assert not any("left out" in note for note in prepared(references[:2], VEHICLE, None)[2])


def test_a_dead_sensor_is_left_out_and_named(references: list[Recording]) -> None:
    """A current of zero was a robot of half its mass, 98 % certain, a dead gyro a gyro scale of a half."""
    assert references[1].motor is not None
    motor = dataclasses.replace(references[1].motor, current_a=0.0 * references[1].motor.current_a)
    logs, _, notes = prepared([references[0], dataclasses.replace(references[1], motor=motor)], VEHICLE, None)
    assert notes == ["left out, as dead in run101: current_left_a, current_right_a"]
    assert all(not o.channel.startswith("current") for log in logs for o in log.observed)
