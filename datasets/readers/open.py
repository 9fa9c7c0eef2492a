"""`open_recording` and `open_recordings`: every format by one function."""

import dataclasses
import difflib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from terrafusion.datasets.catalog.catalog import CatalogFile, load_catalog, locate, sha256_of
from terrafusion.datasets.core.conventions import BODY_AXES, Conventions, apply, turned_as_mounted
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.printable import counted
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import Rig
from terrafusion.datasets.readers.formats import Format, Request, format_of

STAMPS = ("header", "receipt")
NOT_USED = "not used here"
"""How a note ends on an option that means nothing for the format of a log."""
CUT_OFF = "cut off"
"""In every note on a file that ends too early."""


def open_recordings(
    path: Path | str,
    *,
    rig: Rig | None = None,
    topics: Mapping[str, str] | None = None,
    stamps: str = "header",
    repair_clock: bool = False,
    columns: Path | str | None = None,
) -> list[Recording]:
    """Read the recordings of a log, whatever its format.

    Args:
        path: a log folder, a ROS bag, a file of a public set, a table, ..., or the name of a
            recording in the catalogue (`set/recording`). `path#3` is the fourth of several.
        rig: geometry of the robot: mounting of its IMU, the track its odometry uses, its usual
            topics. Without it the IMU is taken as mounted along the body axes, unless the
            catalogue says otherwise.
        topics: topic of a channel where the choice by type is not the one wanted, such as
            {"imu": "/imu/data", "wheels": "/odom", "gnss": "/fix"}; ROS bags only.
        stamps: times of a ROS bag: "header" (when measured) or "receipt" (when recorded).
        repair_clock: remove steps of a clock, which are refused otherwise; each is listed in
            the recording's `clock_jumps`.
        columns: YAML file that says what the columns of a plain table are.

    Returns:
        The recordings, mostly one; their notes say what was chosen, assumed and left out.

    Raises:
        TerrafusionError: in one line the file, the channel, the time where known, and the remedy.
    """
    if not isinstance(path, (str, Path)):
        raise DataError(f"a {type(path).__name__} is no path of a log", remedy="give a path or a name")
    if stamps not in STAMPS:
        raise DataError(f"stamps is '{stamps}'", file=path, remedy=f"give one of {', '.join(STAMPS)}")
    if not (topics is None or isinstance(topics, Mapping)):
        raise DataError(f"topics is {topics!r}", file=path, remedy="give {'imu': '/imu/data', ...}")
    if not (columns is None or isinstance(columns, (str, Path))):
        raise DataError(f"columns is {columns!r}", file=path, remedy="give the path of a column map")
    place, number = find_log(path)
    form = format_of(place, mapped=columns is not None)
    entry, conventions, notes = _known(place, form)
    if rig is not None and form.name in ("ros1", "ros2"):
        conventions = dataclasses.replace(conventions, imu_axes=BODY_AXES)  # the reader turns it by the rig
    map_file = Path(columns) if columns is not None else None
    pinned = entry.sha256 if entry is not None else ""
    request = Request(place, rig, topics, stamps, repair_clock, map_file, pinned, conventions)
    recordings = form.read(request)
    if number is not None and number >= len(recordings):
        what = f"holds {counted(len(recordings), 'recording')}, numbered from 0"
        raise DataError(what, file=place, remedy="give a smaller number")
    chosen = recordings if number is None else [recordings[number]]
    found = [
        apply(_credited(r, entry).with_notes(*notes, *_unused(form, request)), conventions) for r in chosen
    ]
    return found if rig is None else [turned_as_mounted(r, rig) for r in found]


def open_recording(path: Path | str, **options: Any) -> Recording:
    """Read the one recording of a log; arguments and errors as in `open_recordings`.

    Raises:
        DataError: also where the log holds several: choose one with `path#number`.
    """
    recordings = open_recordings(path, **options)
    if len(recordings) != 1:
        raise DataError(
            f"holds {len(recordings)} recordings",
            file=path,
            remedy=f"choose one: '{path}#0' to '{path}#{len(recordings) - 1}'",
        )
    return recordings[0]


