"""Pickles: frames of every pandas are read, everything else is refused before it does anything."""

from __future__ import annotations

import builtins
import functools
import os
import pickle
import struct
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.readers import open_recordings
from terrafusion.datasets.readers.sets.pickled_frame import ALLOWED
from terrafusion.datasets.readers.sets.safe_pickle import numbers, read_table
from tests.datasets.conftest import CatalogWith

FRAME = pd.DataFrame({"a": np.arange(4.0), "text": ["1", "2.5", "", "-3"], "b": [1, 2, 3, 4]})


class Calls:
    """Pickles to a call."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.function, self.arguments = function, arguments

    def __reduce__(self) -> tuple[Any, ...]:
        return self.function, self.arguments


def nested(depth: int) -> Calls:
    """A call whose argument is a call whose argument ..."""
    inner: Any = "touch done"
    for _ in range(depth):
        inner = Calls(os.system, inner)
    return inner  # type: ignore[no-any-return]


def old_style_frame() -> bytes:
    """A frame as pandas pickled it before 1.3: the block manager by its state, its blocks as dictionaries."""
    axes = [pd.Index(np.array(["a"], dtype=object)), pd.RangeIndex(4)]
    blocks = [{"values": np.arange(4.0).reshape(1, 4), "mgr_locs": slice(0, 1, 1)}]
    state = pickle.dumps(([], [], [], {"0.14.1": {"axes": axes, "blocks": blocks}}), protocol=3)[2:-1]
    manager = b"cpandas.core.internals.managers\nBlockManager\n)\x81" + state + b"b"
    return b"\x80\x03cpandas.core.frame\nDataFrame\n)\x81}X\x05\x00\x00\x00_data" + manager + b"sb."


@pytest.fixture
def store(tmp_path: Path) -> Any:
    """Writes bytes, or an object's pickle, to a file."""

    def put(content: Any, protocol: int = 4) -> Path:
        path = tmp_path / "table.pkl"
        path.write_bytes(content if isinstance(content, bytes) else pickle.dumps(content, protocol=protocol))
        return path

    return put


@pytest.mark.parametrize("protocol", [3, 4, 5])
def test_a_frame_of_this_pandas(store: Any, protocol: int) -> None:
    table = read_table(store(FRAME, protocol))
    assert list(table) == ["a", "text", "b"]
    np.testing.assert_array_equal(numbers(table["a"]), [0.0, 1.0, 2.0, 3.0])
    np.testing.assert_array_equal(numbers(table["text"]), [1.0, 2.5, np.nan, -3.0])
    np.testing.assert_array_equal(numbers(table["b"]), [1.0, 2.0, 3.0, 4.0])


@pytest.mark.parametrize("storage", ["python", "pyarrow"])
def test_string_columns_of_either_storage(store: Any, storage: str) -> None:
    if storage == "pyarrow":
        pytest.importorskip("pyarrow")
    frame = FRAME.astype({"text": pd.StringDtype(storage, na_value=np.nan)})
    frame.columns = pd.Index(list(frame.columns), dtype=pd.StringDtype(storage, na_value=np.nan))
    assert read_table(store(frame))["text"].tolist() == ["1", "2.5", "", "-3"]


def test_objects_row_by_row(store: Any) -> None:
    """Whichever way an array of objects lies in memory, its pickle lists it row by row."""
    values = np.array([["1", 2.0, None], ["4", np.float64(5.5), 6]], dtype=object)
    frame = pd.DataFrame(np.asfortranarray(values), columns=pd.Index(["x", "y", "z"], dtype=object))
    table = read_table(store(frame))
    np.testing.assert_array_equal(numbers(table["x"]), [1.0, 4.0])
    np.testing.assert_array_equal(numbers(table["y"]), [2.0, 5.5])
    np.testing.assert_array_equal(numbers(table["z"]), [np.nan, 6.0])


def test_the_block_manager_before_pandas_1_3(store: Any) -> None:
    np.testing.assert_array_equal(read_table(store(old_style_frame()))["a"], [0.0, 1.0, 2.0, 3.0])


MALICIOUS: dict[str, Any] = {
    "system": Calls(os.system, "touch done"),
    "eval": Calls(builtins.eval, "open('done', 'w')"),
    "getattr": Calls(getattr, "", "format"),
    "nested": nested(5),
    "partial": functools.partial(os.system, "touch done"),
    "numpy loads": Calls(np.load, "done"),
    "frombuffer of objects": Calls(np.frombuffer, b"\0" * 8, "O"),
    "read_pickle": Calls(pd.read_pickle, "done"),
    "inside a frame": pd.DataFrame({"a": np.array([Calls(os.system, "touch done")], dtype=object)}),
    "by stack": b"\x80\x04\x8c\x05posix\x8c\x06system\x93\x8c\x0atouch done\x85R.",
    "by the old instruction": b"\x80\x03(cposix\nsystem\nX\x0a\x00\x00\x00touch doneo.",
    "by instance": b"\x80\x03(X\x0a\x00\x00\x00touch doneiposix\nsystem\n.",
    "extension registry": b"\x80\x04\x82\x01.",
    "persistent id": b"\x80\x04X\x01\x00\x00\x00aQ.",
    "dotted name": b"\x80\x04\x8c\x06pandas\x8c\x12DataFrame.__init__\x93.",
    "attributes of a stand-in": b"\x80\x04\x8c\x06pandas\x8c\x09DataFrame\x93}\x8c\x01x\x4b\x01sb.",
    "state of a function": b"\x80\x04\x8c\x15numpy.core.multiarray\x8c\x0c_reconstruct\x93}b.",
    "call of a list": b"\x80\x04](\x4b\x01t)R.",
}


