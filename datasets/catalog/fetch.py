"""Download recordings of the catalogue: by hash, with resume, never twice.

This module imports requests: import it where it is used.
"""

import difflib
import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import requests

from terrafusion.datasets.catalog.catalog import (
    Catalog,
    CatalogFile,
    at_hand,
    cache_folder,
    data_folders,
    load_catalog,
    sha256_of,
)
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.files import unwritable, write_atomically

CONNECT_S, SILENCE_S = 10.0, 30.0
"""A server that does not answer, or falls silent, for longer has failed."""
ATTEMPTS = 3
"""Each goes on where the one before broke off."""
BLOCK = 1 << 16

Progress = Callable[[CatalogFile, int], None]
"""Called with the file and the number of its bytes received."""


@dataclass(frozen=True)
class Fetched:
    """One file of the catalogue on this machine; `downloaded` is False where it was here already."""

    entry: CatalogFile
    path: Path
    downloaded: bool


def entries_of(catalog: Catalog, name: str) -> list[CatalogFile]:
    """The files of a set (`set`), of a recording (`set/recording`) with the set's licence, or one file.

    Raises:
        DataError: the catalogue has no such name.
    """
    if name in catalog.sets:
        return [entry for entry in catalog.files if entry.set_name == name]
    chosen = catalog.recordings().get(name) or [entry for entry in catalog.files if entry.file == name]
    if not chosen:
        close = difflib.get_close_matches(name, [*catalog.sets, *catalog.recordings()], n=3)
        remedy = f"did you mean {', '.join(close)}?" if close else f"sets: {', '.join(catalog.sets)}"
        raise DataError("is not in the catalogue", file=name, remedy=remedy)
    documents = [e for e in catalog.files if e.set_name == chosen[0].set_name and not e.recording]
    return list(dict.fromkeys([*chosen, *documents]))


def fetch(
    names: Iterable[str],
    folder: Path | None = None,
    *,
    offline: bool = False,
    progress: Progress | None = None,
) -> Iterator[Fetched]:
    """Bring recordings of the catalogue onto this machine, one file after the other.

    Args:
        names: sets, recordings (`set/recording`) or files of the catalogue.
        folder: where the files are wanted; the cache folder when None. A file that is in
            `TERRAFUSION_DATA` or in the cache with the right hash is not downloaded.
        offline: take what is here; download nothing.
        progress: called as each download proceeds.

    Yields:
        Fetched, a file at a time, as soon as it is here and its SHA-256 is the catalogue's.

    Raises:
        DataError: an unknown name, a file that is not here (offline), a server that refuses, a
            connection that breaks (what has come stays, and is gone on from), or a wrong hash.
    """
    catalog = load_catalog()
    chosen = {entry.file: entry for name in names for entry in entries_of(catalog, name)}
    for entry in chosen.values():
        here = at_hand(entry, data_folders()) if folder is None else _brought(entry, folder)
        if here is None and offline:
            raise DataError(
                "is not on this machine",
                file=entry.file,
                remedy="run again without --offline, or name a folder that holds it in TERRAFUSION_DATA",
            )
        path = here or _download(entry, folder or _cache(), progress)
        yield Fetched(entry, path, downloaded=here is None)


def _cache() -> Path:
    folder = cache_folder()
    if folder is None:
        raise DataError("there is no home folder to keep files in", remedy="name a folder with --to")
    return folder


def _brought(entry: CatalogFile, folder: Path) -> Path | None:
    """The file in `folder`, copied from where this machine has it; None where it has none."""
    there = at_hand(entry, [folder])
    here = at_hand(entry, data_folders()) if there is None else None
    if here is None:
        return there
    return write_atomically(folder / entry.file, lambda target: shutil.copyfile(here, target))


def _download(entry: CatalogFile, folder: Path, progress: Progress | None) -> Path:
    target = folder / entry.file
    part = target.with_name(f"{target.name}.part")
    try:
        part.parent.mkdir(parents=True, exist_ok=True)
        for attempt in range(1, ATTEMPTS + 1):
            try:
                _continue(entry, part, progress or (lambda entry, done: None))
                break
            except (requests.ConnectionError, requests.Timeout):
                if attempt == ATTEMPTS:
                    raise
        if sha256_of(part) == entry.sha256:
            os.replace(part, target)
            return target
    except requests.RequestException as error:
        raise DataError(
            f"cannot be downloaded from {entry.url()}: {_reason(error)}",
            file=entry.file,
            remedy="run it again, which goes on where it stopped, or put the file into TERRAFUSION_DATA",
        ) from None
    except OSError as error:
        if at_hand(entry, [folder]) is not None:  # another process was faster
            return target
        raise unwritable(target, error) from None
    part.unlink(missing_ok=True)
    raise DataError(
        f"what came from {entry.url()} has another SHA-256 than the catalogue",
        file=entry.file,
        remedy="it was thrown away; try again, and if it stays so, report it",
    )


class _BrokenOffError(requests.ConnectionError):
    """The server closed the connection before the file was whole; the text has the bytes received."""


def _reason(error: requests.RequestException) -> str:
    """The cause in one short line: requests wraps it in layers of representations."""
    if error.response is not None:
        return f"the server says {error.response.status_code} {error.response.reason}"
    if isinstance(error, requests.Timeout):
        return f"the server was silent for {SILENCE_S:g} s"
    return str(error) if isinstance(error, _BrokenOffError) else "the server cannot be reached"


def _continue(entry: CatalogFile, part: Path, progress: Progress) -> None:
    """One connection: put into the part what is missing of it."""
    part.touch()
    have = part.stat().st_size
    if have > entry.bytes:
        os.truncate(part, 0)
        have = 0
    if have == entry.bytes:
        return
    headers = {"Accept-Encoding": "identity"} | ({"Range": f"bytes={have}-"} if have else {})
    with requests.get(entry.url(), headers=headers, stream=True, timeout=(CONNECT_S, SILENCE_S)) as answer:
        answer.raise_for_status()
        if answer.status_code != requests.codes.partial_content:
            have = 0  # a server that does not resume sends the whole file
        # At its place, not at the end: of two processes, each may write what the other has written.
        with part.open("r+b") as out:
            out.seek(have)
            _receive(entry, answer, out, have, progress)


def _receive(
    entry: CatalogFile, answer: requests.Response, out: BinaryIO, have: int, progress: Progress
) -> None:
    answer.raw.enforce_content_length = False  # else the last, short block of a cut connection is lost
    try:
        for block in answer.iter_content(BLOCK):
            have += len(block)
            out.write(block[: len(block) - max(have - entry.bytes, 0)])
            progress(entry, min(have, entry.bytes))
            if have > entry.bytes:
                break  # more than in the catalogue: the hash will not match
    except (requests.ConnectionError, requests.exceptions.ChunkedEncodingError):
        pass  # reported below
    if have < entry.bytes:
        raise _BrokenOffError(f"the connection broke after {have} of {entry.bytes} bytes")
