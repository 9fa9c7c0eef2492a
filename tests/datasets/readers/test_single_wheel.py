"""Single-wheel trials: the published file against physics and scipy, synthetic and hostile files."""

from __future__ import annotations

import json
import resource
import struct
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.readers import open_recordings
from terrafusion.datasets.readers.sets.single_wheel import FIELDS, WheelTrials, read_wheel_trials

COUNT = 12
DTYPE = [(name, object) for name in [*sorted(FIELDS), "polyx"]]


@pytest.fixture
def smooth(published: Path) -> Path:
    return published / "cmu_single_wheel" / "all_smooth_data.mat"


def raw_trials() -> np.ndarray:
    """Trials in the file's axes and units: side force x, resistance y, pull-down z, mm, mm/s, degrees."""
    trials = np.zeros((COUNT, 1), dtype=DTYPE)
    for k in range(COUNT):
        rim, beta = (3.0, 10.0, 40.0)[k % 3], 15.0 * (k // 3)
        slip = (rim - 10.0) / max(rim, 10.0)
        values = {
            "Fx": 30.0 * np.sin(np.radians(beta)),
            "Fy": -20.0 * slip,
            "Fz": -21.0,
            "Vx": 10.0,
            "Vry": rim,
            "angle": beta,
            "Z": -25.0 - k,
        }
        cells = {f"avg_{n}": v for n, v in values.items()} | {f"std_{n}": 0.1 for n in values}
        cells |= {"Vry": rim, "beta": beta, "trial_num": 1 + k % 2, "slip": slip}
        for name, value in cells.items():
            trials[k, 0][name] = np.array([[value]])
        trials[k, 0]["polyx"] = np.array([[0.5, 1.0]], dtype=np.float32)
    return trials


def save(path: Path, trials: Any, name: str = "all_results", **options: Any) -> Path:
    scipy.io.savemat(path, {"before": np.arange(5.0), name: trials}, **options)
    return path


# --- the published file ------------------------------------------------------------------------------------


def test_the_published_trials(smooth: Path) -> None:
    trials = read_wheel_trials(smooth)
    summary = trials.summary()
    assert (summary["trials"], summary["braked"], summary["driven"]) == (189, 84, 84)
    assert summary["slip"] == (-1.0, pytest.approx(0.9, abs=1e-3))
    assert trials.notes == ()
    degrees = np.degrees(np.array(summary["commanded_side_slip_rad"]))
    np.testing.assert_allclose(degrees, [0, 15, 30, 45, 60, 75, 90])
    assert np.abs(trials.side_slip_rad - trials.commanded_side_slip_rad).max() < np.radians(1.0)
    np.testing.assert_allclose(trials.travel_speed_mps, 0.01, atol=3e-5)


def test_the_page_of_trials(tmp_path: Path, terrafusion: Any) -> None:
    path = save(tmp_path / "trials.mat", raw_trials())
    shown = terrafusion("inspect", path)
    assert shown.status == 0, shown.err
    assert f"{len(read_wheel_trials(path))} trials of a single wheel" in shown.out
    assert "side_slip_deg" in shown.out
    page = json.loads(terrafusion("inspect", path, "--json").out)
    assert page["trials"] == len(read_wheel_trials(path))
    assert terrafusion("convert", path, tmp_path / "out").refused("not a drive", "inspect")


def axes_checks(t: WheelTrials) -> dict[str, bool]:
    """What soil does to a wheel: true in the wheel's axes only."""
    straight, broadside = t.commanded_side_slip_rad == 0.0, t.commanded_side_slip_rad > 1.5
    return {
        "a spinning wheel pulls": bool(t.tractive_force_n[straight & (t.slip > 0.7)].min() > 0.0),
        "a locked wheel drags": bool(t.tractive_force_n[straight & (t.slip < -0.9)].max() < -10.0),
        "no side force straight ahead": bool(np.abs(t.side_force_n[straight]).max() < 3.0),
        "side force against the side-slip": bool(t.side_force_n[broadside].min() > 20.0),
        "the load presses": bool(t.load_n.min() > 0.0),
        "friction": bool(np.all(np.hypot(t.tractive_force_n, t.side_force_n) < 4.0 * t.load_n)),
        "it sinks": bool(t.sinkage_m.min() > 0.0 and t.sinkage_m.max() < 0.1),
    }


def test_axes_and_signs(smooth: Path) -> None:
    assert all(axes_checks(read_wheel_trials(smooth)).values())


def test_axes_as_the_file_has_them_are_seen(smooth: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from terrafusion.datasets.readers.sets import single_wheel

    for name, check in (("Fy", "a locked wheel drags"), ("Fz", "the load presses"), ("Z", "it sinks")):
        with monkeypatch.context() as patch:
            *words, factor = single_wheel._QUANTITIES[name]
            flipped = single_wheel._QUANTITIES | {name: (*words, -factor)}
            patch.setattr(single_wheel, "_QUANTITIES", flipped)
            assert not axes_checks(read_wheel_trials(smooth))[check]


def test_numbers_are_those_of_scipy(smooth: Path) -> None:
    trials = read_wheel_trials(smooth)
    raw = scipy.io.loadmat(smooth)["all_results"].ravel()
    for name, column, scale in (
        ("avg_Fx", trials.side_force_n, 1.0),
        ("avg_Fy", trials.tractive_force_n, -1.0),
        ("std_Fz", trials.load_sd_n, 1.0),
        ("avg_Vry", trials.rim_speed_mps, 1e-3),
        ("slip", trials.slip, 1.0),
    ):
        np.testing.assert_array_equal(column, [scale * float(r[name][0, 0]) for r in raw])


def test_it_is_no_drive(smooth: Path) -> None:
    with pytest.raises(
        DataError, match=r"holds 189 trials of a single wheel, not a drive; .*read_wheel_trials"
    ):
        open_recordings(smooth)


# --- synthetic files ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("name", ["all_results", "grouser_results"])
def test_synthetic_trials(tmp_path: Path, compressed: bool, name: str) -> None:
    path = save(tmp_path / "any.dat", raw_trials(), name, do_compression=compressed)
    trials = read_wheel_trials(path)
    assert len(trials) == COUNT
    np.testing.assert_allclose(trials.tractive_force_n, 20.0 * trials.slip)
    np.testing.assert_allclose(trials.side_force_n, 30.0 * np.sin(trials.side_slip_rad))
    np.testing.assert_allclose(trials.load_n, 21.0)
    np.testing.assert_allclose(trials.sinkage_m, 0.025 + 0.001 * np.arange(COUNT))
    np.testing.assert_allclose(trials.rim_speed_mps, np.tile([0.003, 0.01, 0.04], 4))
    assert trials.trial.tolist() == [1, 2] * 6
    table = trials.to_pandas()
    assert table.shape == (COUNT, 18)
    assert list(table)[:3] == ["slip", "side_slip_rad", "tractive_force_n"]
    with pytest.raises(DataError, match="holds 12 trials"):
        open_recordings(path)


def test_slip_that_its_speeds_do_not_give(tmp_path: Path) -> None:
    trials = raw_trials()
    trials[4, 0]["slip"] = np.array([[0.5]])
    notes = read_wheel_trials(save(tmp_path / "any.mat", trials)).notes
    assert notes == ("slip: off the speeds by up to 0.50, in 1 of 12 trials",)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300, np.zeros((0, 0)), np.ones((1, 2)), "text"])
