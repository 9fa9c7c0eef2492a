"""Where compiled libraries are kept, and which may be loaded: whole, in a folder that only the user writes.

A library runs with the rights of whoever loads it, so none is taken from a folder or file that others could
have written. Beside each stands its SHA-256; one that is damaged is compiled again.
"""

import contextlib
import functools
import hashlib
import logging
import os
import stat
from pathlib import Path

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.files import write_atomically
from terrafusion.datasets.core.scratch import process_folder

LOG = logging.getLogger("terrafusion.twin")


def wanted_folder() -> Path | None:
    """`$TERRAFUSION_CACHE`, `$XDG_CACHE_HOME/terrafusion` or `~/.cache/terrafusion`; None without a home."""
    own = os.environ.get("TERRAFUSION_CACHE")
    if own:
        return Path(own)
    base = os.environ.get("XDG_CACHE_HOME")
    try:
        return (Path(base) if base else Path.home() / ".cache") / "terrafusion"
    except RuntimeError:  # neither HOME nor an entry for the user
        return None


def cache_folder() -> Path:
    """The folder for compiled libraries: the wanted one if it is private, else one for this process alone."""
    folder = wanted_folder()
    if folder is None:
        say("there is no home folder: the twin is compiled anew for each process; set TERRAFUSION_CACHE")
        return process_folder()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if is_private(folder):
            return folder
    except OSError as error:  # a read-only or full home
        LOG.info("no cache in %s (%s)", folder, error)
        return process_folder()
    say(
        f"{folder}: others can write to this folder, so no compiled code is loaded from it and the twin is "
        "compiled anew for each process; take their rights away (chmod go-w), or set TERRAFUSION_CACHE"
    )
    return process_folder()


def is_private(path: Path) -> bool:
    """Whether a folder or plain file belongs to the user (or root) and nobody else may write to it."""
    if not hasattr(os, "geteuid"):  # Windows: the user's profile is private
        return True
    about = path.stat() if path.is_dir() else path.lstat()
    plain = stat.S_ISDIR(about.st_mode) or stat.S_ISREG(about.st_mode)
    return plain and about.st_uid in (0, os.geteuid()) and not about.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def is_whole(library: Path) -> bool:
    """Whether the library is there, private, and what was compiled."""
    try:
        kept = _hash_file(library).read_text(encoding="ascii")
        return is_private(library) and hashlib.sha256(library.read_bytes()).hexdigest() == kept
    except (OSError, ValueError):
        return False


def keep(built: Path, library: Path) -> Path:
    """Move a compiled library to its place, and write its hash."""
    built.chmod(0o700)
    digest = hashlib.sha256(built.read_bytes()).hexdigest()
    os.replace(built, library)
    _write(_hash_file(library), digest)
    return library


def noted(note: Path) -> Path | None:
    """The whole library that a note names, None where there is none."""
    with contextlib.suppress(OSError, ValueError):
        if is_private(note):
            library = note.with_name(Path(note.read_text(encoding="ascii")).name)
            return library if is_whole(library) else None
    return None


def write_note(note: Path, library: Path) -> None:
    """Remember which library it is."""
    if library.parent == note.parent:
        _write(note, library.name)


def _hash_file(library: Path) -> Path:
    return library.with_name(f"{library.name}.sha256")


def _write(path: Path, text: str) -> None:
    def write(part: Path) -> None:
        part.write_text(text, encoding="ascii")
        part.chmod(0o600)

    with contextlib.suppress(TerrafusionError, OSError):
        write_atomically(path, write)


@functools.cache
def say(message: str) -> None:
    """Log a warning once."""
    LOG.warning(message)
