"""The Michigan Husky's text files: how they go together, what they mean, and what is refused."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from terrafusion.datasets.catalog import load_catalog
from terrafusion.datasets.conventions import Conventions, apply
from terrafusion.datasets.doctor.finding import Patient
from terrafusion.datasets.doctor.measures import measure
from terrafusion.datasets.doctor.mounting import heading
from terrafusion.datasets.errors import DataError
from terrafusion.datasets.readers import open_recording, umich_text
from terrafusion.datasets.recording import Recording, differences
from terrafusion.datasets.trajectory import Trajectory

START_S = 1_652_300_000
SECONDS = 60.0
FAMILY = ("trial4_wheel_imu.txt", "trial4_wheel_vel.txt", "trial4_loop_center.txt", "trial4_loop_front.txt")


def motion(t: np.ndarray) -> tuple[np.ndarray, ...]:
    """Speed, yaw rate, yaw, x and y of a winding drive with stops, at seconds from its start."""
    fine = np.arange(-1.0, SECONDS + 2.0, 0.002)
    v = 0.8 * np.clip(np.sin(0.25 * fine), 0.0, 0.7)
    rate = 0.5 * np.sin(0.9 * fine) * (v > 0)
    yaw = np.cumsum(rate) * 0.002
    x, y = np.cumsum(v * np.cos(yaw)) * 0.002, np.cumsum(v * np.sin(yaw)) * 0.002
    return tuple(np.interp(t, fine, column) for column in (v, rate, yaw, x, y))


def save(path: Path, t_s: np.ndarray, columns: list[np.ndarray]) -> None:
    """Rows as the set has them: Unix seconds with ten decimals, then numbers."""
    rows = np.stack(columns, axis=1)
    lines = [
        f"{START_S + int(t)}.{round((t - int(t)) * 1e10):010d} {' '.join(f'{x:.17g}' for x in row)}\n"
        for t, row in zip(t_s.tolist(), rows.tolist(), strict=True)
    ]
    path.write_text("".join(lines))


def write_trial(folder: Path) -> Path:
    """The four files of a trial, all on one clock."""
    rng = np.random.default_rng(4)
    t = np.arange(0.0, SECONDS, 0.01)
    v, rate, *_ = motion(t)
    noise = rng.normal(0.0, 0.02, (6, len(t)))
    zero = np.zeros_like(t)
    imu = [zero, zero, rate, np.gradient(v, t), v * rate, zero + 9.8]
    save(folder / FAMILY[0], t, [c + n for c, n in zip(imu, noise, strict=True)])
    t = np.arange(0.1, SECONDS, 0.1)
    v, *_ = motion(t)
    save(folder / FAMILY[1], t, [v / 0.97, 0.0 * v, 0.0 * v])
    t = np.arange(0.5, SECONDS - 0.5, 1.0 / 60.0)
    _, _, yaw, x, y = motion(t)
    x, y = x - x[0], y - y[0]
    x, y = x * np.cos(yaw[0]) + y * np.sin(yaw[0]), y * np.cos(yaw[0]) - x * np.sin(yaw[0])
    yaw = yaw - yaw[0]
    quaternion = [0.0 * t, 0.0 * t, np.sin(yaw / 2), np.cos(yaw / 2)]
    save(folder / FAMILY[2], t, [x, y, 0.0 * t, *quaternion])
    ahead = 0.47 * np.stack([np.cos(yaw) - 1.0, np.sin(yaw)])
    save(folder / FAMILY[3], t, [x + ahead[0], y + ahead[1], 0.0 * t, *quaternion])
    return folder


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_trial(tmp_path_factory.mktemp("umich"))


@pytest.fixture
def mocap_logs() -> Path:
    """The trials with motion capture, where the environment names the field logs."""
    root = os.environ.get("TERRAFUSION_DATA")
    if not root or not (Path(root) / "umich_husky" / "mair_mocap").is_dir():
        pytest.skip("TERRAFUSION_DATA names no folder with umich_husky/mair_mocap")
    return Path(root) / "umich_husky" / "mair_mocap"


# --- physics: what must hold of a recording whose signs, axes, scales and clocks are right


def forward_speed(truth: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Speed along the body's x, and along its y, of the truth (m/s), over 0.3 s."""
    n = 9
    dt = (truth.t_ns[2 * n :] - truth.t_ns[: -2 * n]) * 1e-9
    velocity = (truth.position_m[2 * n :] - truth.position_m[: -2 * n])[:, :2] / dt[:, None]
    yaw = truth.yaw_rad()[n:-n]
    ahead = velocity[:, 0] * np.cos(yaw) + velocity[:, 1] * np.sin(yaw)
    return ahead, velocity[:, 1] * np.cos(yaw) - velocity[:, 0] * np.sin(yaw)