def find_log(path: Path | str) -> tuple[Path, int | None]:
    """The file or folder that LOG stands for, and the number after `#` where there is one.

    Raises:
        DataError: it cannot be read; or it is in the catalogue, but not on this machine, or a document.
    """
    text, mark, number = str(path).rpartition("#")
    numbered = bool(mark) and number.isascii() and number.isdigit() and len(number) < 9
    try:
        numbered = numbered and not Path(path).exists()
        name = text if numbered else str(path)
        place = Path(name)
        if not place.exists():
            place = locate(name) or _misspelt(name, place)
        entry = load_catalog().find(place) if place.is_file() else None
    except OSError as error:
        raise DataError(
            f"cannot be read: {error.strerror or error}",
            file=path,
            remedy="check the path and its permissions",
        ) from None
    if entry is not None and not entry.recording:
        remedy = f"`terrafusion fetch` lists the recordings of {entry.set_name}"
        raise DataError(f"is a document of the set {entry.set_name}, no recording", file=place, remedy=remedy)
    return place, int(number) if numbered else None


def files_of(path: Path | str) -> list[Path]:
    """The files that `open_recordings` reads of a log.

    Raises:
        DataError: there is no such log, or no format claims it.
    """
    place, _ = find_log(path)
    return format_of(place).files(place)


def hashes_of(logs: Sequence[str]) -> dict[str, str]:
    """SHA-256 of every file of the logs, by folder and name, with more folders where names coincide.

    Raises:
        DataError: there is no such log.
    """
    files = sorted({file.resolve() for log in logs for file in files_of(log)})
    longest = max((len(file.parts) for file in files), default=0)
    names: list[str] = []
    for parts in range(2, longest + 1):
        names = ["/".join(file.parts[-parts:]) for file in files]
        if len(set(names)) == len(files):
            break
    return {name: sha256_of(file) for name, file in zip(names, files, strict=True)}


def _misspelt(name: str, place: Path) -> Path:
    """`place`; DataError where the name is nearly one of the catalogue's."""
    close = difflib.get_close_matches(name, load_catalog().recordings(), n=3, cutoff=0.8)
    if close:
        remedy = f"did you mean {', '.join(close)} of the catalogue?"
        raise DataError("no such file or folder", file=name, remedy=remedy)
    return place


def _known(path: Path, form: Format) -> tuple[CatalogFile | None, Conventions, tuple[str, ...]]:
    """What the catalogue says of a log, by the bytes of a file, else by its format."""
    catalog = load_catalog()
    files = [path] if path.is_file() else form.files(path)
    entry = next((found for file in files if (found := catalog.find(file)) is not None), None)
    if entry is not None:
        known = catalog.sets[entry.set_name]
        return entry, known.conventions_of(entry.recording), known.notes_of(entry.recording)
    same = next((s for s in catalog.sets.values() if s.format == form.name), None)
    if same is None:
        return None, Conventions(), ()
    note = f"this file is not in the catalogue; read with the conventions of {same.name}: check the findings"
    return None, same.conventions_of(), (note,)


def _credited(recording: Recording, entry: CatalogFile | None) -> Recording:
    if entry is None:
        return recording
    known = load_catalog().sets[entry.set_name]
    return dataclasses.replace(
        recording, licence=known.licence, source=recording.source or f"{known.homepage} ({entry.file})"
    )


def _unused(form: Format, request: Request) -> list[str]:
    """Notes on options that mean nothing for this format."""
    bag = form.name in ("ros1", "ros2")
    used = {"topics": request.topics, "stamps": request.stamps != "header"}
    given = [] if bag else [word for word, value in used.items() if value]
    notes = [f"{' and '.join(given)} only matter for ROS bags; {NOT_USED}"] if given else []
    if request.columns is not None and form.name != "table" and not bag:
        notes.append(f"columns only matter for plain tables and bags; {NOT_USED}")
    return notes
