"""Parquet tables: types of columns, and damaged files."""

from __future__ import annotations

import builtins
import random
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.readers import open_recording
from tests.datasets.readers.test_table import GYRO_MAP, START_NS


def parquet(tmp_path: Path, columns: dict[str, Any], map_text: str = GYRO_MAP) -> Path:
    path = tmp_path / "drive.parquet"
    pd.DataFrame(columns).to_parquet(path)
    (tmp_path / "drive.parquet.columns.yaml").write_text(map_text)
    return path


@pytest.mark.parametrize("kind", ["typed", "integers", "seconds", "texts"])
def test_parquet(tmp_path: Path, kind: str) -> None:
    stamps = START_NS + np.arange(5) * 10_000_000
    times: dict[str, Any] = {
        "typed": pd.to_datetime(stamps, utc=True),
        "integers": stamps,
        "seconds": (stamps - START_NS) * 1e-9,
        "texts": [str(np.datetime64(int(t), "ns")) + "Z" for t in stamps],
    }
    unit = {"typed": "s", "integers": "ns", "seconds": "s", "texts": "iso8601"}[kind]
    wz = [0.5, None, 0.25, 1.0, 2.0]
    path = parquet(
        tmp_path, {"t": times[kind], "wz": wz, "n": range(5)}, GYRO_MAP.replace("t}", f"t, unit: {unit}}}")
    )
    imu = open_recording(path).imu
    assert imu is not None
    wanted = np.delete(stamps, 1) - (START_NS if kind == "seconds" else 0)
    np.testing.assert_array_equal(imu.t_ns, wanted)
    assert imu.gyro_radps[:, 2].tolist() == [0.5, 0.25, 1.0, 2.0]


@pytest.mark.parametrize(
    ("columns", "match"),
    [
        ({"t": [0.0], "wz": ["x"]}, "no numbers"),
        ({"t": [0.0], "wz": [np.inf]}, "infinite"),
        ({"t": [1e300], "wz": [1.0]}, "64 bits"),
        ({"t": [None, 1.0], "wz": [1.0, 1.0]}, "1 rows have no 't'"),
        ({"t": ["x"], "wz": [1.0]}, "is 'x' in row 1"),
        ({"t": ["6024-01-01T00:00:00Z"], "wz": [1.0]}, "6024-01-01"),
        ({"t": np.zeros(0), "wz": np.zeros(0)}, "no rows"),
    ],
)
def test_bad_parquet(tmp_path: Path, columns: dict[str, Any], match: str) -> None:
    with pytest.raises(DataError, match=match):
        open_recording(parquet(tmp_path, columns))


def test_numbers_of_parquet_tell_what_is_proposed(tmp_path: Path) -> None:
    """A heading in degrees is no yaw in radians, as in text."""
    places = {"x": [0.0, 1.0], "y": [0.0, 0.0], "heading": [359.0, 1.0]}
    path = parquet(tmp_path, {"t": [0.0, 1.0], **places})
    path.with_name(path.name + ".columns.yaml").unlink()
    with pytest.raises(DataError, match=r'leaves out heading .*truth: \{x_m: "x", y_m: "y"\}'):
        open_recording(path)


@pytest.mark.parametrize(
    "times",
    [
        [1_714_564_800 * 10**9, 1_714_564_801 * 10**9],
        ["2024-05-01 12:00:00Z", "2024-05-01 12:00:01Z"],
        pd.to_datetime(["2024-05-01 14:00:00+02:00", "2024-05-01 14:00:01+02:00"]),
        pd.to_timedelta([1_714_564_800, 1_714_564_801], unit="s"),
    ],
    ids=["ns", "text", "zone", "differences"],
)
def test_times_of_a_data_frame_are_proposed_as_they_are(tmp_path: Path, times: Any) -> None:
    """An index of dates was left out, whole ns were taken for s, and the first column for the time."""
    frame = pd.DataFrame({"gz": [1.0, 2.0], "AccX": [0.0, 0.0], "AccY": 0.0, "AccZ": 1.0})
    if isinstance(times, list):
        frame["timestamp"] = times
    else:
        frame.index = times
    frame.to_parquet(path := tmp_path / "drive.parquet")
    with pytest.raises(DataError) as refused:
        open_recording(path)
    (tmp_path / "drive.parquet.columns.yaml").write_text(str(refused.value).split(".columns.yaml: ")[1])
    recording = open_recording(path)
    assert recording.start_ns == 1_714_564_800 * 10**9
    assert recording.imu is not None
    assert np.diff(recording.imu.t_ns).tolist() == [10**9]
    assert recording.imu.accel_mps2[0, 2] == pytest.approx(9.80665)


def test_damaged_parquet(tmp_path: Path) -> None:
    path = parquet(tmp_path, {"t": [0.0], "wz": [1.0]})
    whole = path.read_bytes()
    for data in (whole[:100], whole[:-8], b"PAR1" + random.Random(7).randbytes(5000), b"PAR1"):
        path.write_bytes(data)
        with pytest.raises(DataError) as told:
            open_recording(path)
        assert "\n" not in str(told.value)


def test_parquet_without_pyarrow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = parquet(tmp_path, {"t": [0.0], "wz": [1.0]})
    genuine = builtins.__import__

    def without(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.startswith("pyarrow"):
            raise ImportError(name)
        return genuine(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(DataError, match=r'pip install "terrafusion\[parquet\]"'):
        open_recording(path)
