"""Measures and their page: known answers, and no failure for any recording."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable

import numpy as np
import pytest

from terrafusion.datasets.checks import run_checks
from terrafusion.datasets.checks.measures import measure
from terrafusion.datasets.checks.summary import summarise, summarise_all
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import Rig
from terrafusion.fusion.cli.inspect_page import WIDTH, contents_lines, finding_lines


def cut(recording: Recording, seconds: float) -> list[Recording]:
    """Windows of so many seconds."""
    step, parts = round(seconds * 1e9), []
    for start in range(recording.start_ns, recording.end_ns() - step, step):
        channels = {name: c.between(start, start + step) for name, c in recording.channels().items()}
        assert recording.truth is not None
        t = recording.truth.t_ns
        truth = recording.truth.select((t >= start) & (t < start + step))
        parts.append(dataclasses.replace(recording, start_ns=start, truth=truth, **channels))
    return parts


def test_pooled_windows_measure_what_the_whole_run_does(drive: Recording, husky_rig: Rig) -> None:
    """A minute in windows of 3 s, none of which suffices alone."""
    windows = cut(drive, 3.0)
    whole, pool, alone = (measure(part, husky_rig) for part in ([drive], windows, windows[:1]))
    assert alone.yaw is None
    for measured in (whole, pool):
        assert measured.yaw is not None
        assert measured.yaw.effective_track_m == pytest.approx(0.555, rel=0.02)
        assert measured.speed_ratio["truth"].ratio == pytest.approx(1.0, abs=0.01)
        assert measured.speed_ratio["truth"].low <= 1.001
        assert measured.speed_ratio["truth"].high >= 0.999
        assert measured.gravity is not None
        assert measured.gravity.axis == "+z"
    parts = [measure([window], husky_rig).path_m["truth"] for window in windows]
    assert pool.path_m["truth"] == pytest.approx(sum(parts))
    assert whole.path_m["wheels"] == pytest.approx(whole.path_m["truth"], rel=0.01)


def test_a_standing_robot_has_no_path(drive: Recording) -> None:
    """Noise of the fixes is no way."""
    assert drive.gnss is not None
    noise = np.random.default_rng(1).normal(0.0, 0.05, drive.gnss.enu_m.shape)
    still = dataclasses.replace(drive, gnss=dataclasses.replace(drive.gnss, enu_m=noise))
    assert measure([still]).path_m["gnss"] < 1.0


def test_a_gap_of_the_wheels_adds_no_path(drive: Recording, husky_rig: Rig) -> None:
    """A clock that leaps an hour ahead is no hour of driving."""
    wheels = drive.wheels
    assert wheels is not None
    leap = np.where(np.arange(len(wheels)) > len(wheels) // 2, 3600 * 10**9, 0)
    late = dataclasses.replace(drive, wheels=dataclasses.replace(wheels, t_ns=wheels.t_ns + leap))
    path_m = measure([drive], husky_rig).path_m["wheels"]
    assert measure([late], husky_rig).path_m["wheels"] == pytest.approx(path_m, rel=0.01)


def test_long_steps_of_the_fixes_are_named(drive: Recording) -> None:
    assert drive.gnss is not None
    coarse = dataclasses.replace(drive.gnss, sigma_enu_m=np.full((len(drive.gnss), 3), 3.0))
    for recording, words in (
        (drive, "m, truth"),
        (dataclasses.replace(drive, gnss=coarse), "(in steps of 9 m"),
    ):
        assert words in lines_of(summarise(recording, measure([recording]), []))


def lines_of(page: dict) -> str:
    json.dumps(page, allow_nan=False)
    lines = [line for _, line in (*contents_lines(page), *finding_lines(page))]
    assert max(len(line) for line in lines) <= WIDTH
    return "\n".join(lines)


def polluted(value: float) -> Callable[[Recording], Recording]:
    """Every number of every channel is this one in some rows."""

    def corrupt(r: Recording) -> Recording:
        for name, channel in r.channels().items():
            changed = {}
            for spec in dataclasses.fields(channel):
                array = getattr(channel, spec.name)
                if isinstance(array, np.ndarray) and array.dtype == float:
                    changed[spec.name] = array.copy()
                    changed[spec.name][::7] = value
            r = dataclasses.replace(r, **{name: dataclasses.replace(channel, **changed)})
        return r

    return corrupt


def many_labels(r: Recording) -> Recording:
    assert r.terrain is not None
    label = np.array([f"ground number {i} of a survey" for i in range(len(r.terrain))] * 500, dtype=object)
    label = np.array([f"{word}{i}" for i, word in enumerate(label)], dtype=object)
    t_ns = r.start_ns + np.arange(len(label))
    return dataclasses.replace(r, terrain=dataclasses.replace(
        r.terrain, t_ns=t_ns, label=label, probabilities=None, classes=()
    ))  # fmt: skip


def long_words(r: Recording) -> Recording:
    return dataclasses.replace(r, name="n" * 300, licence="l" * 300, source="s " * 300).with_notes("x" * 999)


def one_row_each(r: Recording) -> Recording:
    assert r.truth is not None
    rows = {name: channel.select(slice(0, 1)) for name, channel in r.channels().items()}
    return dataclasses.replace(r, truth=r.truth.select(slice(0, 1)), **rows)


def ages(r: Recording) -> Recording:
    """All clocks leap by 31 years half-way."""
    for name, channel in r.channels().items():
        leap = np.where(np.arange(len(channel)) > len(channel) // 2, 10**18, 0)
        r = dataclasses.replace(r, **{name: dataclasses.replace(channel, t_ns=channel.t_ns + leap)})
    return r


HOSTILE: dict[str, Callable[[Recording], Recording]] = {
    "NaN": polluted(np.nan),
    "infinite": polluted(np.inf),
    "huge": polluted(1e300),
    "zero": polluted(0.0),
    "31 years": ages,
    "3000 labels": many_labels,
    "long words": long_words,
    "one row each": one_row_each,
    "no channel": lambda r: Recording("empty", r.start_ns),
    "no truth": lambda r: dataclasses.replace(r, truth=None, truth_channels=()),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_any_recording_has_a_page(name: str, drive: Recording) -> None:
    recording = HOSTILE[name](drive)
    findings = run_checks(recording)
    assert recording.name[:50] in lines_of(summarise(recording, measure([recording]), findings))
    both = [recording, drive]
    page = summarise_all("both", both, measure(both), [findings, []])
    assert "both  2 recordings" in lines_of(page)
