"""How much an input may hold: every limit of the readers, and the error that names file and limit.

Limits count what comes out of a file (bytes unpacked, rows, columns, values), since a small file can claim or
unpack to any amount. They leave room for an IMU of 400 Hz for three hours.
"""

from collections.abc import Iterable, Iterator

from terrafusion.datasets.core.errors import DataError

# Parameter files (YAML) and the metadata.yaml of a ROS 2 bag
YAML_BYTES, METADATA_BYTES = 256 * 1024, 1024 * 1024
YAML_DEPTH, YAML_VALUES, YAML_NUMBER = 32, 50_000, 10_000
"""Depth of nesting, values with aliases written out, characters of a number."""

# Text and Parquet
TEXT_BYTES = 2**29
LINE_BYTES = 2**16
ROWS, COLUMNS, VALUES = 5_000_000, 2_000, 2**25
"""Of a table; `VALUES` are rows times columns."""
EXPANSION, FREE_BYTES = 200, 2**24
"""A packed file may unpack to `FREE_BYTES` plus so many times its own size; text compresses 5 to 20 times."""

# Bags
CHUNK_BYTES = 2**28
"""Of an unpacked chunk: recorders write chunks of a few MB."""
MESSAGE_BYTES, TOPICS = 2**26, 10_000
SQL_STEPS, SQL_STEPS_PER_BYTE = 10_000_000, 10
"""Instructions of SQLite for a query, and more by the size of the file: a row of 30 bytes takes about 30."""

# HDF5 files and pickles
HDF5_VALUES, HDF5_REFERENCES = 2_000_000, 10_000
"""Values of a variable, and of a stored piece of one: two hours at 250 Hz."""
PICKLE_BYTES = 32 * 2**20
"""Two hours of a published log have as many."""
LARGEST = 1e30
"""No number of a log is larger; squares of these are still numbers."""


def too_much(what: str, most: float, remedy: str = "split it") -> DataError:
    """The error that a file has more than `most` of something, such as "rows"."""
    return DataError(f"has more than {most:,.0f} {what}".replace(",", " "), remedy=remedy)


def check_table(rows: int, columns: int, packed_bytes: int) -> None:
    """Refuse too many rows, columns or values, or far more than the file's bytes account for (DataError)."""
    check_columns(columns)
    if rows > ROWS:
        raise too_much("rows", ROWS)
    if rows * columns > VALUES:
        raise too_much("values", VALUES)
    check_expansion(8 * rows * columns, packed_bytes)


def check_columns(columns: int) -> None:
    """Refuse a table of too many columns (DataError)."""
    if columns > COLUMNS:
        raise too_much("columns", COLUMNS, "keep those that are needed")


def check_expansion(unpacked_bytes: int, packed_bytes: int) -> None:
    """Refuse a file that unpacks to far more bytes than it has (DataError)."""
    if unpacked_bytes > FREE_BYTES + EXPANSION * packed_bytes:
        raise too_much("times its size when unpacked", EXPANSION, "is it a recording?")


def within(parts: Iterable[bytes], packed_bytes: int) -> Iterator[bytes]:
    """The unpacked parts of a file; a DataError once they are far more bytes than the file has."""
    total = 0
    for part in parts:
        total += len(part)
        check_expansion(total, packed_bytes)
        yield part


def repeated(names: Iterable[str]) -> str | None:
    """The first name that comes twice, None where none does."""
    seen: set[str] = set()
    for name in names:
        if name in seen:
            return name
        seen.add(name)
    return None
