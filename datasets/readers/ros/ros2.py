"""ROS 2 bags: a folder with `metadata.yaml` and the files that it names, or one `.mcap` or `.db3` file.

A recorder that was killed writes no `metadata.yaml`: its files are named after the folder, and numbered.
"""

import contextlib
import os
import shutil
import sqlite3
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from terrafusion.datasets.core import limits
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.scratch import scratch_folder
from terrafusion.datasets.core.yaml_file import read_yaml
from terrafusion.datasets.readers.formats import Request
from terrafusion.datasets.readers.ros.bag import opened_bag, recording_of
from terrafusion.datasets.readers.ros.mcap_file import LANGUAGES, McapFile
from terrafusion.datasets.readers.ros.raw import (
    BagContainer,
    BagError,
    BagSource,
    Groups,
    JoinedFiles,
    MessageBatch,
    batches_of,
    decompress,
    normal_type,
    zstd,
)

METADATA = "metadata.yaml"
SUFFIXES = {".mcap": "mcap", ".db3": "sqlite3"}
REMEDY = "copy it again, or mend it with `ros2 bag reindex` (MCAP: `mcap recover`)"
FETCHED_ROWS = 2048
"""Messages that are fetched at once."""
STEPS_AT_A_TIME = 100_000
TABLES = "SELECT name, sql FROM sqlite_master WHERE type = 'table'"
USED = {"topics", "messages", "message_definitions"}


class Db3File:
    """An open SQLite database of a ROS 2 bag.

    Of one that is cut off, a copy of its whole pages is read, up to the first that is missing. The file of
    changes that a killed recorder leaves beside it is applied to the copy.

    Raises:
        BagError: it is not such a database.
    """

    def __init__(self, path: Path) -> None:
        self._scratch = ExitStack()
        try:
            page, self.cut = _page_and_cut(path)
            if self.cut:
                path = _copied(path, self._scratch.enter_context(scratch_folder()), page)
            self._bytes, self._steps = path.stat().st_size, 0
            uri = f"{path.absolute().as_uri()}?mode=ro&immutable=1"
            self._database = sqlite3.connect(uri, uri=True)
            self._scratch.callback(self._database.close)
            self._database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, limits.MESSAGE_BYTES)
            self._database.set_progress_handler(self._is_endless, STEPS_AT_A_TIME)
            if self.cut:
                self._database.execute("PRAGMA writable_schema = ON")  # else SQLite refuses missing pages
            self.sources: list[BagSource] = self._sources()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        self._scratch.close()

    def _is_endless(self) -> bool:
        """Whether a question needs more steps than a file of this size can need."""
        self._steps += STEPS_AT_A_TIME
        return self._steps > limits.SQL_STEPS + limits.SQL_STEPS_PER_BYTE * self._bytes

    def _run(self, query: str, values: Sequence[Any] = ()) -> sqlite3.Cursor:
        self._steps = 0
        return self._database.execute(query, values)

    def _rows(self, query: str, values: Sequence[Any] = ()) -> Iterator[Any]:
        """The rows of an answer, of a database that is cut off those before the cut."""
        try:
            yield from self._run(query, values)
        except sqlite3.OperationalError:
            raise
        except sqlite3.DatabaseError:
            if not self.cut:
                raise

    def _check_tables(self) -> set[str]:
        """Names of the tables, which must be plain: a computed column or a view can hold any amount."""
        tables = {str(name): str(sql) for name, sql in self._run(TABLES)}
        for name in tables.keys() & USED:
            computed = any(hidden for *_, hidden in self._run(f"PRAGMA table_xinfo({name})"))
            if computed or not tables[name].upper().startswith("CREATE TABLE"):
                raise BagError(f"its table {name} is computed, not stored")
        return set(tables)

    def _sources(self) -> list[BagSource]:
        run, tables = self._run, self._check_tables()
        if not {"topics", "messages"} <= tables:
            raise BagError("the database has no tables of topics and messages")
        counts = Counter(number for (number,) in self._rows("SELECT topic_id FROM messages ORDER BY id"))
        definitions: dict[str, tuple[str, str]] = {}
        if "message_definitions" in tables:
            query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            definitions = {str(name): (str(language), str(text)) for name, language, text in run(query)}
        sources: list[BagSource] = []
        for number, topic, name, encoding in run("SELECT id, name, type, serialization_format FROM topics"):
            language, text = definitions.get(name, ("", ""))
            known = LANGUAGES.get(language, "msg")
            count = int(counts.get(number, 0))
            if len(sources) >= limits.TOPICS:
                raise limits.too_much("topics", limits.TOPICS)
            sources.append(
                BagSource(int(number), str(topic), normal_type(str(name)), text, known, str(encoding), count)
            )
        return sources

    def batches(self, wanted: Groups) -> Iterator[MessageBatch]:
        """The messages of the wanted groups of topics, in the order in which they were written."""
        topics = tuple(number for ids in wanted for number in ids)
        marks = ", ".join("?" * len(topics))
        query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks}) ORDER BY id"
        unpacked = 0
        rows = self._rows(query, topics)
        while block := list(islice(rows, FETCHED_ROWS)):
            unpacked += sum(len(blob) for *_, blob in block)
            limits.check_expansion(unpacked, self._bytes)
            yield from batches_of(block, wanted)