def physics(recording: Recording) -> dict[str, bool]:
    """Every check by name: whether it holds."""
    assert recording.truth is not None
    assert recording.imu is not None
    measures = measure([recording])
    late = {lag.quantity: lag.seconds for lag in measures.lags if "truth" in (lag.earlier, lag.later)}
    ahead, aside = forward_speed(recording.truth)
    moving = ahead**2 + aside**2 > 0.04
    tilt = recording.truth.quaternion[:, :2] if recording.truth.quaternion is not None else np.ones((1, 2))
    checks = {
        "gravity": measures.gravity is not None and measures.gravity.axis == "+z",
        "yaw": late.get("yaw rate", 9.0) < 9.0,
        "yaw clock": late.get("yaw rate", 9.0) < 0.02,
        "forward": bool(np.abs(np.median(np.arctan2(aside[moving], ahead[moving]))) < np.radians(3.0)),
        "up": bool(np.abs(tilt).max() < 0.2),
    }
    if recording.wheels is not None:
        t = recording.truth.t_ns[9:-9]
        rolled = np.interp(t, recording.wheels.t_ns, recording.wheels.speed[:, 0])
        told = heading(Patient(recording, None))
        angle = told.angle if told is not None and told.angle is not None else np.pi
        checks["imu forward"] = abs(angle) < np.radians(15.0)
        checks["wheel sign"] = bool(np.corrcoef(rolled, ahead)[0, 1] > 0.5)
        checks["wheel scale"] = 0.94 < measures.path_m["truth"] / measures.path_m["wheels"] < 1.0
        checks["wheel clock"] = late.get("speed", 9.0) < 0.06
    return checks


def turned(axes: tuple[str, ...]) -> Callable[[Recording], Recording]:
    return lambda recording: apply(recording, Conventions(imu_axes=axes))


def moved(channel: str, seconds: float) -> Callable[[Recording], Recording]:
    return lambda recording: apply(recording, Conventions(lag_s={channel: seconds}))


def reposed(quaternion: Callable[[np.ndarray], np.ndarray]) -> Callable[[Recording], Recording]:
    def flip(recording: Recording) -> Recording:
        assert recording.truth is not None
        assert recording.truth.quaternion is not None
        truth = dataclasses.replace(recording.truth, quaternion=quaternion(recording.truth.quaternion))
        return dataclasses.replace(recording, truth=truth)

    return flip


def scaled(factor: float) -> Callable[[Recording], Recording]:
    def flip(recording: Recording) -> Recording:
        assert recording.wheels is not None
        wheels = dataclasses.replace(recording.wheels, speed=recording.wheels.speed * factor)
        return dataclasses.replace(recording, wheels=wheels)

    return flip


def quarter_turn(q: np.ndarray) -> np.ndarray:
    """The orientations of a body whose x axis is what was y."""
    x, y, z, w = q.T
    return np.stack([x + y, y - x, z + w, w - z], axis=1) * np.sqrt(0.5)


