"""Private folders for work in progress; those that a killed process left are removed by a later one."""

import atexit
import contextlib
import functools
import hashlib
import os
import platform
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PREFIX = ".terrafusion-"
UNFINISHED = "unfinished"
"""Only key of the meta.yaml of a log that is being replaced: no reader takes it, a writer knows its log."""
STALE_S = 3600.0
"""What is younger and not of this machine may belong to a process that runs elsewhere and shares the disk."""


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
    return Path(tempfile.mkdtemp(dir=place, prefix=f"{PREFIX}{os.getpid()}-{machine()}-"))


@functools.cache
def machine() -> str:
    """What tells the process numbers of this machine, and of this container, from those of others."""
    known = [platform.node()]
    with contextlib.suppress(OSError):
        known += [Path("/proc/sys/kernel/random/boot_id").read_text(), os.readlink("/proc/self/ns/pid")]
    return hashlib.sha256("".join(known).encode()).hexdigest()[:8]


def is_part(name: str) -> bool:
    """Whether the name of an entry says that it is work in progress, or what a killed process left of it."""
    return name.startswith(PREFIX) or name.endswith(".part")


def sweep(folder: Path, prefix: str) -> None:
    """Remove what killed processes left: entries named `prefix`, process id, `machine()`, more.

    Process id and machine end in `-` or `.`.
    """
    with contextlib.suppress(OSError):
        for entry in [entry for entry in os.scandir(folder) if entry.name.startswith(prefix)]:
            with contextlib.suppress(OSError, ValueError):
                number, place, *_ = entry.name[len(prefix) :].replace(".", "-").split("-")
                if _is_left(entry, int(number), place == machine()):
                    if entry.is_dir(follow_symlinks=False):
                        shutil.rmtree(entry.path, ignore_errors=True)
                    else:
                        os.unlink(entry.path)


def _is_left(entry: os.DirEntry[str], process: int, here: bool) -> bool:
    """Whether an entry is ours and of a process that does not run; old, unless the process was `here`."""
    about = entry.stat(follow_symlinks=False)
    if hasattr(os, "getuid") and about.st_uid != os.getuid():
        return False
    if not here and time.time() - about.st_mtime < STALE_S:
        return False
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return True
    return False