def test_trials_that_lack_a_number(tmp_path: Path, value: Any) -> None:
    trials = raw_trials()
    trials[7, 0]["avg_Fx"] = np.atleast_2d(value) if not isinstance(value, str) else value
    with pytest.raises(DataError, match="avg_Fx: trial 7"):
        read_wheel_trials(save(tmp_path / "any.mat", trials))


def test_other_matlab_files_are_not_claimed(tmp_path: Path) -> None:
    path = tmp_path / "other.mat"
    scipy.io.savemat(path, {"x": np.zeros(3), "s": {"a": 1.0}})
    with pytest.raises(DataError, match="unknown kind of file"):
        open_recordings(path)
    with pytest.raises(DataError, match="holds no structures with"):
        read_wheel_trials(path)
    with pytest.raises(DataError, match="no such file"):
        read_wheel_trials(tmp_path / "none.mat")


def test_no_trials(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="holds no trials"):
        read_wheel_trials(save(tmp_path / "any.mat", raw_trials()[:0]))


# --- hostile files -----------------------------------------------------------------------------------------

HEADER = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"


def element(kind: int, payload: bytes) -> bytes:
    return struct.pack("<II", kind, len(payload)) + payload + bytes(-len(payload) % 8)


def structure(dimensions: tuple[int, ...], width: int = 32, values: bytes = b"") -> bytes:
    """A variable `all_results` with the trials' fields and any dimensions."""
    names = b"".join(name.encode().ljust(width, b"\0") for name in sorted(FIELDS))
    inside = element(6, struct.pack("<II", 2, 0)) + element(
        5, struct.pack(f"<{len(dimensions)}i", *dimensions)
    )
    inside += element(1, b"all_results") + struct.pack("<Ii", (4 << 16) | 5, width) + element(1, names)
    return element(14, inside + values)