FLIPS: dict[str, tuple[Callable[[Recording], Recording], str]] = {
    "IMU upside down": (turned(("+x", "-y", "-z")), "gravity"),
    "IMU on its side": (turned(("+x", "+z", "-y")), "gravity"),
    "IMU to the back": (turned(("-x", "-y", "+z")), "imu forward"),
    "IMU to the left": (turned(("-y", "+x", "+z")), "imu forward"),
    "IMU to the right": (turned(("+y", "-x", "+z")), "imu forward"),
    "yaw rate to the right": (lambda r: apply(r, Conventions(gyro_z_sign=-1.0)), "yaw"),
    "wheels backwards": (scaled(-1.0), "wheel sign"),
    "diameter for radius": (scaled(2.0), "wheel scale"),
    "quaternion w first": (reposed(lambda q: q[:, [3, 0, 1, 2]]), "up"),
    "mocap x to the left": (reposed(quarter_turn), "forward"),
    "mocap 0.1 s late": (moved("truth", -0.1), "yaw clock"),
    "wheels 0.15 s late": (moved("wheels", -0.15), "wheel clock"),
}  # fmt: skip


@pytest.mark.parametrize("name", FLIPS)
def test_a_flipped_convention_breaks_physics(trial: Path, name: str) -> None:
    recording = open_recording(trial / FAMILY[0])
    assert all(physics(recording).values()), physics(recording)
    flip, check = FLIPS[name]
    assert not physics(flip(recording))[check]


@pytest.mark.parametrize(
    "file", ["trial1_wheel_imu.txt", "trial7_wheel_imu.txt", "2_test_imu.txt", "3_test_imu.txt"]
)
def test_the_trials_obey_physics(mocap_logs: Path, file: str) -> None:
    recording = open_recording(mocap_logs / file)
    assert recording.vehicle == "husky"
    assert all(physics(recording).values()), physics(recording)


@pytest.mark.parametrize("name", FLIPS)
@pytest.mark.parametrize("file", ["trial1_wheel_vel.txt", "trial7_wheel_vel.txt"])
def test_a_flipped_trial_breaks_physics(mocap_logs: Path, file: str, name: str) -> None:
    flip, check = FLIPS[name]
    assert not physics(flip(open_recording(mocap_logs / file)))[check]


@pytest.mark.parametrize("number", [1, 2, 3, 7])
def test_every_trial_needs_its_lags(mocap_logs: Path, number: int) -> None:
    """The catalogue's lags of the motion capture: without them, or with the other sign, clocks disagree."""
    known = load_catalog().sets["umich_husky"]
    lags = known.conventions_of(f"mair_mocap/trial{number}").lag_s
    recording = open_recording(f"umich_husky/mair_mocap/trial{number}")
    assert physics(recording)["yaw clock"]
    for factor in (1.0, 2.0):
        assert not physics(moved("truth", -factor * lags["truth"])(recording))["yaw clock"]
    if recording.wheels is not None:  # wheels and IMU are ahead by little: what is left is in the interval
        assert -0.08 < lags["wheels"] < -0.03


@pytest.mark.parametrize(("stem", "path_m"), [("trial1", 20.36), ("trial7", 40.05)])
def test_ground_over_wheel_path(mocap_logs: Path, stem: str, path_m: float) -> None:
    recording = open_recording(mocap_logs / f"{stem}_wheel_vel.txt")
    found = measure([recording]).path_m
    assert found["truth"] == pytest.approx(path_m, rel=0.01)
    assert 0.95 < found["truth"] / found["wheels"] < 0.98


@pytest.mark.parametrize(
    "name", ["mars_sand2_no_disturbance", "sand_small_pebble", "slip_detect1", "slip_detect2", "up_to_hill1"]
)
def test_the_drives_in_the_field(mocap_logs: Path, name: str) -> None:
    recording = open_recording(f"umich_husky/field/{name}")
    assert set(recording.channels()) == {"wheels", "imu"}
    gravity = measure([recording]).gravity
    assert gravity is not None
    assert gravity.axis == "+z"
    assert abs(gravity.size_mps2 - 9.8) < 0.15
    assert recording.imu is not None
    assert 195 < (len(recording.imu) - 1) / recording.duration_s() < 201
    assert recording.licence == "MIT"


