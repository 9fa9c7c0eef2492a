"""The container of ROS 2 bags in SQLite."""

import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from terrafusion.datasets.core import limits
from terrafusion.datasets.readers.ros.raw import (
    BagError,
    BagSource,
    Groups,
    MessageBatch,
    grouped,
    normal_type,
)

LANGUAGES = {"ros2msg": "msg", "ros2idl": "idl"}
FETCHED_ROWS = 2048
"""Messages that are fetched at once."""
STEPS_AT_A_TIME = 100_000
TABLES = "SELECT name, sql FROM sqlite_master WHERE type = 'table'"
USED = {"topics", "messages", "message_definitions"}


class Db3File:
    """An open SQLite database of a ROS 2 bag.

    Args:
        counts: numbers of messages by topic where they are known; counting them takes a pass over the file.

    Raises:
        BagError: the file is cut off, or not such a database.
    """

    def __init__(self, path: Path, counts: Mapping[str, int] | None = None) -> None:
        _refuse_cut(path)
        self._bytes, self._steps = path.stat().st_size, 0
        uri = f"{path.absolute().as_uri()}?mode=ro&immutable=1"
        self._database = sqlite3.connect(uri, uri=True)
        self._database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, limits.MESSAGE_BYTES)
        self._database.set_progress_handler(self._is_endless, STEPS_AT_A_TIME)
        try:
            self.sources: list[BagSource] = self._sources(counts)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        self._database.close()

    def _is_endless(self) -> bool:
        """Whether a question needs more steps than a file of this size can need."""
        self._steps += STEPS_AT_A_TIME
        return self._steps > limits.SQL_STEPS + limits.SQL_STEPS_PER_BYTE * self._bytes

    def _run(self, query: str, values: Sequence[Any] = ()) -> sqlite3.Cursor:
        self._steps = 0
        return self._database.execute(query, values)

    def _check_tables(self) -> set[str]:
        """Names of the tables, which must be plain: a computed column or a view can hold any amount."""
        tables = {str(name): str(sql) for name, sql in self._run(TABLES)}
        for name in tables.keys() & USED:
            computed = any(hidden for *_, hidden in self._run(f"PRAGMA table_xinfo({name})"))
            if computed or not tables[name].upper().startswith("CREATE TABLE"):
                raise BagError(f"its table {name} is computed, not stored")
        return set(tables)

    def _sources(self, known_counts: Mapping[str, int] | None) -> list[BagSource]:
        run, tables = self._run, self._check_tables()
        if not {"topics", "messages"} <= tables:
            raise BagError("the database has no tables of topics and messages")
        counts: dict[int, int] = {}
        if known_counts is None:
            counts = dict(run("SELECT topic_id, COUNT(*) FROM messages GROUP BY topic_id").fetchall())
        definitions: dict[str, tuple[str, str]] = {}
        if "message_definitions" in tables:
            query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            definitions = {str(name): (str(language), str(text)) for name, language, text in run(query)}
        sources: list[BagSource] = []
        for number, topic, name, encoding in run("SELECT id, name, type, serialization_format FROM topics"):
            language, text = definitions.get(name, ("", ""))
            known = LANGUAGES.get(language, "msg")
            count = int(counts.get(number, 0) if known_counts is None else known_counts.get(topic, 0))
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
        rows = self._run(query, topics)
        while block := rows.fetchmany(FETCHED_ROWS):
            numbers, times, blobs = zip(*block, strict=True)
            ids, receipt_ns = np.array(numbers, dtype=np.int64), np.array(times, dtype=np.int64)
            sizes = np.fromiter(map(len, blobs), dtype=np.int64, count=len(blobs))
            starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
            unpacked += int(sizes.sum())
            limits.check_expansion(unpacked, self._bytes)
            data = np.frombuffer(b"".join(blobs), dtype=np.uint8)
            for group, mine in grouped(ids, wanted):
                yield MessageBatch(group, data, starts[mine], sizes[mine], receipt_ns[mine])


def _refuse_cut(path: Path) -> None:
    """SQLite reads a file that lost its tail without a word: compare its size with its header.

    Page size at byte 16 (1 means 65536) and page count at byte 28, which holds when the counters
    at bytes 24 and 92 agree: SQLite file format, sec. 1.3.
    """
    with path.open("rb") as file:
        header = file.read(100)
    size = path.stat().st_size
    page = int.from_bytes(header[16:18], "big")
    wanted = (65536 if page == 1 else page) * int.from_bytes(header[28:32], "big")
    if len(header) < 100 or (header[24:28] == header[92:96] and size < wanted):
        raise BagError(f"the database is cut off: {size} of {wanted} bytes")
