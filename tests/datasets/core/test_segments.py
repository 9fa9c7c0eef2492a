"""Segments of a log: their rows, their ground labels, their names."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.segments import LEAST_S, segment, segments_of, split_name


def test_segments_contain_every_row_once(drive: Recording) -> None:
    parts = segments_of(drive, 13.0)
    for name in ("wheels", "imu", "gnss", "command", "motor"):
        joined = np.concatenate([p.channels()[name].t_ns for p in parts])
        whole = drive.channels()[name].t_ns
        assert np.array_equal(joined, whole[: len(joined)])
        assert (whole[-1] - joined[-1]) * 1e-9 <= LEAST_S


def test_a_segment_has_the_ground_label_at_its_start(drive: Recording) -> None:
    """The labels of `drive` change every ten seconds."""

    def labels(begin_s: float, end_s: float) -> list[str]:
        terrain = segment(drive, begin_s, end_s).terrain
        assert terrain is not None
        return terrain.label.tolist()

    assert labels(0.0, 9.0) == ["gravel"]
    assert labels(5.0, 15.0) == ["gravel", "mud"]
    late = segment(drive, 44.0, 49.0)
    assert late.terrain is not None
    assert late.terrain.label.tolist() == ["grass"]
    assert late.start_ns == drive.start_ns + 44_000_000_000
    assert late.terrain.t_ns[0] == late.start_ns


def test_names_of_segments() -> None:
    assert split_name("set/log") == ("set/log", None)
    assert split_name("me@home/log")[1] is None
    name, cut = split_name("set/log@60-105")
    assert name == "set/log"
    assert cut is not None
    assert (cut.begin_s, cut.end_s) == (60.0, 105.0)
    every = split_name("set/log@/45")[1]
    assert every is not None
    assert every.every_s == 45.0


@pytest.mark.parametrize("text", ["log@60-61", "log@60-50", "log@/2", "log@1.2.3-9"])
def test_bad_segments_are_refused(text: str) -> None:
    with pytest.raises(DataError):
        split_name(text)


def test_a_segment_beyond_the_log_is_refused(drive: Recording) -> None:
    with pytest.raises(DataError, match="drive: nothing was recorded from 100 to 120 s; the log lasts 60 s"):
        segment(drive, 100.0, 120.0)


def test_a_segment_before_the_first_ground_label_has_none(drive: Recording) -> None:
    assert drive.terrain is not None
    late = dataclasses.replace(drive.terrain.select(slice(1)), t_ns=drive.terrain.t_ns[:1] + 50_000_000_000)
    recording = dataclasses.replace(drive, terrain=late)
    assert segment(recording, 0.0, 45.0).terrain is None
    assert segment(recording, 45.0, 55.0).terrain is not None