# --- files of a recording


@pytest.mark.parametrize("file", FAMILY)
def test_any_file_opens_the_whole(trial: Path, file: str) -> None:
    whole, other = open_recording(trial / FAMILY[0]), open_recording(trial / file)
    assert set(whole.channels()) == {"imu", "wheels"}
    assert whole.name == "trial4"
    assert whole.truth_channels == ("position", "yaw")
    assert differences(dataclasses.replace(whole, notes=()), dataclasses.replace(other, notes=())) == []
    joined = next(note for note in other.notes if note.startswith("joined with"))
    assert all(name in joined for name in FAMILY)
    assert any(note.startswith("front: second rigid body") for note in other.notes)


def test_numbers_are_those_of_the_files(trial: Path) -> None:
    recording = open_recording(trial / FAMILY[0])
    assert recording.imu is not None
    assert recording.wheels is not None
    assert recording.truth is not None
    table = np.loadtxt(trial / FAMILY[0])
    np.testing.assert_array_equal(
        np.hstack([recording.imu.gyro_radps, recording.imu.accel_mps2]), table[:, 1:]
    )
    assert recording.imu.t_ns[7] == START_S * 10**9 + 70_000_000
    assert (recording.wheels.names, recording.wheels.unit) == (("speed",), "mps")
    np.testing.assert_array_equal(recording.wheels.speed[:, 0], np.loadtxt(trial / FAMILY[1])[:, 1])
    np.testing.assert_array_equal(recording.truth.position_m, np.loadtxt(trial / FAMILY[2])[:, 1:4])


@pytest.mark.parametrize(
    ("file", "channels", "truth"),
    [(FAMILY[0], {"imu"}, ()), (FAMILY[1], {"wheels"}, ()), (FAMILY[2], set(), ("position", "yaw")),
     (FAMILY[3], set(), ("yaw",))],
)  # fmt: skip
def test_a_file_alone(
    trial: Path, tmp_path: Path, file: str, channels: set[str], truth: tuple[str, ...]
) -> None:
    (tmp_path / file).write_bytes((trial / file).read_bytes())
    recording = open_recording(tmp_path / file)
    assert set(recording.channels()) == channels
    assert recording.truth_channels == truth
    assert any("stands alone" in note for note in recording.notes)


def test_the_other_names_of_the_set(trial: Path, tmp_path: Path) -> None:
    for old, new in zip(
        FAMILY, ("04_test_imu.txt", "04_test_vel_input.txt", "trial4_cat_center.txt"), strict=False
    ):
        (tmp_path / new).write_bytes((trial / old).read_bytes())
    assert set(open_recording(tmp_path / "trial4_cat_center.txt").channels()) == {"imu", "wheels"}
    for old, new in zip(FAMILY, ("hill__wheel_imu.txt", "hill__wheel_vel_input.txt"), strict=False):
        (tmp_path / new).write_bytes((trial / old).read_bytes())
    for old, new in zip(FAMILY, ("wheel_imu.txt", "wheel_vel_input.txt"), strict=False):
        (tmp_path / new).write_bytes((trial / old).read_bytes())
    for file, name in (("hill__wheel_vel_input.txt", "hill"), ("wheel_imu.txt", tmp_path.name)):
        recording = open_recording(tmp_path / file)
        assert recording.name == name
        assert set(recording.channels()) == {"imu", "wheels"}
        assert recording.truth is None


def test_a_velocity_of_another_source_is_no_wheels(trial: Path, tmp_path: Path) -> None:
    """Beside some trials lies a body velocity made of the motion capture under the wheels' name."""
    (tmp_path / "4_test_imu.txt").write_bytes((trial / FAMILY[0]).read_bytes())
    lines = (trial / FAMILY[1]).read_text().splitlines(keepends=True)
    (tmp_path / "4_test_vel_input.txt").write_text("".join(put(9, 2, "0.01")(lines)))
    recording = open_recording(tmp_path / "4_test_imu.txt")
    assert set(recording.channels()) == {"imu"}
    assert any("4_test_vel_input.txt moves sideways" in note for note in recording.notes)
    with pytest.raises(DataError, match="line 10: wheels that move sideways"):
        open_recording(tmp_path / "4_test_vel_input.txt")
    assert not umich_text.claims(tmp_path / "4_inekf_wheel_vel.txt", b"1 2 3 4\n")


