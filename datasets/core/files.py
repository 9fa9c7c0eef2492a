"""Atomic writing of files, and checks of output folders."""

import os
import tempfile
from collections.abc import Callable
from pathlib import Path

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.scratch import machine, sweep


def write_atomically(path: Path, write: Callable[[Path], object]) -> Path:
    """Let `write` fill a file beside `path`, then rename it to `path`; missing folders are made.

    Raises:
        DataError: the folder cannot be made or written.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{machine()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        sweep(path.parent, f".{path.name}.")
        write(temporary)
        os.replace(temporary, path)
    except OSError as error:
        raise unwritable(path, error) from None
    finally:
        if path.parent.is_dir():
            temporary.unlink(missing_ok=True)
    return path


def expanded(text: str | Path) -> Path:
    """The path with the user's home for `~`, where there is one."""
    try:
        return Path(text).expanduser()
    except RuntimeError:
        return Path(text)


def check_folder(path: Path) -> None:
    """Refuse an output folder that cannot be made or written (DataError) before any work; it is not made."""
    try:
        there = next(place for place in (path, *path.absolute().parents) if place.exists())
        tempfile.TemporaryFile(dir=there).close()
    except OSError as error:
        raise unwritable(path, error) from None


def unwritable(path: Path, error: OSError) -> DataError:
    """The error that states why `path` cannot be written."""
    return DataError(
        f"cannot be written: {error.strerror or error}",
        file=path,
        remedy="choose a folder you may write to, with room on the disk",
    )
