"""Conventions of a log: what cannot be applied is refused or leaves a channel as it is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from terrafusion.datasets.core.channels import Imu, Wheels
from terrafusion.datasets.core.conventions import Conventions, apply
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording


@pytest.mark.parametrize(
    ("named", "match"),
    [
        ({"held": {"terrain": 5.0}}, "'held' names the channel 'terrain'; give command, wheels, imu"),
        ({"held": {"weels": 5.0}}, "'held' names the channel 'weels'"),
        ({"lag_s": {"gps": 0.1}}, "'lag_s' names the channel 'gps'; give command, wheels, imu"),
    ],
)
def test_unknown_channels_are_refused(named: Any, match: str) -> None:
    with pytest.raises(ValueError, match=match):
        Conventions(**named)


def test_held_values_of_an_imu_without_numbers() -> None:
    """Nothing to compare: all rows stay."""
    t_ns = np.arange(8, dtype=np.int64)
    empty = Imu(t_ns, np.full((8, 3), np.nan), np.full((8, 3), np.nan))
    kept = apply(Recording("log", 0, imu=empty), Conventions(held={"imu": 4.0})).imu
    assert kept is not None
    assert len(kept) == 8


def test_signs_of_sides_need_sides() -> None:
    t_ns = np.arange(3, dtype=np.int64)
    log = Recording("field1", 0, wheels=Wheels(t_ns, np.ones((3, 1)), ("speed",), "mps"))
    for sides in ({"left_wheels_sign": -1.0}, {"right_wheels_sign": -1.0}):
        with pytest.raises(DataError, match=r"field1, wheels: has one speed.*; give left_wheels_sign"):
            apply(log, Conventions(**sides))
    both = apply(log, Conventions(left_wheels_sign=-1.0, right_wheels_sign=-1.0)).wheels
    assert both is not None
    assert both.speed.tolist() == [[-1.0]] * 3
