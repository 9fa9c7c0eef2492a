"""A writer killed before any of its file operations leaves the old log, no log, or the whole new one."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import pytest

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.scratch import PREFIX
from terrafusion.datasets.readers import open_recording
from terrafusion.datasets.writers import write_log_folder
from terrafusion.fusion.cli.simulate import OUTPUT
from terrafusion.twin.scenario.scenario import DriveSegment, Scenario
from terrafusion.twin.simulate import simulate
from tests.studies.kills.child import watched


@pytest.fixture(scope="module")
def recording() -> Recording:
    scenario = Scenario("short", 2.0, drive=(DriveSegment(2.0, 1.0),))
    return dataclasses.replace(simulate(scenario, seed=1), truth=None, motor=None)


def killed_writer(recording: Recording, folder: Path, before: int) -> bool:
    """Writes in a child that dies before its file operation `before`; whether it got so far."""
    child = os.fork()
    if child == 0:
        watched(before)
        write_log_folder(recording, folder)
        os._exit(0)
    return os.WIFSIGNALED(os.waitpid(child, 0)[1])


def test_a_killed_writer_is_repeated_over_what_it_left(recording: Recording, tmp_path: Path) -> None:
    folder = tmp_path / "out" / "log"
    old = dataclasses.replace(recording, command=None, notes=("old",))
    write_log_folder(old, folder)
    seen, before = set(), 1
    while killed_writer(recording, folder, before):
        try:
            found = open_recording(str(folder))
            seen.add("old" if "old" in found.notes else "new")
            whole = old if "old" in found.notes else recording
            assert {k: len(c) for k, c in found.channels().items()} == {
                k: len(c) for k, c in whole.channels().items()
            }
        except TerrafusionError as error:
            seen.add(str(error).partition(": ")[2])
        OUTPUT.place(folder, "simulate", "log", force=False)
        before += 1
    assert seen == {"old", "new", "the log was not written to its end; write it again"}
    assert before > 10
    write_log_folder(recording, folder)
    assert open_recording(str(folder)).notes == recording.notes
    left = [path for path in tmp_path.rglob("*") if path.name.startswith(PREFIX)]
    assert not left
