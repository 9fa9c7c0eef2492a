"""Private folders for work in progress; those that a killed process left are removed by a later one."""

from __future__ import annotations

import atexit
import contextlib
import functools
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PREFIX = ".terrafusion-"
STALE_S = 3600.0
"""What is younger may belong to a process on another machine that shares the disk."""


@contextmanager
def scratch_folder(parent: Path | None = None) -> Iterator[Path]:
    """A folder in `parent` (None: the system's place for temporary files), removed at the end."""
    folder = _new_folder(parent)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@functools.cache
def process_folder() -> Path:
    """The folder that lasts as long as this process."""
    folder = _new_folder(None)
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _new_folder(parent: Path | None) -> Path:
    place = Path(tempfile.gettempdir()) if parent is None else parent
    sweep(place, PREFIX)
    return Path(tempfile.mkdtemp(dir=place, prefix=f"{PREFIX}{os.getpid()}-"))


def sweep(folder: Path, prefix: str) -> None:
    """Remove what killed processes left: entries of `folder` named `prefix`, process id, `-` or `.`, more."""
    with contextlib.suppress(OSError):
        for entry in [entry for entry in os.scandir(folder) if entry.name.startswith(prefix)]:
            with contextlib.suppress(OSError, ValueError):
                number = int(entry.name[len(prefix) :].replace(".", "-").split("-")[0])
                if _is_left(entry, number):
                    if entry.is_dir(follow_symlinks=False):
                        shutil.rmtree(entry.path, ignore_errors=True)
                    else:
                        os.unlink(entry.path)


def _is_left(entry: os.DirEntry[str], process: int) -> bool:
    """Whether an entry is ours, old, and of a process that does not run."""
    about = entry.stat(follow_symlinks=False)
    if time.time() - about.st_mtime < STALE_S or (hasattr(os, "getuid") and about.st_uid != os.getuid()):
        return False
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return True
    return False
