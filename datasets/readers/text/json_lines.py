"""JSON lines (an object a line) as a table: a column for each key, with the keys above it in front."""

import csv
import io
import json
from collections.abc import Iterator
from typing import Any

from terrafusion.datasets.core import limits
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.readers.delimited import CutText
from terrafusion.datasets.readers.text.column_names import is_time

KINDS = ("topic", "type", "sensor", "channel", "msg")
"""Keys whose text says which sensor a line is of."""
LONGEST = 9
"""Lists with more entries than a matrix has are no columns."""

Row = dict[str, str]


def is_json_lines(head: bytes) -> bool:
    """Whether text begins with a line that is an object."""
    first = head.lstrip().partition(b"\n")[0].rstrip()
    return first.startswith(b"{") and first.endswith(b"}")


def json_table(data: bytes) -> tuple[list[str], bytes, int]:
    """Names of the columns, the rows separated by commas (row k is line k, numbers are as written), and how
    many lines have no time, where others have, and are left out.

    Where lines are of several sensors by one of `KINDS`, it stands in front of the keys, but not of times.

    Raises:
        DataError: a line that is no object; too many columns, or cells.
    """
    data = _complete(data)
    kinds: dict[str, dict[str, None]] = {}
    for kind, row in _rows(data):
        if row:
            kinds.setdefault(kind, {}).update(dict.fromkeys(row))
            limits.check_columns(sum(map(len, kinds.values())))
    times = {key for keys in kinds.values() for key in keys if is_time(key)}

    def named(kind: str, key: str) -> str:
        return key if len(kinds) == 1 or not kind or key in times or key in KINDS else f"{kind}.{key}"

    names = list(dict.fromkeys(named(kind, key) for kind, keys in kinds.items() for key in keys))
    if data.count(b"\n") * len(names) > limits.TEXT_BYTES:
        raise limits.too_much("cells", limits.TEXT_BYTES)
    out = io.TextIOWrapper(text := io.BytesIO(), encoding="utf-8", newline="")
    writer = csv.DictWriter(out, names, restval="", lineterminator="\n")
    timeless = 0
    for kind, row in _rows(data):
        if row and (not times or times & row.keys()):
            writer.writerow({named(kind, key): text for key, text in row.items()})
        else:
            timeless += bool(row)
            out.write("\n")
    out.flush()
    return names, type(data)(text.getvalue()), timeless


def _complete(data: bytes) -> bytes:
    """The text without a last line that is cut off."""
    begin = data.rfind(b"\n") + 1
    if not isinstance(data, CutText):
        try:
            json.loads(data[begin:] or "0")
        except (ValueError, RecursionError):
            pass
        else:
            return data if begin == len(data) else data + b"\n"
    return CutText(data[:begin])


def _rows(data: bytes) -> Iterator[tuple[str, Row]]:
    """The sensor and the cells of each line."""
    for number, line in enumerate(io.BytesIO(data), 1):
        if not line.strip():
            yield "", {}
            continue
        try:
            found = json.loads(line, parse_float=str, parse_int=str, parse_constant=str)
            if not isinstance(found, dict):
                raise ValueError
            row = dict(_cells("", found))
        except (ValueError, RecursionError):
            what = f"line {number} is no JSON object"
            raise DataError(what, remedy="write one object a line, without line breaks inside") from None
        kind = next((found[key] for key in KINDS if isinstance(found.get(key), str)), "")
        yield kind, row


def _cells(path: str, value: Any) -> Iterator[tuple[str, str]]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _cells(f"{path}.{key}" if path else key, inner)
    elif isinstance(value, list):
        for k, inner in enumerate(value if len(value) <= LONGEST else []):
            yield from _cells(f"{path}[{k}]", inner)
    elif value is not None:
        yield path, " ".join(str(int(value) if isinstance(value, bool) else value).split())
