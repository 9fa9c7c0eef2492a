"""A drive of the twin as a bag, and what `replay` makes of it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers import open_recording
from terrafusion.datasets.writers.mcap import write_mcap
from terrafusion.fusion.estimate.estimate import Estimate
from terrafusion.fusion.replay import replay
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.simulate import simulate
from tests.fusion.live.bag_player import messages_of

VEHICLE, SECONDS = "elevate", 11.0


@pytest.fixture(scope="session")
def live_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """11 s of a drive on grass: Imu, JointState, NavSatFix, velocities, commands, `/tf_static`, `/datum`."""
    drive = simulate("figure_eight", terrain="grass", seed=5)
    end_ns = drive.start_ns + round(SECONDS * 1e9)
    parts = {name: channel.between(drive.start_ns, end_ns) for name, channel in drive.channels().items()}
    assert drive.truth is not None
    truth = drive.truth.select(drive.truth.t_ns < end_ns)
    path = tmp_path_factory.mktemp("live") / "drive.mcap"
    write_mcap(dataclasses.replace(drive, truth=truth, **parts), path, rig=load_vehicle(VEHICLE).rig())
    return path


@pytest.fixture(scope="session")
def live_recording(live_bag: Path) -> Recording:
    """The bag read by its standard messages: a topic that is named switches this library's own off."""
    return open_recording(live_bag, rig=load_vehicle(VEHICLE).rig(), topics={"imu": "/imu/data"})


@pytest.fixture(scope="session")
def replayed(live_recording: Recording) -> Estimate:
    """The estimate of `replay`."""
    return replay(live_recording, vehicle=VEHICLE).estimate


@pytest.fixture(scope="module")
def messages(live_bag: Path) -> list[tuple[int, str, str, bytes]]:
    return messages_of(live_bag)
