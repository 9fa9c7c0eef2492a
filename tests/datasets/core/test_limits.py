"""Small files that stand for gigabytes or for endless work are refused, at once and in one line."""

from __future__ import annotations

import gzip
import sqlite3
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from terrafusion.datasets.core import limits
from terrafusion.datasets.core.arrays import distinct
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.readers import open_recording

TOPICS = """create table topics(id integer primary key, name text, type text, serialization_format text);
insert into topics values(1, '/imu', 'sensor_msgs/msg/Imu', 'cdr');"""
MESSAGES = "create table messages(id integer primary key, topic_id integer, timestamp integer, data blob"
MAP = "time: {column: t}\nchannels: {imu: {gyro_z_radps: {column: wz}}}\n"


def log(folder: Path, name: str, content: bytes) -> Path:
    (folder / "meta.yaml").write_text("start_ns: 0\nvehicle: husky\n")
    (folder / name).write_bytes(content)
    return folder


def database(folder: Path, *statements: str) -> Path:
    path = folder / "a.db3"
    with sqlite3.connect(path) as made:
        made.executescript(TOPICS + ";".join(statements))
    made.close()
    return path


def computed_blobs(folder: Path) -> Path:
    rows = "insert into messages(topic_id, timestamp) values(1, 0), (1, 1)"
    return database(folder, f"{MESSAGES} generated always as (zeroblob(400000000)))", rows)


def messages_of_a_view(folder: Path) -> Path:
    view = (
        "create view messages as select 1 as id, 1 as topic_id, 1 as timestamp, zeroblob(400000000) as data"
    )
    return database(folder, view)


def a_huge_message(folder: Path) -> Path:
    return database(folder, f"{MESSAGES})", "insert into messages values(1, 1, 1, zeroblob(70000000))")


def packed_rows(folder: Path) -> Path:
    return log(folder, "imu.csv.gz", gzip.compress(b"t_s,gyro_z_radps\n" + b"0,0.0000\n" * 4_500_000))


def rows_by_carriage_returns(folder: Path) -> Path:
    return log(folder, "imu.csv.gz", gzip.compress(b"t_s\n" + (b"0\r" * 30_000 + b"\n") * 180, 1))


def packed_columns_of_one_value(folder: Path) -> Path:
    pa, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    rows = pa.array([0.0]).take(pa.array([0] * 2_000_000))
    parquet.write_table(pa.table({"t": rows, "wz": rows}), folder / "a.parquet")
    (folder / "a.parquet.columns.yaml").write_text(MAP)
    return folder / "a.parquet"


def lists_in_a_column(folder: Path) -> Path:
    pa, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    parquet.write_table(pa.table({"t": [0.0, 1.0], "wz": [[0.0] * 1000] * 2}), folder / "a.parquet")
    (folder / "a.parquet.columns.yaml").write_text(MAP)
    return folder / "a.parquet"


def many_columns(folder: Path) -> Path:
    header = ",".join(f"p_{k}" for k in range(9_000))
    return log(folder, "terrain.csv", f"t_s,label,{header}\n0,mud{',0' * 9_000}\n".encode())


def columns_of_a_table(folder: Path) -> Path:
    (folder / "a.csv").write_text(f"t_s{',' * 60_000}\n0{',' * 60_000}\n")
    return folder / "a.csv"


def a_line_without_end(folder: Path) -> Path:
    (folder / "a.csv").write_text("t_s" + ",b" * 100_000 + "\n")
    return folder / "a.csv"


BOMBS: tuple[tuple[Callable[[Path], Path], str], ...] = (
    (computed_blobs, "table messages is computed"),
    (messages_of_a_view, "no tables of topics and messages"),
    (a_huge_message, "too big"),
    (packed_rows, "more than 200 times its size when unpacked"),
    (rows_by_carriage_returns, "more than 5 000 000 lines"),
    (packed_columns_of_one_value, "more than 200 times its size when unpacked"),
    (lists_in_a_column, "column 'wz' holds list"),
    (many_columns, "more than 2 000 columns"),
    (columns_of_a_table, "more than 2 000 columns"),
    (a_line_without_end, "more than 65 536 bytes in line 1"),
)


@pytest.mark.parametrize(("make", "words"), BOMBS, ids=lambda one: getattr(one, "__name__", ""))
def test_a_small_file_that_stands_for_much_is_refused(
    tmp_path: Path, make: Callable[[Path], Path], words: str
) -> None:
    path = make(tmp_path)
    begun = time.process_time()
    with pytest.raises(DataError, match=words) as caught:
        open_recording(path)
    assert time.process_time() - begun < 1.5
    assert str(tmp_path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_query_without_end_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A damaged tree of pages can hold the same rows any number of times."""
    rows = f"{MESSAGES})", "insert into messages values(1, 1, 1, x'00')"
    more = "insert into messages select null, 1, 1, x'00' from messages"
    path = database(tmp_path, *rows, *[more] * 16)
    monkeypatch.setattr(limits, "SQL_STEPS", 0)
    monkeypatch.setattr(limits, "SQL_STEPS_PER_BYTE", 0)
    with pytest.raises(DataError, match="interrupted"):
        open_recording(path)


def test_one_long_text_does_not_widen_all_others(tmp_path: Path) -> None:
    """As a NumPy array of texts this would take 80 GB."""
    import numpy as np

    texts = np.array(["mud"] * 300_000 + ["x" * 60_000], dtype=object)
    words, which = distinct(texts)
    assert words == ["mud", "x" * 60_000]
    assert which.tolist() == [0] * 300_000 + [1]


@pytest.mark.parametrize("text", ["a: 0x" + "7" * 15_000, "a: 0o" + "7" * 15_000, "a: " + "1_" * 6_000 + "1"])
def test_a_number_of_many_thousands_of_digits(tmp_path: Path, text: str) -> None:
    from terrafusion.datasets.core.errors import ConfigError
    from terrafusion.datasets.core.yaml_file import read_yaml

    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(ConfigError, match="a number of"):
        read_yaml(tmp_path / "a.yaml")


def test_metadata_of_a_bag_with_merge_keys(tmp_path: Path) -> None:
    """Each level holds nine times the one before; under a kilobyte, but endless to write out."""
    levels = "m0: &m0 {k0: 0}\n" + "".join(
        f"m{k}: &m{k} {{<<: [{', '.join([f'*m{k - 1}'] * 9)}]}}\n" for k in range(1, 10)
    )
    (tmp_path / "metadata.yaml").write_text(levels + "rosbag2_bagfile_information: *m9\n")
    with pytest.raises(DataError, match="merge keys '<<' are not allowed"):
        open_recording(tmp_path)