@pytest.mark.parametrize("name", MALICIOUS)
def test_malice_is_refused_though_trusted(name: str, store: Any, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DataError):
        read_table(store(MALICIOUS[name]))
    assert not (tmp_path / "done").exists()


def test_malice_is_refused_twice(
    store: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, catalog_with: CatalogWith
) -> None:
    """By its hash; and by what it asks for, should someone have put the hash into a catalogue."""
    monkeypatch.chdir(tmp_path)
    path = store(MALICIOUS["system"])
    with pytest.raises(DataError, match=r"SHA-256 [0-9a-f]{64}.*TERRAFUSION_CATALOG"):
        open_recordings(path)
    catalog_with("norlab_drive", {path: "grass/raw"})
    with pytest.raises(DataError, match=r"asks for posix.system"):
        open_recordings(path)
    assert not (tmp_path / "done").exists()


HUGE: dict[str, bytes] = {
    "bytes": b"\x80\x04\x8e" + struct.pack("<Q", 1 << 40) + b"x.",
    "bytearray": b"\x80\x05\x96" + struct.pack("<Q", 1 << 33) + b"x.",
    "text": b"\x80\x04X" + struct.pack("<I", 0xFFFFFFFF) + b"x.",
    "frame": b"\x80\x04\x95" + struct.pack("<Q", 1 << 62) + b"N.",
    "memo": b"\x80\x04Nr" + struct.pack("<I", 0xFFFFFFFF) + b".",
}


@pytest.mark.parametrize("name", HUGE)
def test_huge_claims_cost_nothing(name: str, store: Any) -> None:
    import resource

    path = store(HUGE[name])
    before, began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.monotonic()
    with pytest.raises(DataError):
        read_table(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000
    assert time.monotonic() - began < 1.0


def test_a_list_named_many_times(store: Any) -> None:
    """100 000 arrays over one list of 100 000 values would be 80 GB."""
    import resource

    array = b"\x8c\x16numpy._core.multiarray\x8c\x0c_reconstruct\x93\x94)R"
    kind = b"\x8c\x05numpy\x8c\x05dtype\x93\x8c\x01O\x85R\x94"
    values = b"](" + b"N" * 100_000 + b"e\x94"
    again = b"h\x00)R(K\x01J" + struct.pack("<i", 100_000) + b"\x85h\x01\x89h\x02tb"
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(DataError, match="cells"):
        read_table(store(b"\x80\x04" + array + kind + values + again * 100_000 + b"."))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 400_000


def shaped(shape: bytes) -> bytes:
    """An array of floats over eight bytes that claims a shape."""
    kind = b"\x8c\x05numpy\x8c\x05dtype\x93\x8c\x02f8\x89\x88\x87R"
    function = b"\x8c\x13numpy._core.numeric\x8c\x0b_frombuffer\x93"
    return b"\x80\x04" + function + b"(C\x08" + bytes(8) + kind + shape + b"\x8c\x01CtR."


@pytest.mark.parametrize(
    "shape", [b"J\xff\xff\xff\x7f\x85", b"J\xff\xff\xff\xff\x85", b"K\x02\x85", b"N\x85"]
)
def test_arrays_that_do_not_fill_their_shape(shape: bytes, store: Any) -> None:
    with pytest.raises(DataError, match="cannot be read"):
        read_table(store(shaped(shape)))


@pytest.mark.parametrize(
    "content", [b"\x80", b"", b"no pickle", pickle.dumps([1, 2]), pickle.dumps(FRAME["a"]), b"\x80\x04N."]
)
def test_other_content_is_refused(content: bytes, store: Any) -> None:
    with pytest.raises(DataError):
        read_table(store(content))


def test_every_truncation_is_refused(store: Any) -> None:
    whole = pickle.dumps(FRAME, protocol=4)
    for end in range(len(whole) - 1):
        with pytest.raises(DataError):
            read_table(store(whole[:end]))


def test_flipped_bytes_are_read_or_refused(store: Any) -> None:
    whole, rng = pickle.dumps(FRAME, protocol=5), np.random.default_rng(7)
    refused = 0
    for _ in range(600):
        data = bytearray(whole)
        for at in rng.integers(0, len(data), size=int(rng.integers(1, 4))):
            data[at] = rng.integers(0, 256)
        try:
            read_table(store(bytes(data)))
        except DataError:
            refused += 1
    assert refused > 200


def test_only_stand_ins_are_allowed() -> None:
    """Nothing of pandas or NumPy is called, and of Python nothing but `slice`."""
    foreign = {
        v for v in ALLOWED.values() if v.__module__ != "terrafusion.datasets.readers.sets.pickled_frame"
    }
    assert foreign == {slice}
