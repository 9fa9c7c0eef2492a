"""JSON lines as tables."""

import json
from pathlib import Path

import numpy as np
import pytest

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers import open_recording
from terrafusion.datasets.readers.text.json_lines import json_table

TOPICS = [
    {"topic": "/imu", "ts": 1_714_564_800.25, "gyro": {"x": 0.1, "y": 0.2, "z": 0.3}},
    {"topic": "/wheels", "ts": 1_714_564_800.5, "left_mps": 1.5, "right_mps": 2},
    {"topic": "/imu", "ts": 1_714_564_800.75, "gyro": {"x": 0.4, "y": None, "z": 0.6}, "ok": True},
]


def opened(folder: Path, text: str, name: str = "drive.jsonl") -> Recording:
    """A log of these lines, opened by the map that the error without one proposes."""
    (path := folder / name).write_text(text)
    with pytest.raises(DataError) as told:
        open_recording(path)
    (folder / f"{name}.columns.yaml").write_text(str(told.value).split(".columns.yaml: ", 1)[1])
    return open_recording(path)


def test_lines_of_several_topics_are_one_recording(tmp_path: Path) -> None:
    lines = [{"type": "header", "version": 2}, *TOPICS]
    recording = opened(tmp_path, "\n\n".join(map(json.dumps, lines)) + "\n", "drive.json")
    assert "1 line without a time left out" in recording.notes
    assert recording.start_ns == 1_714_564_800_250_000_000
    assert recording.imu is not None
    np.testing.assert_array_equal(recording.imu.gyro_radps, [[0.1, 0.2, 0.3], [0.4, np.nan, 0.6]])
    assert recording.wheels is not None
    assert recording.wheels.speed.tolist() == [[1.5, 2.0]]


def test_equal_keys_of_two_sensors_are_two_columns() -> None:
    lines = [{"type": name, "t": 0, "x": x, "v": [x, x]} for name, x in (("accel", 1), ("mag", 2))]
    names, rows, _ = json_table("\n".join(map(json.dumps, lines)).encode())
    assert names == [
        "type",
        "t",
        *(f"{kind}.{key}" for kind in ("accel", "mag") for key in ("x", "v[0]", "v[1]")),
    ]
    assert rows == b"accel,0,1,1,1,,,\nmag,0,,,,2,2,2\n"


def test_numbers_are_as_written_and_a_cut_last_line_is_left_out(tmp_path: Path) -> None:
    line = '{"t": 1714564800.123456789, "wz": 1}\n'
    recording = opened(tmp_path, line + line.replace("789", "790") + '{"t": 17145')
    assert recording.imu is not None
    assert (recording.start_ns + np.array([0, 1])).tolist() == recording.imu.t_ns.tolist()
    assert recording.start_ns == 1_714_564_800_123_456_789
    assert any(
        "the last line was cut off and is left out; its data end in line 2" in n for n in recording.notes
    )


@pytest.mark.parametrize(
    "line", ["{'t': 2}", "[1, 2]", "[" * 60_000, '{"":' * 9_000 + "1" + "}" * 9_000, '{"t": 2']
)
def test_a_line_that_is_no_object_is_named(tmp_path: Path, line: str) -> None:
    (path := tmp_path / "drive.jsonl").write_text(f'{{"t": 0, "wz": 1}}\n{line}\n{{"t": 3, "wz": 1}}\n')
    with pytest.raises(DataError, match=r"line 2 is no JSON object; write one object a line"):
        open_recording(path)


@pytest.mark.parametrize(
    ("name", "head", "hint"),
    [("drive.zip", b"PK\x03\x04", "unpack it"), ("a.xlsx", b"PK\x03\x04", "export it as a table"),
     ("a.json", b'[\n{"t": 0}]', "one object a line"),
     ("a.ulg", b"ULog\x01", "ulog2csv"), ("a.ubx", b"\xb5b\x01\x07", "NAV-PVT"),
     ("00000042.log", b"FMT, 128, 89, FMT, BBnNZ\n", "binary log"),
     ("a.db3.zstd", b"\x28\xb5\x2f\xfd\x04", "folder of the bag with its metadata.yaml")],
)  # fmt: skip
def test_files_that_need_a_step_first_are_refused_with_it(
    tmp_path: Path, name: str, head: bytes, hint: str
) -> None:
    (tmp_path / name).write_bytes(head)
    with pytest.raises(DataError, match=f"unknown kind of file.*; .*{hint}"):
        open_recording(tmp_path / name)
