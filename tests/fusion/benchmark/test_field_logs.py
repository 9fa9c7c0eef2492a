"""Field logs as runs of the benchmark: their outages, ground and reference."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from terrafusion.datasets.core.channels import Imu, Terrain, Wheels
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.benchmark import field_logs
from terrafusion.fusion.benchmark.field_logs import FieldLog, ground_of, outages_of, reference_of, runs_of
from terrafusion.fusion.benchmark.outage_plan import (
    aided_by_truth,
)

SECOND_NS = 1_000_000_000


def _imu_like(wheels: Wheels) -> Imu:
    zero = np.zeros((len(wheels), 3))
    return Imu(wheels.t_ns, zero, zero + np.array([0.0, 0.0, 9.81]))


def test_outages_begin_once_the_robot_has_moved_and_only_where_it_moves(drive: Callable[..., Any]) -> None:
    recording = aided_by_truth(drive(seconds=300.0).recording, seed=1)
    wheels = recording.wheels
    assert wheels is not None
    recording = dataclasses.replace(recording, imu=_imu_like(wheels))
    assert {o.seconds for o in outages_of(recording, 3)} == {30.0, 60.0, 120.0}
    stands = (wheels.t_ns - recording.start_ns) * 1e-9 < 100.0
    late = dataclasses.replace(wheels, speed=np.where(stands[:, None], 0.0, wheels.speed))
    assert min(o.start_s for o in outages_of(dataclasses.replace(recording, wheels=late), 3)) > 100.0
    never = dataclasses.replace(wheels, speed=0.0 * wheels.speed)
    assert outages_of(dataclasses.replace(recording, wheels=never), 3) == []


def test_ground_is_the_labels_then_the_sets_then_unknown(drive: Callable[..., Any]) -> None:
    bare: Recording = drive(seconds=20.0).recording
    assert ground_of("mine", bare) == ""
    assert ground_of("husky_parkinglot/test1", bare) == "firm"
    assert ground_of("mine", dataclasses.replace(bare, terrain_name="gravel")) == "firm"
    t_ns = np.array([bare.start_ns, bare.start_ns + SECOND_NS])
    both = Terrain(t_ns, np.array(["asphalt", "mud"], dtype=object))
    assert ground_of("mine", dataclasses.replace(bare, terrain=both)) == "slipping"


def test_reference_is_truth_before_fixes(drive: Callable[..., Any]) -> None:
    made = drive(seconds=20.0)
    assert reference_of(made.recording) == "truth"
    without = dataclasses.replace(made.recording, truth=None)
    assert reference_of(without) == "none"
    assert reference_of(dataclasses.replace(without, gnss=made.fixes)) == "held-out fixes"
    speed_only = dataclasses.replace(made.recording, truth_channels=("velocity",))
    assert reference_of(speed_only) == "none"


def test_a_log_is_read_once_for_methods_that_follow_each_other(
    drive: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[str] = []
    bare = dataclasses.replace(drive(seconds=20.0).recording, wheels=None)

    def read_again(log: str) -> list[Recording]:
        read.append(log)
        return [bare]

    field_logs.opened.cache_clear()
    monkeypatch.setattr(field_logs, "open_recordings", read_again)
    for log in ("one", "one", "two"):
        (refusal,) = runs_of(FieldLog(log))
        assert isinstance(refusal, field_logs.Refusal)
        assert refusal.log == log
        assert "no wheels" in refusal.why
    assert read == ["one", "two"]
    field_logs.opened.cache_clear()


def test_logs_cut_into_windows_are_no_runs_of_the_benchmark(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(field_logs, "present_recordings", lambda: ["a/raw", "a/windows", "b/windows", "c/s1"])
    assert [log.name for log in field_logs.present_logs()] == ["a/raw", "c/s1"]