def test_files_of_another_time_are_not_joined(trial: Path, tmp_path: Path) -> None:
    for file in FAMILY[:2]:
        (tmp_path / file).write_bytes((trial / file).read_bytes())
    later = (trial / FAMILY[2]).read_text().replace("16523000", "16523009")
    (tmp_path / FAMILY[2]).write_text(later)
    recording = open_recording(tmp_path / FAMILY[0])
    assert recording.truth is None
    assert any(FAMILY[2] in note and "not joined" in note for note in recording.notes)


def test_an_open_choice_is_refused(trial: Path, tmp_path: Path) -> None:
    for file in (*FAMILY, "trial4_square_center.txt"):
        source = FAMILY[2] if "center" in file else file
        (tmp_path / file).write_bytes((trial / source).read_bytes())
    with pytest.raises(DataError, match=r"trial4_loop_center\.txt and trial4_square_center\.txt both"):
        open_recording(tmp_path / FAMILY[0])
    assert open_recording(tmp_path / FAMILY[2]).truth is not None


# --- what is odd, and what is refused


def changed(trial: Path, folder: Path, file: str, change: Callable[[list[str]], list[str]]) -> Path:
    """A copy of one file with its lines changed."""
    lines = (trial / file).read_text().splitlines(keepends=True)
    (folder / file).write_text("".join(change(lines)))
    return folder / file


def put(row: int, column: int, cell: str) -> Callable[[list[str]], list[str]]:
    """A change of one cell; rows count from 0."""

    def change(lines: list[str]) -> list[str]:
        cells = lines[row].split()
        cells[column] = cell
        return [*lines[:row], " ".join(cells) + "\n", *lines[row + 1 :]]

    return change


def columns(*order: int) -> Callable[[list[str]], list[str]]:
    """A change of all lines: these columns, in this order."""
    return lambda lines: [" ".join(line.split()[i] for i in order) + "\n" for line in lines]


