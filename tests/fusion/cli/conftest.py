"""A log that replays well, odd files, and a limit of time."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.writers import write_log_folder
from terrafusion.twin.scenario.file import load_scenario
from terrafusion.twin.simulate import simulate

LIMIT_S = 10.0
"""Of processor time: a machine that is busy with other things makes nothing slow."""
WAITING_S = 60.0

SCENARIO = """\
description: a short drive with turns both ways
drive:
  - {duration_s: 2}
  - {duration_s: 8, v_mps: 0.9}
  - {duration_s: 8, v_mps: 0.9, yaw_rate_radps: 0.4}
  - {duration_s: 8, v_mps: 0.9, yaw_rate_radps: -0.4}
max_accel_mps2: 0.5
route:
  - {terrain: asphalt}
"""


@pytest.fixture(scope="session")
def chirp() -> Recording:
    """Changes of speed, then of the yaw rate, on asphalt; 52 s."""
    whole = load_scenario("chirp")
    shorter = tuple(dataclasses.replace(s, duration_s=min(s.duration_s, 21.0)) for s in whole.drive)
    scenario = dataclasses.replace(whole, drive=shorter, duration_s=sum(s.duration_s for s in shorter))
    return simulate(scenario, terrain="asphalt", seed=3)


@pytest.fixture(scope="session")
def good_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log folder that replays well."""
    folder = tmp_path_factory.mktemp("good")
    (folder / "short.yaml").write_text(SCENARIO)
    return write_log_folder(simulate(str(folder / "short.yaml"), seed=1), folder / "log")


@pytest.fixture
def quick(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A test that asks for this may not take long; it works in a folder of its own."""
    monkeypatch.chdir(tmp_path)
    begun, worked_s = time.monotonic(), sum(os.times()[:4])
    yield
    assert sum(os.times()[:4]) - worked_s < LIMIT_S
    assert time.monotonic() - begun < WAITING_S


@pytest.fixture
def odd_files(tmp_path: Path) -> None:
    """Files that are no logs."""
    (tmp_path / "empty.bag").touch()
    (tmp_path / "empty.mcap").touch()
    (tmp_path / "text.bag").write_text("this is no bag\n" * 500)
    (tmp_path / "text.mcap").write_text("this is no bag\n" * 500)
    (tmp_path / "text.db3").write_text("this is no bag\n" * 500)
    (tmp_path / "magic.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(5000))
    (tmp_path / "magic.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(5000))
    (tmp_path / "folder").mkdir()
    (tmp_path / "ros2").mkdir()
    (tmp_path / "ros2" / "metadata.yaml").write_text("rosbag2_bagfile_information: 5\n")
    (tmp_path / "notes.txt").write_text("hello")
