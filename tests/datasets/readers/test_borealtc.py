"""BorealTC's csv pairs: how they go together, what they mean, and what is refused."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from terrafusion.datasets.checks.finding import CheckContext
from terrafusion.datasets.checks.imu import heading
from terrafusion.datasets.checks.measures import measure
from terrafusion.datasets.core.channels import TERRAINS
from terrafusion.datasets.core.conventions import Conventions, apply
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers import files_of, hashes_of, open_recording
from terrafusion.datasets.readers.sets import borealtc_csv
from tests.differences import differences

IMU_HEADER, PRO_HEADER = "time,wx,wy,wz,ax,ay,az", "time,curL,curR,velL,velR"
SECONDS, TRACK_M = 60.0, 0.8
TURNING = (
    "ASPHALT/00",
    "ASPHALT/01",
    "FLOORING/00",
    "FLOORING/05",
    "FLOORING/09",
    "ICE/00",
    "ICE/02",
)
"""Runs that turn both ways, so that the yaw rate's sign shows."""


def write_run(folder: Path) -> Path:
    """A winding run in the form of the set; returns `imu_00.csv`."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(0)
    t = np.round(np.arange(0.0, SECONDS, 0.01), 2)
    imu = rng.normal((0, 0, 0, 0, 0, 9.8), 0.05, (len(t), 6))
    imu[:, 2] += 0.2 * np.sin(0.7 * t)
    imu[:, 3] += 0.3 * np.cos(0.9 * t) * 0.9
    t_pro = np.arange(0.0, SECONDS, 1 / 6.5)
    half, v = 0.1 * TRACK_M * np.sin(0.7 * t_pro), 0.5 + 0.3 * np.sin(0.9 * t_pro)
    pro = np.stack([rng.random(len(t_pro)) * 9, rng.random(len(t_pro)) * 9, v - half, v + half], axis=1)
    for name, header, times, rows in (("imu", IMU_HEADER, t, imu), ("pro", PRO_HEADER, t_pro, pro)):
        lines = [
            f"{s!r},{','.join(map(repr, row))}\n"
            for s, row in zip(times.tolist(), rows.tolist(), strict=True)
        ]
        (folder / f"{name}_00.csv").write_text(header + "\n" + "".join(lines))
    return folder / "imu_00.csv"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("boreal") / "SNOW")


@pytest.fixture
def boreal_logs() -> Path:
    """The set, where the environment names the field logs."""
    root = os.environ.get("TERRAFUSION_DATA")
    if not root or not (Path(root) / "borealtc").is_dir():
        pytest.skip("TERRAFUSION_DATA names no folder with borealtc")
    return Path(root) / "borealtc"


# --- physics


def physics(recording: Recording) -> dict[str, bool]:
    """Every check by name: whether it holds."""
    measures = measure([recording])
    assert recording.motor is not None
    assert measures.yaw is not None
    track = measures.yaw.effective_track_m
    told = heading(CheckContext(recording, None))
    return {
        "gravity": measures.gravity is not None and measures.gravity.axis == "+z",
        "forward": told is None or told.angle is None or abs(told.angle) < np.radians(15.0),
        "yaw": measures.yaw.r > 0.5,
        "metres and radians": track is not None and 0.6 < track < 1.7,
        "amperes": 1.0 < float(recording.motor.current_a.mean()) < 20.0,
    }


def imu_scaled(gyro: float) -> Callable[[Recording], Recording]:
    def flip(recording: Recording) -> Recording:
        assert recording.imu is not None
        imu = dataclasses.replace(recording.imu, gyro_radps=recording.imu.gyro_radps * gyro)
        return dataclasses.replace(recording, imu=imu)

    return flip


def sides_swapped(recording: Recording) -> Recording:
    assert recording.wheels is not None
    wheels = dataclasses.replace(recording.wheels, speed=recording.wheels.speed[:, ::-1])
    return dataclasses.replace(recording, wheels=wheels)


def wheels_in_radps(recording: Recording) -> Recording:
    assert recording.wheels is not None
    wheels = dataclasses.replace(recording.wheels, speed=recording.wheels.speed / 0.1651)
    return dataclasses.replace(recording, wheels=wheels)


def motor_in_ma(recording: Recording) -> Recording:
    assert recording.motor is not None
    motor = dataclasses.replace(recording.motor, current_a=recording.motor.current_a * 1e3)
    return dataclasses.replace(recording, motor=motor)


FLIPS: dict[str, tuple[Callable[[Recording], Recording], str]] = {
    "z down": (lambda r: apply(r, Conventions(imu_axes=("+x", "-y", "-z"))), "gravity"),
    "y up": (lambda r: apply(r, Conventions(imu_axes=("+x", "+z", "-y"))), "gravity"),
    "x backwards": (lambda r: apply(r, Conventions(imu_axes=("-x", "-y", "+z"))), "forward"),
    "yaw rate to the right": (lambda r: apply(r, Conventions(gyro_z_sign=-1.0)), "yaw"),
    "right side first": (sides_swapped, "yaw"),
    "wheels in rad/s": (wheels_in_radps, "metres and radians"),
    "gyro in deg/s": (imu_scaled(57.3), "metres and radians"),
    "milliamperes": (motor_in_ma, "amperes"),
}


@pytest.mark.parametrize("name", FLIPS)
def test_a_flipped_convention_breaks_physics(run: Path, name: str) -> None:
    recording = open_recording(run)
    assert all(physics(recording).values()), physics(recording)
    flip, check = FLIPS[name]
    assert not physics(flip(recording))[check]


@pytest.mark.parametrize("name", ["ASPHALT/01", "FLOORING/00", "FLOORING/05", "ICE/02"])
@pytest.mark.parametrize("axes", [("-x", "-y", "+z"), ("-y", "+x", "+z"), ("+y", "-x", "+z")])
def test_x_is_forward_where_the_run_tells(boreal_logs: Path, name: str, axes: tuple[str, ...]) -> None:
    recording = open_recording(f"borealtc/{name}")
    assert heading(CheckContext(recording, None)) is not None
    assert physics(recording)["forward"]
    assert not physics(apply(recording, Conventions(imu_axes=axes)))["forward"]


@pytest.mark.parametrize("name", TURNING)
def test_the_runs_obey_physics(boreal_logs: Path, name: str) -> None:
    recording = open_recording(f"borealtc/{name}")
    assert all(physics(recording).values()), (physics(recording), measure([recording]).yaw)
    for flip, check in FLIPS.values():
        assert check == "forward" or not physics(flip(recording))[check]


def test_spins_turn_the_way_the_wheels_say(boreal_logs: Path) -> None:
    """Runs on the spot at a constant rate say nothing by correlation; their means do."""
    spins = 0
    for file in sorted(boreal_logs.glob("*/imu_*.csv")):
        recording = open_recording(file)
        assert recording.wheels is not None
        assert recording.imu is not None
        turn = recording.wheels.speed[:, 1] - recording.wheels.speed[:, 0]
        if abs(turn.mean()) > 0.04 and turn.std() < 0.03:
            spins += 1
            assert turn.mean() * recording.imu.gyro_radps[:, 2].mean() > 0.0, file
    assert spins == 17


def test_all_runs_open(boreal_logs: Path) -> None:
    alone = []
    for file in sorted(boreal_logs.glob("*/pro_*.csv")):
        recording = open_recording(file)
        assert recording.start_ns == 0
        assert recording.vehicle == "husky"
        assert recording.terrain_name == file.parent.name.lower()
        assert recording.wheels is not None
        np.testing.assert_allclose(np.diff(recording.wheels.t_ns), 1e9 / 6.5, atol=1.0)
        steps = recording.wheels.speed * 127.0
        np.testing.assert_allclose(steps, np.rint(steps), atol=1e-9)
        if recording.imu is None:
            alone.append(f"{file.parent.name}/{file.name}")
        else:
            assert abs(int(recording.imu.t_ns[-1]) - int(recording.wheels.t_ns[-1])) < 1.5e9
            gravity = measure([recording]).gravity
            assert gravity is not None
            assert gravity.axis == "+z"
            assert abs(gravity.size_mps2 - 9.8) < 0.2
    assert alone == ["FLOORING/pro_04.csv", "FLOORING/pro_06.csv", "ICE/pro_01.csv"]


# --- files of a run


def test_either_file_opens_both(run: Path) -> None:
    one, other = open_recording(run), open_recording(run.with_name("pro_00.csv"))
    assert differences(one, other) == []
    assert set(one.channels()) == {"imu", "wheels", "motor", "terrain"}
    assert one.name == "SNOW/00"
    assert one.start_ns == 0
    assert any("assumed to start together" in note for note in one.notes)
    assert any("exactly even" in note for note in one.notes)
    pair = [run.with_name(f"{kind}_00.csv") for kind in ("imu", "pro")]
    assert [files_of(file) for file in pair] == [pair, pair]


def test_numbers_are_those_of_the_files(run: Path) -> None:
    recording = open_recording(run)
    assert recording.imu is not None
    assert recording.wheels is not None
    assert recording.motor is not None
    imu = np.loadtxt(run, delimiter=",", skiprows=1)
    pro = np.loadtxt(run.with_name("pro_00.csv"), delimiter=",", skiprows=1)
    np.testing.assert_array_equal(np.hstack([recording.imu.gyro_radps, recording.imu.accel_mps2]), imu[:, 1:])
    np.testing.assert_array_equal(np.hstack([recording.motor.current_a, recording.wheels.speed]), pro[:, 1:])
    assert (recording.wheels.names, recording.wheels.unit) == (("left", "right"), "mps")
    np.testing.assert_array_equal(recording.imu.t_ns, np.arange(len(imu)) * 10_000_000)
    np.testing.assert_array_equal(recording.wheels.t_ns, np.rint(pro[:, 0] * 1e9).astype(np.int64))


@pytest.mark.parametrize(("file", "channels"), [("imu_00.csv", {"imu"}), ("pro_00.csv", {"wheels", "motor"})])
def test_a_file_alone(run: Path, tmp_path: Path, file: str, channels: set[str]) -> None:
    folder = tmp_path / "SNOW"
    folder.mkdir()
    (folder / file).write_bytes(run.with_name(file).read_bytes())
    recording = open_recording(folder / file)
    assert set(recording.channels()) == channels | {"terrain"}
    assert f"{file} stands alone" in recording.notes


@pytest.mark.parametrize(
    ("folder", "label", "known"),
    [
        ("ASPHALT", "asphalt", True),
        ("SNOW", "snow", True),
        ("PLOUGHED", "ploughed_soil", True),
        ("ICE", "ice", False),
        ("SANDY_LOAM", "sandy_loam", False),
        ("DIRT_ROAD", "dirt_road", False),
        ("run7", "", False),
    ],
)
def test_the_folder_names_the_ground(tmp_path: Path, folder: str, label: str, known: bool) -> None:
    recording = open_recording(write_run(tmp_path / folder))
    assert recording.terrain_name == label
    assert (label in TERRAINS) == known
    if label:
        assert recording.terrain is not None
        assert recording.terrain.label.tolist() == [label]
        assert recording.terrain.source == "annotation"
    else:
        assert recording.terrain is None
        assert any("names no ground" in note for note in recording.notes)
    assert any("no class for it" in note for note in recording.notes) == bool(label and not known)


def test_columns_go_by_their_names(run: Path, tmp_path: Path) -> None:
    (tmp_path / "SNOW").mkdir()
    rows = [line.split(",") for line in run.read_text().split()]
    swapped = [",".join([row[0], *row[4:], *row[1:4]]) for row in rows]
    (tmp_path / "SNOW" / "imu_00.csv").write_text("\n".join(swapped) + "\n")
    one, other = open_recording(run).imu, open_recording(tmp_path / "SNOW" / "imu_00.csv").imu
    assert differences(one, other) == []


def test_swapped_columns_under_the_right_header_break_physics(run: Path, tmp_path: Path) -> None:
    (tmp_path / "SNOW").mkdir()
    head, *rows = [line.split(",") for line in run.read_text().split()]
    swapped = [",".join([row[0], *row[4:], *row[1:4]]) for row in rows]
    (tmp_path / "SNOW" / "imu_00.csv").write_text("\n".join([",".join(head), *swapped]) + "\n")
    gravity = measure([open_recording(tmp_path / "SNOW" / "imu_00.csv")]).gravity
    assert gravity is not None
    assert gravity.size_mps2 < 1.0


BAD = {
    "text": ("0.04,1,2,3,4,fast,6", ("'fast'", "line 6", "t = 0.040 s")),
    "NaN": ("0.04,1,2,3,4,nan,6", ("'nan'", "line 6", "t = 0.040 s")),
    "nothing": ("0.04,1,2,,4,5,6", ("line 6", "'wz'")),
    "infinite": ("0.04,1,2,3,4,inf,6", ("'inf'", "line 6")),
    "short": ("0.04,1,2", ("line 6 has 3 cells for 7", "t = 0.040 s")),
    "long": ("0.04,1,2,3,4,5,6,7", ("line 6 has 8 cells for 7",)),
    "time runs back": ("0.01,1,2,3,4,5,6", ("line 6", "runs backwards by 0.020000 s")),
    "time of no clock": ("1e30,1,2,3,4,5,6", ("'1e30'", "line 6")),
    "a quote that never ends": ('0.04,"1,2,3,4,5,6', ("line",)),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_rows_are_refused(run: Path, tmp_path: Path, name: str) -> None:
    row, words = BAD[name]
    (tmp_path / "SNOW").mkdir()
    path = tmp_path / "SNOW" / "imu_00.csv"
    lines = run.read_text().splitlines(keepends=True)
    path.write_text("".join([*lines[:5], row + "\n", *lines[6:20]]))
    with pytest.raises(DataError) as refused:
        open_recording(path)
    message = str(refused.value)
    assert "\n" not in message
    assert len(message) < 500
    for word in (path.name, *words):
        assert word in message, message


def test_a_bad_partner_is_named(run: Path, tmp_path: Path) -> None:
    imu = write_run(tmp_path / "ICE")
    imu.with_name("pro_00.csv").write_text("time,curL\n0.0,1\n")
    with pytest.raises(DataError, match=r"pro_00\.csv.*header is 'time,curL'"):
        open_recording(imu)


def test_other_tables_are_not_claimed(run: Path) -> None:
    assert borealtc_csv.claims(run, (IMU_HEADER + "\r\n").encode())
    assert not borealtc_csv.claims(run, b"t_s,gyro_x_radps\n")
    assert not borealtc_csv.claims(run, (PRO_HEADER + "\n").encode())
    assert not borealtc_csv.claims(run, b"")
    assert not borealtc_csv.claims(run.with_name("SNOW.csv"), IMU_HEADER.encode())


def test_empty_and_header_only(tmp_path: Path) -> None:
    (tmp_path / "imu_00.csv").write_bytes(b"")
    with pytest.raises(DataError, match="empty"):
        open_recording(tmp_path / "imu_00.csv")
    (tmp_path / "imu_00.csv").write_text(IMU_HEADER + "\n")
    with pytest.raises(DataError, match="no rows"):
        open_recording(tmp_path / "imu_00.csv")


def test_a_huge_file_is_refused_unread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("terrafusion.datasets.readers.delimited.bytearray", pytest.fail, raising=False)
    with (tmp_path / "imu_00.csv").open("wb") as file:
        file.write(IMU_HEADER.encode() + b"\n")
        file.truncate(600 << 20)  # sparse: takes no room on the disk
    with pytest.raises(DataError, match="more than 512 MB"):
        open_recording(tmp_path / "imu_00.csv")


def test_what_was_read_is_every_file_of_the_logs(tmp_path: Path) -> None:
    folders = [tmp_path / day / "ICE" for day in ("one", "two")]
    for i, folder in enumerate(folders):
        folder.mkdir(parents=True)
        for kind, head in (("imu", "time,wx,wy,wz,ax,ay,az"), ("pro", "time,curL,curR,velL,velR")):
            (folder / f"{kind}_01.csv").write_text(
                f"{head}\n" + ",".join([str(i)] * (head.count(",") + 1)) + "\n"
            )
        (folder / "imu_02.csv").write_text("of another run")
    hashes = hashes_of([str(folder / "imu_01.csv") for folder in folders])
    assert list(hashes) == [f"{day}/ICE/{kind}_01.csv" for day in ("one", "two") for kind in ("imu", "pro")]
    assert len(set(hashes.values())) == 4
    one = hashes_of([str(folders[0] / "pro_01.csv")])
    assert list(one) == ["ICE/imu_01.csv", "ICE/pro_01.csv"]
    assert set(one.values()) < set(hashes.values())
    with pytest.raises(DataError, match="no such file"):
        hashes_of(["absent.csv"])
