"""Pickles: frames are read, everything else is refused before it does anything."""

from __future__ import annotations

import builtins
import functools
import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.readers import open as open_module
from terrafusion.datasets.readers import open_recordings
from terrafusion.datasets.readers.formats import Format
from terrafusion.datasets.readers.sets.norlab_pickle import numbers, read_table
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


def pickled(content: Any, protocol: int = 4) -> bytes:
    """Bytes as they are, or an object's pickle."""
    return content if isinstance(content, bytes) else pickle.dumps(content, protocol=protocol)


@pytest.mark.parametrize("protocol", [3, 4, 5])
def test_a_frame_of_this_pandas(protocol: int) -> None:
    table = read_table(pickled(FRAME, protocol))
    assert list(table) == ["a", "text", "b"]
    np.testing.assert_array_equal(numbers(table["a"]), [0.0, 1.0, 2.0, 3.0])
    np.testing.assert_array_equal(numbers(table["text"]), [1.0, 2.5, np.nan, -3.0])
    np.testing.assert_array_equal(numbers(table["b"]), [1.0, 2.0, 3.0, 4.0])


@pytest.mark.parametrize("storage", ["python", "pyarrow"])
def test_string_columns_of_either_storage(storage: str) -> None:
    if storage == "pyarrow":
        pytest.importorskip("pyarrow")
    frame = FRAME.astype({"text": pd.StringDtype(storage, na_value=np.nan)})
    frame.columns = pd.Index(list(frame.columns), dtype=pd.StringDtype(storage, na_value=np.nan))
    assert read_table(pickled(frame))["text"].tolist() == ["1", "2.5", "", "-3"]


def test_objects_row_by_row() -> None:
    """Whichever way an array of objects lies in memory, its pickle lists it row by row."""
    values = np.array([["1", 2.0, None], ["4", np.float64(5.5), 6]], dtype=object)
    frame = pd.DataFrame(np.asfortranarray(values), columns=pd.Index(["x", "y", "z"], dtype=object))
    table = read_table(pickled(frame))
    np.testing.assert_array_equal(numbers(table["x"]), [1.0, 4.0])
    np.testing.assert_array_equal(numbers(table["y"]), [2.0, 5.5])
    np.testing.assert_array_equal(numbers(table["z"]), [np.nan, 6.0])


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
def test_malice_is_refused_though_trusted(name: str, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DataError):
        read_table(pickled(MALICIOUS[name]))
    assert not (tmp_path / "done").exists()


def test_malice_is_refused_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, catalog_with: CatalogWith
) -> None:
    """By its hash; and by what it asks for, should someone have put the hash into a catalogue."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "table.pkl"
    path.write_bytes(pickled(MALICIOUS["system"]))
    with pytest.raises(DataError, match=r"SHA-256 [0-9a-f]{64}.*TERRAFUSION_CATALOG"):
        open_recordings(path)
    catalog_with("norlab_drive", {path: "grass/raw"})
    with pytest.raises(DataError, match=r"asks for posix.system"):
        open_recordings(path)
    assert not (tmp_path / "done").exists()


@pytest.mark.parametrize(
    "content", [b"\x80", b"", b"no pickle", pickle.dumps([1, 2]), pickle.dumps(FRAME["a"]), b"\x80\x04N."]
)
def test_other_content_is_refused(content: bytes) -> None:
    with pytest.raises(DataError):
        read_table(pickled(content))


def test_what_is_hashed_is_what_is_unpickled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, catalog_with: CatalogWith
) -> None:
    """A file that is replaced between the look into the catalogue and the reading is refused."""
    path = tmp_path / "table.pkl"
    path.write_bytes(pickled(FRAME))
    catalog_with("norlab_drive", {path: "grass/raw"})
    look_up = open_module._known

    def replaced(place: Path, form: Format) -> Any:
        known = look_up(place, form)
        place.write_bytes(pickled(MALICIOUS["system"]).ljust(place.stat().st_size, b"."))
        return known

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(open_module, "_known", replaced)
    with pytest.raises(DataError, match="is in no catalogue"):
        open_recordings(path)
    assert not (tmp_path / "done").exists()


def test_damage_is_refused_by_the_hash(tmp_path: Path, catalog_with: CatalogWith) -> None:
    path, whole = tmp_path / "table.pkl", pickled(FRAME)
    path.write_bytes(whole)
    catalog_with("norlab_drive", {path: "grass/raw"})
    for damaged in (whole[:-1], whole[:40] + b"\0" + whole[41:], whole + b"."):
        path.write_bytes(damaged)
        with pytest.raises(DataError, match="is in no catalogue"):
            open_recordings(path)
