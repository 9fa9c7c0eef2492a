"""The catalogue of public recordings: what they are, whose, where, and how to read them.

`catalog.yaml` describes the sets and their conventions; `catalog_files.csv` pins every file by
repository, commit and SHA-256. Own files and sets are added by a folder with two such files, which
`TERRAFUSION_CATALOG` names; its `repository` may be a URL, and without own sets it needs no YAML.
The library carries no recording: `TERRAFUSION_DATA` names a folder that holds them, otherwise they
are downloaded (`fetch`).
"""

import csv
import fnmatch
import functools
import hashlib
import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

from terrafusion.datasets.core.config import structure
from terrafusion.datasets.core.conventions import Conventions
from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.datasets.core.quantity import shown
from terrafusion.datasets.core.yaml_file import read_yaml

HERE = Path(__file__).parent
DATA_VARIABLE, CATALOG_VARIABLE = "TERRAFUSION_DATA", "TERRAFUSION_CATALOG"
_CELLS = {
    "set": r".+", "recording": r".*", "file": r".+", "repository": r"https?://\S+|[\w.-]+/[\w.-]+",
    "commit": r".*", "path": r".*", "sha256": r"[0-9a-f]{64}", "bytes": r"[0-9]{1,15}",
}  # fmt: skip
"""Patterns of the cells of a list of files, by column."""
FILE_COLUMNS = tuple(_CELLS)


@dataclass(frozen=True)
class CatalogFile:
    """One file of a set: `file` is its name in the catalogue, `recording` "" where it is a document."""

    set_name: str
    recording: str
    file: str
    repository: str
    commit: str
    path: str
    sha256: str
    bytes: int

    def url(self) -> str:
        """Where the file can be downloaded."""
        if "://" in self.repository:
            return f"{self.repository}/{self.path}"
        return f"https://raw.githubusercontent.com/{self.repository}/{self.commit}/{quote(self.path)}"


@dataclass(frozen=True)
class SetVariant:
    """What holds for some recordings of a set only, as under `cases` in `catalog.yaml`."""

    conventions: Conventions = field(default_factory=Conventions)
    note: str = ""


@dataclass(frozen=True)
class SetFile:
    """Keys of a set in `catalog.yaml`.

    Attributes:
        title, holds, licence, citation, homepage: texts for people.
        format: the reader's name; files of this format that are not in the catalogue are read
            with the conventions of the set, with a note.
        conventions: hold for all its recordings.
        cases: by pattern of the recording's name (as in a shell), what differs there.
    """

    title: str
    holds: str
    licence: str
    citation: str
    homepage: str
    format: str
    conventions: Conventions = field(default_factory=Conventions)
    cases: dict[str, SetVariant] = field(default_factory=dict)


@dataclass(frozen=True)
class DataSet(SetFile):
    """One set of recordings; `content` is what the file gives: a variant changes only what it gives."""

    name: str = ""
    content: dict[str, Any] = field(default_factory=dict)

    def conventions_of(self, recording: str = "") -> Conventions:
        """The conventions of one recording, or of an unknown one of the same kind."""
        merged = dict(self.content.get("conventions", {}))
        for pattern, case in self.content.get("cases", {}).items():
            if fnmatch.fnmatchcase(recording, pattern):
                merged |= case.get("conventions", {})
        return structure(Conventions, merged, file="catalog.yaml", key=f"{self.name}.conventions")

    def notes_of(self, recording: str) -> tuple[str, ...]:
        """Remarks of the catalogue on one recording."""
        return tuple(c.note for p, c in self.cases.items() if c.note and fnmatch.fnmatchcase(recording, p))


@dataclass(frozen=True)
class Catalog:
    """All sets and files."""

    sets: dict[str, DataSet]
    files: tuple[CatalogFile, ...]

    def find(self, path: Path) -> CatalogFile | None:
        """The entry whose bytes are those of the file at `path`, or None."""
        size = path.stat().st_size
        same_size = [entry for entry in self.files if entry.bytes == size]
        if not same_size:
            return None
        digest = sha256_of(path)
        return next((entry for entry in same_size if entry.sha256 == digest), None)

    def recordings(self) -> dict[str, list[CatalogFile]]:
        """Files of every recording, by `set/recording`."""
        found: dict[str, list[CatalogFile]] = {}
        for entry in self.files:
            if entry.recording:
                found.setdefault(f"{entry.set_name}/{entry.recording}", []).append(entry)
        return found


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def load_catalog() -> Catalog:
    """The catalogue of the library, with that of `TERRAFUSION_CATALOG` added.

    Raises:
        ConfigError: a file of a catalogue is wrong.
    """
    return _load(os.environ.get(CATALOG_VARIABLE, ""))


