"""Download recordings of the catalogue: by hash, with resume, never twice.

This module imports requests and pooch: import it where it is used.
"""

import difflib
import logging
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pooch
import requests

from terrafusion.datasets.catalog.catalog import (
    Catalog,
    CatalogFile,
    at_hand,
    cache_folder,
    data_folders,
    load_catalog,
)
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.files import unwritable

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
    target = folder / entry.file
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(here, target)
    except OSError as error:
        raise unwritable(target, error) from None
    return target


def _download(entry: CatalogFile, folder: Path, progress: Progress | None) -> Path:
    try:
        with _quiet_pooch():
            path = pooch.retrieve(
                entry.url(),
                f"sha256:{entry.sha256}",
                fname=entry.file,
                path=folder,
                downloader=_Resuming(entry, folder / f"{entry.file}.part", progress),
            )
    except requests.RequestException as error:
        raise DataError(
            f"cannot be downloaded from {entry.url()}: {_reason(error)}",
            file=entry.file,
            remedy="run it again, which goes on where it stopped, or put the file into TERRAFUSION_DATA",
        ) from None
    except OSError as error:
        raise unwritable(folder / entry.file, error) from None
    except ValueError:  # pooch found another hash, and has removed what came
        raise DataError(
            f"what came from {entry.url()} has another SHA-256 than the catalogue",
            file=entry.file,
            remedy="it was thrown away; try again, and if it stays so, report it",
        ) from None
    return Path(path)


@contextmanager
def _quiet_pooch() -> Iterator[None]:
    """Silences pooch, which reports each download on standard error."""
    logger = pooch.get_logger()
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


class _BrokenOffError(requests.ConnectionError):
    """The server closed the connection before the file was whole; the text has the bytes received."""


def _reason(error: requests.RequestException) -> str:
    """The cause in one short line: requests wraps it in layers of representations."""
    if error.response is not None:
        return f"the server says {error.response.status_code} {error.response.reason}"
    if isinstance(error, requests.Timeout):
        return f"the server was silent for {SILENCE_S:g} s"
    return str(error) if isinstance(error, _BrokenOffError) else "the server cannot be reached"


class _Resuming:
    """A downloader for pooch that keeps what has come in a `.part` file and asks only for the rest."""

    def __init__(self, entry: CatalogFile, part: Path, progress: Progress | None) -> None:
        self.entry, self.part = entry, part
        self.progress = progress or (lambda entry, done: None)

    def __call__(self, url: str, output_file: str, pooch: Any) -> None:
        """Fetch `url` into `output_file`, in several attempts where the connection breaks."""
        self.part.parent.mkdir(parents=True, exist_ok=True)
        for attempt in range(1, ATTEMPTS + 1):
            try:
                self._go_on(url)
                break
            except (requests.ConnectionError, requests.Timeout):
                if attempt == ATTEMPTS:
                    raise
        shutil.move(self.part, output_file)

    def _go_on(self, url: str) -> None:
        """One connection: append to the part what is missing of it."""
        have = self.part.stat().st_size if self.part.exists() else 0
        if have > self.entry.bytes:
            have = 0
        if have == self.entry.bytes:
            return
        headers = {"Accept-Encoding": "identity"} | ({"Range": f"bytes={have}-"} if have else {})
        with requests.get(url, headers=headers, stream=True, timeout=(CONNECT_S, SILENCE_S)) as answer:
            answer.raise_for_status()
            if answer.status_code != requests.codes.partial_content:
                have = 0  # a server that does not resume sends the whole file
            with self.part.open("ab" if have else "wb") as out:
                self._receive(answer, out, have)

    def _receive(self, answer: requests.Response, out: Any, have: int) -> None:
        answer.raw.enforce_content_length = False  # else the last, short block of a cut connection is lost
        try:
            for block in answer.iter_content(BLOCK):
                have += len(block)
                out.write(block[: len(block) - max(have - self.entry.bytes, 0)])
                self.progress(self.entry, min(have, self.entry.bytes))
                if have > self.entry.bytes:
                    break  # more than in the catalogue: the hash will not match
        except (requests.ConnectionError, requests.exceptions.ChunkedEncodingError):
            pass  # reported below
        if have < self.entry.bytes:
            raise _BrokenOffError(f"the connection broke after {have} of {self.entry.bytes} bytes")
