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


def test_names_of_segments(drive: Recording) -> None:
    def cut(text: str) -> tuple[str, list[str]]:
        log, parts = split_name(text)
        return log, [part.name for part in parts(drive)]

    assert cut("set/log") == ("set/log", ["drive"])
    assert cut("me@home/log") == ("me@home/log", ["drive"])
    assert cut("set/log@20-45") == ("set/log", ["drive@20-45"])
    log, parts = cut("set/log@/20")
    assert (log, len(parts)) == ("set/log", 3)
    assert all(part.startswith("drive@") for part in parts)


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