BAD: dict[str, tuple[int, Callable[[list[str]], list[str]], tuple[str, ...]]] = {
    "short line": (0, lambda x: [*x[:6], "1652300000.06 1 2\n", *x[7:]], ("line 7 has 3 cells for 7",)),
    "long line": (2, lambda x: [*x[:6], x[6].strip() + " 1\n", *x[7:]], ("line 7 has 9 cells for 8",)),
    "text": (0, put(9, 3, "fast"), ("'fast'", "line 10")),
    "NaN": (0, put(9, 3, "nan"), ("'nan'", "line 10", "t = 0.090 s")),
    "infinite": (2, put(9, 3, "inf"), ("'inf'", "line 10")),
    "time in words": (1, put(4, 0, "noon"), ("'noon'", "line 5")),
    "time of no year": (1, put(4, 0, "1e17"), ("'1e17'", "line 5")),
    "columns of another file": (0, columns(0, 1, 2, 3, 4, 5), ("6 cells for 7",)),
    "wheels aside": (1, put(11, 2, "0.25"), ("line 12", "sideways", "t = 1.100 s")),
    "vx and vy swapped": (1, columns(0, 2, 1, 3), ("sideways",)),
    "no quaternion": (2, put(20, 7, "0.5"), ("line 21", "quaternion", "t = 0.333 s")),
    "time runs back": (2, lambda x: [*x[:9], x[7], *x[10:]], ("line 10", "runs backwards by 0.016667 s")),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused(trial: Path, tmp_path: Path, name: str) -> None:
    which, change, words = BAD[name]
    path = changed(trial, tmp_path, FAMILY[which], change)
    with pytest.raises(DataError) as refused:
        open_recording(path)
    message = str(refused.value)
    assert "\n" not in message
    assert len(message) < 500
    for word in (path.name, *words):
        assert word in message, message


def test_other_text_is_not_claimed(tmp_path: Path) -> None:
    for content in (b"t,wx,wy\n1,2,3\n", b"all work\n", b"\n", b"\x00\x01\x02"):
        (tmp_path / "x_imu.txt").write_bytes(content)
        with pytest.raises(DataError):
            open_recording(tmp_path / "x_imu.txt")
    (tmp_path / "x_imu.txt").write_bytes(b"")
    with pytest.raises(DataError, match="empty"):
        open_recording(tmp_path / "x_imu.txt")
    assert not umich_text.claims(tmp_path / "x_imu.txt", b"t wx wy\n")
    (tmp_path / "notes.txt").write_text("1 2 3 4 5 6 7\n")
    assert not umich_text.claims(tmp_path / "notes.txt", b"1 2 3 4 5 6 7\n")


def test_a_huge_file_is_refused_unread(tmp_path: Path) -> None:
    with (tmp_path / "x_imu.txt").open("wb") as file:
        file.write(b"1652300000.0 0 0 0 0 0 9.8\n")
        file.truncate(600 << 20)  # sparse: takes no room on the disk
    with pytest.raises(DataError, match="more than 512 MB"):
        open_recording(tmp_path / "x_imu.txt")


def test_a_cut_last_line_is_left_out_and_told(trial: Path, tmp_path: Path) -> None:
    path = changed(trial, tmp_path, FAMILY[0], lambda lines: [*lines[:50], lines[50][:40]])
    recording = open_recording(path)
    assert recording.imu is not None
    assert len(recording.imu) == 50
    assert any("cut off" in note for note in recording.notes)


def test_repeated_poses_are_dropped_and_told(trial: Path, tmp_path: Path) -> None:
    recording = open_recording(changed(trial, tmp_path, FAMILY[2], lambda x: [*x[:9], x[8], x[8], *x[9:]]))
    assert recording.truth is not None
    assert len(recording.truth) == len((trial / FAMILY[2]).read_text().splitlines())
    assert any("2 rows repeat a time" in note for note in recording.notes)


def test_lost_frames_are_told(trial: Path, tmp_path: Path) -> None:
    recording = open_recording(changed(trial, tmp_path, FAMILY[2], lambda x: [*x[:60], *x[120:]]))
    assert any("60 frames lost" in note and "longest 1.02 s" in note for note in recording.notes)


def test_a_step_of_the_clock_is_taken_out_if_asked_for(trial: Path, tmp_path: Path) -> None:
    def back(lines: list[str]) -> list[str]:
        cells = [line.split(maxsplit=1) for line in lines[2000:]]
        return [*lines[:2000], *(f"{float(t) - 5.0:.10f} {rest}" for t, rest in cells)]

    path = changed(trial, tmp_path, FAMILY[0], back)
    with pytest.raises(DataError, match="runs backwards"):
        open_recording(path)
    recording = open_recording(path, repair_clock=True)
    assert [(jump.channel, round(jump.step_s, 3)) for jump in recording.clock_jumps] == [("imu", -5.0)]


def test_the_front_checks_the_centre(trial: Path, tmp_path: Path) -> None:
    """A centre whose markers were mixed up disagrees with the front."""
    for file in FAMILY:
        (tmp_path / file).write_bytes((trial / file).read_bytes())
    assert not any("wrong" in note for note in open_recording(tmp_path / FAMILY[0]).notes)
    table = np.loadtxt(tmp_path / FAMILY[2])
    yaw = 2.0 * np.arctan2(table[:, 6], table[:, 7]) + np.radians(20.0) * (np.arange(len(table)) > 50)
    table[:, 6], table[:, 7] = np.sin(yaw / 2), np.cos(yaw / 2)
    save(tmp_path / FAMILY[2], table[:, 0] - START_S, list(table[:, 1:].T))
    assert any("one of the two is wrong" in note for note in open_recording(tmp_path / FAMILY[0]).notes)
