"""A recording as messages, tables and a few lines of text."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from terrafusion.datasets.core.messages import ImuSample, WheelSample
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.simulate import simulate


@pytest.fixture(scope="module")
def drive() -> Recording:
    return simulate("straight", terrain="grass")


def test_every_sample_comes_once_and_in_order_of_time(drive: Recording) -> None:
    messages = list(drive.messages())
    t_ns = np.array([message.t_ns for message in messages])
    assert (np.diff(t_ns) >= 0).all()
    assert len(messages) == sum(len(channel) for channel in drive.channels().values())


def test_of_several_samples_at_one_time_the_imu_is_the_last(drive: Recording) -> None:
    messages = list(drive.messages())
    for now, after in itertools.pairwise(messages):
        assert not (isinstance(now, ImuSample) and now.t_ns == after.t_ns)


def test_samples_hold_the_numbers_of_their_row(drive: Recording) -> None:
    assert drive.imu is not None
    assert drive.wheels is not None
    imu = [m for m in drive.messages() if isinstance(m, ImuSample)]
    wheels = [m for m in drive.messages() if isinstance(m, WheelSample)]
    assert np.array_equal([m.gyro_radps for m in imu], drive.imu.gyro_radps)
    assert np.array_equal([m.speed for m in wheels], drive.wheels.speed)


def test_repr_is_short_and_names_the_channels(drive: Recording) -> None:
    lines = repr(drive).splitlines()
    assert len(lines) <= 12
    assert "straight" in lines[0]
    assert "elevate" in lines[0]
    assert [line.split()[0] for line in lines[1:]] == [*drive.channels(), "truth"]


def test_a_notebook_shows_names_escaped(drive: Recording) -> None:
    import dataclasses

    html = dataclasses.replace(drive, name="<script>")._repr_html_()
    assert "<script>" not in html
    assert "&lt;script&gt;" in html


def test_tables_keep_each_channels_clock(drive: Recording) -> None:
    tables = drive.to_pandas()
    assert set(tables) == {*drive.channels(), "truth"}
    for name, channel in drive.channels().items():
        assert np.array_equal(tables[name].index.to_numpy(), channel.t_ns)