def bomb() -> bytes:
    """A quarter of a gigabyte of zeros behind the beginning of a structure, in 256 KiB."""
    packer = zlib.compressobj(9)
    data = packer.compress(structure((1, 1))[:8]) + packer.compress(structure((1, 1))[8:])
    for _ in range(256):
        data += packer.compress(bytes(1 << 20))
    data += packer.flush()
    return struct.pack("<II", 15, len(data)) + data


def nested_cells(depth: int) -> bytes:
    """A cell in a cell in a cell ...: readers that recurse run out of stack."""
    data = element(14, element(6, struct.pack("<II", 6, 0)) + element(5, bytes(8)) + element(1, b"") * 2)
    for _ in range(depth):
        head = element(6, struct.pack("<II", 1, 0)) + element(5, struct.pack("<ii", 1, 1)) + element(1, b"a")
        data = struct.pack("<II", 14, len(head) + len(data)) + head + data
    return data


HOSTILE = {
    "huge dimensions": structure((2**31 - 1, 2**31 - 1)),
    "negative dimensions": structure((-5, 1)),
    "no values": structure((100, 1)),
    "cut off": structure((1, 1))[:200],
    "zlib bomb": bomb(),
    "no zlib": struct.pack("<II", 15, 64) + bytes(64),
    "many variables": element(14, element(6, struct.pack("<II", 6, 0))) * 5000,
    "nested cells": nested_cells(5_000),
    "nested cells among the values": structure((1, 1), values=nested_cells(5_000)),
    "deep": structure((1, 1), values=structure((1, 1), values=structure((1, 1)))),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_are_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / "any.mat"
    path.write_bytes(HEADER + HOSTILE[name])
    before, began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    for read in (read_wheel_trials, open_recordings):
        with pytest.raises(DataError) as refusal:
            read(path)
        assert "\n" not in str(refusal.value)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300_000
    assert time.process_time() - began < 5.0


def test_truncated_and_flipped_files(tmp_path: Path) -> None:
    path, rng, refused = tmp_path / "bad.mat", np.random.default_rng(3), 0
    for compressed in (False, True):
        whole = save(tmp_path / "any.mat", raw_trials(), do_compression=compressed).read_bytes()
        for k in range(150):
            data = bytearray(whole if k % 2 else whole[: int(rng.integers(1, len(whole)))])
            for at in rng.integers(0, len(data), size=3 * (k % 2)):
                data[at] = rng.integers(0, 256)
            path.write_bytes(bytes(data))
            try:
                read_wheel_trials(path)
            except DataError:
                refused += 1
    assert refused > 150