@functools.cache
def _load(own: str) -> Catalog:
    sets: dict[str, DataSet] = {}
    files: list[CatalogFile] = []
    for folder in [HERE, *([Path(own)] if own else [])]:
        if folder == HERE or (folder / "catalog.yaml").exists():  # own files may be of a known set
            sets |= _read_sets(folder / "catalog.yaml")
        files += _read_files(folder / "catalog_files.csv", set(sets))
    return Catalog(sets, tuple(files))


def _read_sets(path: Path) -> dict[str, DataSet]:
    content = read_yaml(path)
    found = structure(dict[str, SetFile], content, file=path)
    return {name: DataSet(**vars(found[name]), name=name, content=raw) for name, raw in content.items()}


def _read_files(path: Path, sets: set[str]) -> list[CatalogFile]:
    try:
        with path.open(encoding="utf-8", newline="") as text:
            rows = list(csv.reader(text))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"cannot be read: {error}", file=path, remedy="give a UTF-8 CSV") from None
    if not rows or tuple(rows[0]) != FILE_COLUMNS:
        raise ConfigError(
            "the columns are not those of a catalogue", file=path, remedy=f"give {', '.join(FILE_COLUMNS)}"
        )
    return [_entry(path, number, row, sets) for number, row in enumerate(rows[1:], 2) if row]


def _entry(path: Path, number: int, row: list[str], sets: set[str]) -> CatalogFile:
    """A row as an entry; its file must stay inside the folder it is downloaded to."""
    if len(row) != len(FILE_COLUMNS):
        remedy = f"give {', '.join(FILE_COLUMNS)}"
        raise ConfigError(f"has {len(row)} cells at line {number}", file=path, remedy=remedy)
    for (name, pattern), cell in zip(_CELLS.items(), row, strict=True):
        outside = name == "file" and (Path(cell).is_absolute() or ".." in Path(cell).parts)
        if not re.fullmatch(pattern, cell) or outside or (name == "set" and cell not in sets):
            what = f"column '{name}' is '{shown(cell)}' at line {number}"
            remedy = "give a known set, a relative file, owner/name or a URL, and the file's SHA-256 and size"
            raise ConfigError(what, file=path, remedy=remedy)
    of_set, recording, file, repository, commit, source, sha256, size = row
    return CatalogFile(of_set, recording, file, repository, commit, source, sha256, int(size))


def locate(name: str) -> Path | None:
    """The local copy of the first file of a catalogued file or recording, or None where `name` is neither.

    Raises:
        DataError: it is in the catalogue, but neither in `TERRAFUSION_DATA` nor downloaded.
    """
    catalog = load_catalog()
    entries = [entry for entry in catalog.files if entry.file == name] or catalog.recordings().get(name, [])
    if not entries:
        return None
    entry = entries[0]
    found = at_hand(entry, data_folders())
    if found is not None:
        return found
    other = next((path for folder in data_folders() if (path := folder / entry.file).is_file()), None)
    if other is not None:
        raise DataError(
            "has other bytes than the catalogue's",
            file=other,
            remedy=f"fetch it again with `terrafusion fetch {entry.set_name}`, or give its path",
        )
    raise DataError(
        "is in the catalogue, but not on this machine",
        file=name,
        remedy=f"download it with `terrafusion fetch {entries[0].set_name}`, or set {DATA_VARIABLE}",
    )


def at_hand(entry: CatalogFile, folders: list[Path]) -> Path | None:
    """The copy of a file in one of the folders whose bytes are the catalogue's; None where there is none."""
    for folder in folders:
        path = folder / entry.file
        try:
            if path.stat().st_size == entry.bytes and sha256_of(path) == entry.sha256:
                return path
        except OSError:  # not there, or it cannot be read
            continue
    return None


def data_folders() -> list[Path]:
    """Where local copies are looked for: `TERRAFUSION_DATA`, then the download cache."""
    given = os.environ.get(DATA_VARIABLE)
    cache = cache_folder()
    return [*([Path(given)] if given else []), *([] if cache is None else [cache])]


def cache_folder() -> Path | None:
    """The folder that downloads go to, as the operating system has it; None where the user has no home."""
    import platformdirs

    try:
        folder = Path(platformdirs.user_cache_dir("terrafusion"))
    except RuntimeError:  # neither HOME nor an entry for the user
        return None
    return folder if folder.is_absolute() else None