def _changes(path: Path) -> list[Path]:
    """Files in which SQLite has changes that are not in the database yet, or to be undone."""
    beside = [path.with_name(path.name + ending) for ending in ("-wal", "-journal")]
    return [file for file in beside if file.is_file() and file.stat().st_size]


def _copied(path: Path, folder: Path, page: int) -> Path:
    """A copy of a database without a last page that is not whole, with the changes beside it applied."""
    target = folder / path.name
    for file in (path, *_changes(path)):
        shutil.copyfile(file, folder / file.name)
    os.truncate(target, target.stat().st_size // page * page)
    with closing(sqlite3.connect(target)) as database, contextlib.suppress(sqlite3.DatabaseError):
        database.execute("PRAGMA journal_mode = DELETE")  # applies them; refused where pages are missing
    return target


def _page_and_cut(path: Path) -> tuple[int, str]:
    """Bytes of a page, and in which way the database is cut off; "" of a whole one.

    SQLite reads a file that lost its tail without an error: its size is compared with its header. Page size
    at byte 16 (1 means 65536) and page count at byte 28, which holds when the counters at bytes 24 and 92
    agree: SQLite file format, sec. 1.3.
    """
    with path.open("rb") as file:
        header = file.read(100)
    size = path.stat().st_size
    page = int.from_bytes(header[16:18], "big")
    page = 65536 if page == 1 else max(page, 512)
    wanted = page * int.from_bytes(header[28:32], "big")
    if len(header) < 100 or (header[24:28] == header[92:96] and size < wanted):
        return page, f"{size} of {wanted} bytes are there"
    return page, "its recorder did not close it" if _changes(path) else ""


STORAGES: dict[str, type[McapFile] | type[Db3File]] = {"mcap": McapFile, "sqlite3": Db3File}


def claims(path: Path, head: bytes) -> bool:
    """Whether `path` is a ROS 2 bag: a folder of one, or a file named `.mcap` or `.db3`."""
    if not path.is_dir():
        return path.suffix in (".mcap", ".db3")
    return not (path / "meta.yaml").is_file() and ((path / METADATA).is_file() or bool(_numbered(path)))


def read(request: Request) -> list[Recording]:
    """The one recording of a ROS 2 bag.

    Bags without message definitions (SQLite before ROS 2 Iron) are read with those of Humble.
    """
    with opened_bag(request.path, open_container, REMEDY) as container:
        return [recording_of(container, request)]


def open_container(path: Path) -> BagContainer:
    """The container of a ROS 2 bag; BagError where it is broken."""
    if path.is_dir():
        return Ros2Folder(path)
    return McapFile(path) if path.suffix == ".mcap" else Db3File(path)


class Ros2Folder(JoinedFiles):
    """An open ROS 2 bag of one or several files, one after the other.

    Raises:
        BagError: metadata that cannot be used, a missing or broken file.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._scratch = ExitStack()
        self.cut = "" if (folder / METADATA).is_file() else "its recorder did not close it"
        metadata = _metadata(folder)
        storage = STORAGES.get(str(metadata.get("storage_identifier")))
        names = metadata.get("relative_file_paths")
        if storage is None or not isinstance(names, list) or not names:
            raise BagError("metadata.yaml names no storage and files that could be read")
        mode = str(metadata.get("compression_mode") or "none").lower()
        if mode not in ("none", "file", "message") or (
            mode != "none" and metadata.get("compression_format") != "zstd"
        ):
            raise BagError(f"compression '{mode}' by '{metadata.get('compression_format')}' is not supported")
        self._packed = mode == "message"
        try:
            for name in names:
                path = folder / PurePosixPath(str(name)).name
                if not path.is_file():
                    raise BagError(f"the file {path.name} is missing")
                path = self._unpacked(path) if mode == "file" else path
                self.add(storage(path))
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Give the files back, and remove unpacked ones."""
        super().close()
        self._scratch.close()

    def _unpacked(self, path: Path) -> Path:
        """A file without its zstd compression, in a scratch folder."""
        target = self._scratch.enter_context(scratch_folder()) / path.stem
        with zstd().open(path, "rb") as packed, target.open("wb") as out:
            blocks = iter(lambda: packed.read(1 << 20), b"")
            for block in limits.within(blocks, path.stat().st_size):
                out.write(block)
        return target

    def batches(self, wanted: Groups) -> Iterator[MessageBatch]:
        """The messages of the wanted groups of sources, file by file."""
        for batch in super().batches(wanted):
            yield _unpacked_messages(batch) if self._packed else batch


def _unpacked_messages(batch: MessageBatch) -> MessageBatch:
    """Messages that were compressed one by one."""
    messages = list(limits.within(_messages(batch), int(batch.sizes.sum())))
    sizes = np.array([len(m) for m in messages], dtype=np.int64)
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    return batch._replace(data=np.frombuffer(b"".join(messages), dtype=np.uint8), starts=starts, sizes=sizes)


def _messages(batch: MessageBatch) -> Iterator[bytes]:
    for start, size in zip(batch.starts.tolist(), batch.sizes.tolist(), strict=True):
        packed = batch.data[start : start + size].tobytes()
        whole = zstd().get_frame_info(packed).decompressed_size
        if whole is None or whole > limits.MESSAGE_BYTES:
            raise BagError(f"a message claims {whole or 'an unknown number of'} bytes")
        yield decompress(packed, "zstd", whole)


def _numbered(folder: Path) -> list[str]:
    """Names of the bag files of a recorder, in order."""
    name = folder.resolve().name
    files = (path for path in folder.iterdir() if path.suffix in SUFFIXES and path.is_file())
    numbers = {path.name: path.stem.removeprefix(f"{name}_") for path in files}
    return sorted((n for n in numbers if numbers[n].isdecimal()), key=lambda n: int(numbers[n]))


def _metadata(folder: Path) -> dict[str, Any]:
    path = folder / METADATA
    if not path.is_file():
        names = _numbered(folder)
        return {"storage_identifier": SUFFIXES[Path(names[0]).suffix], "relative_file_paths": names}
    try:
        content = read_yaml(path, limits.METADATA_BYTES)
    except ConfigError as error:
        raise BagError(f"metadata.yaml: {error.what}") from None
    metadata = content.get("rosbag2_bagfile_information")
    if not isinstance(metadata, dict):
        raise BagError("metadata.yaml holds no rosbag2_bagfile_information")
    return metadata
