"""The formats that can be read: which module recognises a file and reads it (how to add one: `readers`)."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from terrafusion.datasets.core.conventions import Conventions
from terrafusion.datasets.core.errors import DataError, errors_of
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import Rig
from terrafusion.datasets.readers.delimited import UTF_16

HEAD_BYTES = 4096
MAP_SUFFIX = ".columns.yaml"
"""Appended to the name of a table, the name of its column map."""
PARQUET_MAGIC = b"PAR1"

EXPORT = "export it as a table (.csv) or a bag"
HINTS = (
    *(
        (start, "unpack it, and give what is inside")
        for start in (b"PK\3\4", b"\x1f\x8b", b"7z\xbc\xaf", b"Rar!")
    ),
    *((start, "write it with one object a line (.jsonl)") for start in (b"[", b"{")),
    (b"ULog", "export it by ulog2csv of pyulog as tables (.csv)"),
    (b"\x28\xb5\x2f\xfd", "unpack it, or give the folder of the bag with its metadata.yaml"),
    (b"\xb5b", "export its NAV-PVT by pyubx2 as a table (.csv), or log NMEA"),
    (b"FMT,", "give the binary log (.bin) that it was made of"),
)
"""How to go on with a file that is not read, by its first bytes."""
OFFICE = (".xlsx", ".xlsm", ".ods", ".npz", ".mat")
"""Files that are packed, but with nothing inside that can be read."""


@dataclass(frozen=True)
class Request:
    """What a reader gets.

    Attributes:
        rig: geometry of the robot, where known.
        topics: topic by channel, for bags.
        stamps: "header" or "receipt", for bags.
        repair_clock: remove steps of a clock (and list them in `clock_jumps`) instead of refusing them.
        columns: YAML that says what the columns of a plain table are.
        sha256: of the catalogue entry whose bytes are the file's, "" where there is none.
        conventions: of the catalogue; applied after reading, here for readers that need some of them.
    """

    path: Path
    rig: Rig | None = None
    topics: Mapping[str, str] | None = None
    stamps: str = "header"
    repair_clock: bool = False
    columns: Path | None = None
    sha256: str = ""
    conventions: Conventions = field(default_factory=Conventions)


@dataclass(frozen=True)
class Format:
    """A kind of file: its name in the catalogue, its description, and the module that reads it."""

    name: str
    description: str
    module: str

    @property
    def _reader(self) -> Any:
        return import_module(self.module)

    def claims(self, path: Path, head: bytes) -> bool:
        """Whether the file is of this format, by its name and first bytes (none for a folder)."""
        return bool(self._reader.claims(path, head))

    def read(self, request: Request) -> Sequence[Recording]:
        """The recordings in the file."""
        # Huge numbers are a finding, not a warning.
        with errors_of(request.path), np.errstate(over="ignore", invalid="ignore"):
            recordings: Sequence[Recording] = self._reader.read(request)
        return recordings

    def files(self, path: Path) -> list[Path]:
        """What `read` opens: all files of a folder; else the file and its companions."""
        if path.is_dir():
            return sorted(file for file in path.rglob("*") if file.is_file())
        others = self._reader.companions(path) if hasattr(self._reader, "companions") else ()
        columns = path.with_name(path.name + MAP_SUFFIX)
        return sorted({path, *others, *([columns] if columns.is_file() else [])})


_READERS = "terrafusion.datasets.readers"
FORMATS: tuple[Format, ...] = (
    Format("comma_segment", "a segment of comma2k19 (its folder)", f"{_READERS}.sets.comma_segment"),
    Format("ros1", "a ROS 1 .bag (or the folder of its parts)", f"{_READERS}.ros.ros1"),
    Format("ros2", "a ROS 2 bag (its folder, .mcap, .db3)", f"{_READERS}.ros.ros2"),
    Format("table_folder", "a folder of tables with column maps", f"{_READERS}.text.table_folder"),
    Format("log_folder", "a log folder (with meta.yaml)", f"{_READERS}.log_folder"),
    Format("umich_text", "a text log of the Michigan Husky", f"{_READERS}.sets.umich_text"),
    Format("norlab_pickle", "a pickled DataFrame of DRIVE", f"{_READERS}.sets.norlab_pickle"),
    Format("pathfinder_mat", "a MATLAB v7.3 workspace of the Pathfinder", f"{_READERS}.sets.pathfinder_mat"),
    Format("borealtc_csv", "an imu_NN.csv or pro_NN.csv of BorealTC", f"{_READERS}.sets.borealtc_csv"),
    Format("dataflash", "a DataFlash log of ArduPilot (.bin)", f"{_READERS}.binary.dataflash"),
    Format("xsens_text", "a text export of Xsens MT Manager", f"{_READERS}.text.xsens_text"),
    Format("rtklib_pos", "an RTKLIB solution (.pos)", f"{_READERS}.text.rtklib_pos"),
    Format("nmea", "an NMEA 0183 log", f"{_READERS}.text.nmea"),
    Format("tum", "a TUM trajectory", f"{_READERS}.text.tum"),
    Format("table", "a table (.csv, .tsv, .txt, .parquet) with a column map", f"{_READERS}.text.table"),
)
"""In the order of priority: the first that claims a file reads it. Tables come last."""


def format_of(path: Path, *, mapped: bool = False) -> Format:
    """The format of a file or folder.

    Args:
        mapped: a column map was given: text is a table then, as it is where `NAME.columns.yaml` exists.

    Raises:
        DataError: it cannot be read, is empty, or no format claims it.
    """
    try:
        if not path.exists():
            raise DataError("no such file or folder", file=path, remedy="check the path")
        if not (path.is_dir() or path.is_file()):
            raise DataError("is neither a file nor a folder", file=path, remedy="give a log")
        for inner in path.iterdir() if path.is_dir() else ():  # to open a pipe would wait for its writer
            if inner.exists() and not (inner.is_dir() or inner.is_file()):
                raise DataError("is neither a file nor a folder", file=inner, remedy="remove it from the log")
        head = b""
        if path.is_file():
            with path.open("rb") as file:
                head = file.read(HEAD_BYTES)
            if head.startswith(UTF_16):
                head = head.decode("utf-16", "replace").encode()
            if not head:
                raise DataError("the file is empty", file=path, remedy="record or copy it again")
        mapped = mapped or bool(head and path.with_name(path.name + MAP_SUFFIX).is_file())
        may_be_table = head.startswith(PARQUET_MAGIC) or (bool(head) and b"\0" not in head)
        table = FORMATS[-1] if mapped and may_be_table else None
        found = table or next((form for form in FORMATS if form.claims(path, head)), None)
    except OSError as error:
        raise DataError(f"cannot be read: {error.strerror or error}", file=path) from None
    if found is None:
        kinds = ", ".join(form.description for form in FORMATS if ".sets." not in form.module)
        first = next((hint for start, hint in HINTS if head.startswith(start)), EXPORT)
        first = EXPORT if path.suffix.lower() in OFFICE else first
        raise DataError(
            f"unknown kind of {'folder' if path.is_dir() else 'file'} '{path.suffix or path.name}'",
            file=path,
            remedy=f"{first}; what can be read: {kinds}",
        )
    return found


def append_parts(names: Sequence[str]) -> str:
    """How tables whose names differ by a number alone become one; "" for others."""
    stems = {re.sub(r"\d+(?=\.\w+$)", "*", name) for name in names}
    pattern = stems.pop() if len(stems) == 1 else ""
    if len(names) < 2 or not pattern.endswith(("*.csv", "*.tsv", "*.txt")):
        return ""
    return f"append them: `cat {pattern} > drive{pattern[-4:]}` (headers that come again are left out)"


def logs_in(folder: Path) -> list[str]:
    """Names of the readable files and log folders among the first 50 entries of a folder, sorted."""
    found = []
    for path in sorted(folder.iterdir())[:50]:
        try:
            form = format_of(path)
        except DataError:
            continue
        if form.name != "log_folder" or (path / "meta.yaml").is_file():
            found.append(path.name)
    return found
