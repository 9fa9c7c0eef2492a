"""Folders for work in progress: private, removed, and swept after a kill."""

from __future__ import annotations

import os
from pathlib import Path

from terrafusion.datasets.core.files import write_atomically
from terrafusion.datasets.core.scratch import PREFIX, machine, scratch_folder

DEAD = 2**22 + 1  # above the largest process id of Linux


def test_a_scratch_folder_is_private_and_removed(tmp_path: Path) -> None:
    with scratch_folder(tmp_path) as folder:
        assert folder.parent == tmp_path
        assert folder.stat().st_mode & 0o077 == 0
        (folder / "part").write_text("x")
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_process_left_is_swept(tmp_path: Path) -> None:
    """At once where it ran here. Kept are what is young and of another machine, what a running process may
    use, and files of other names."""
    names = (
        f"{DEAD}-a",
        f"{DEAD}-b",
        f"{os.getpid()}-c",
        f"{DEAD}-{machine()}-d",
        f"{os.getpid()}-{machine()}",
    )
    left, young, live, fresh, busy = (tmp_path / f"{PREFIX}{name}" for name in names)
    mine = tmp_path / f"{PREFIX}notes"
    for folder in (left, young, live, fresh, busy, mine):
        folder.mkdir()
        (folder / "x").write_text("x")
    for folder in (left, live, mine):
        os.utime(folder, (0, 0))
    with scratch_folder(tmp_path):
        pass
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        path.name for path in (young, live, busy, mine)
    )


def test_a_part_of_a_killed_writer_is_swept(tmp_path: Path) -> None:
    (tmp_path / f".a.csv.{DEAD}.{machine()}.part").write_text("half")
    write_atomically(tmp_path / "a.csv", lambda part: part.write_text("whole"))
    assert [path.name for path in tmp_path.iterdir()] == ["a.csv"]
