"""Bad input of every kind: exit status 1, one line that says what, where and what to do, no traceback."""

from __future__ import annotations

import functools
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from importlib import resources
from pathlib import Path

import pytest

ENTRY = "from terrafusion.fusion.cli.main import main; main()"
LIMIT_S = 10.0

Spoil = Callable[[Path], object]

SCENARIO = """\
description: a short drive with turns both ways
drive:
  - {duration_s: 2}
  - {duration_s: 8, v_mps: 0.9}
  - {duration_s: 8, v_mps: 0.9, yaw_rate_radps: 0.4}
  - {duration_s: 8, v_mps: 0.9, yaw_rate_radps: -0.4}
max_accel_mps2: 0.5
route:
  - {terrain: asphalt}
"""


@pytest.fixture(scope="session")
def good_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log folder that replays well."""
    from terrafusion.datasets.writers import write_log_folder
    from terrafusion.twin.simulate import simulate

    folder = tmp_path_factory.mktemp("good")
    (folder / "short.yaml").write_text(SCENARIO)
    return write_log_folder(simulate(str(folder / "short.yaml"), seed=1), folder / "log")


@pytest.fixture(autouse=True)
def quick(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """No test here may take long; each works in a folder of its own."""
    monkeypatch.chdir(tmp_path)
    begun = time.monotonic()
    yield
    assert time.monotonic() - begun < LIMIT_S


def text_of(name: str, content: str | bytes) -> Spoil:
    """Replace a file."""
    data = content.encode() if isinstance(content, str) else content
    return lambda log: (log / name).write_bytes(data)


def rename(name: str, old: str, new: str) -> Spoil:
    """Rename a column."""

    def spoil(log: Path) -> None:
        header, rest = (log / name).read_text().split("\n", 1)
        assert old in header.split(",")
        columns = [new if column == old else column for column in header.split(",")]
        (log / name).write_text(",".join(columns) + "\n" + rest)

    return spoil


def swap(name: str, one: str, other: str) -> Spoil:
    """Exchange the names of two columns."""

    def spoil(log: Path) -> None:
        for old, new in ((one, "?"), (other, one), ("?", other)):
            rename(name, old, new)(log)

    return spoil


def cells(name: str, column: str, value: str, rows: slice = slice(50, 51)) -> Spoil:
    """Write `value` into some rows of a column."""

    def spoil(log: Path) -> None:
        lines = [line.split(",") for line in (log / name).read_text().splitlines()]
        k = lines[0].index(column)
        for row in lines[1:][rows]:
            row[k] = value
        (log / name).write_text("".join(",".join(row) + "\n" for row in lines))

    return spoil


def scaled(name: str, columns: tuple[str, ...], factor: float, offset: float = 0.0) -> Spoil:
    """Multiply columns, as a wrong unit does."""

    def spoil(log: Path) -> None:
        lines = [line.split(",") for line in (log / name).read_text().splitlines()]
        for k in (lines[0].index(column) for column in columns):
            for row in lines[1:]:
                row[k] = repr(float(row[k]) * factor + offset)
        (log / name).write_text("".join(",".join(row) + "\n" for row in lines))

    return spoil


def drop_column(name: str, column: str) -> Spoil:
    """Take a column out."""

    def spoil(log: Path) -> None:
        lines = [line.split(",") for line in (log / name).read_text().splitlines()]
        k = lines[0].index(column)
        (log / name).write_text("".join(",".join(row[:k] + row[k + 1 :]) + "\n" for row in lines))

    return spoil


def back_in_time(name: str) -> Spoil:
    """Let the 4th row come before the 3rd."""

    def spoil(log: Path) -> None:
        lines = (log / name).read_text().splitlines(keepends=True)
        lines[3], lines[4] = lines[4], lines[3]
        (log / name).write_text("".join(lines))

    return spoil


def without(*names: str) -> Spoil:
    """Take files away."""
    return lambda log: [(log / name).unlink() for name in names]


def only_first_second(log: Path) -> None:
    for path in log.glob("*.csv"):
        header, *rows = path.read_text().splitlines(keepends=True)
        path.write_text(header + "".join(row for row in rows if float(row.split(",")[0]) <= 1.0))


def meta(*lines: str, drop: str = "") -> Spoil:
    """Add lines to meta.yaml, after taking those away that start with `drop`."""

    def spoil(log: Path) -> None:
        kept = [
            line
            for line in (log / "meta.yaml").read_text().splitlines()
            if not (drop and line.startswith(drop))
        ]
        (log / "meta.yaml").write_text("\n".join([*kept, *lines, ""]))

    return spoil


BOMB = "description: [&a0 [x, x, x, x, x, x, x, x, x]" + "".join(
    f", &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 9)
)
SIX = ("gyro_x_radps", "gyro_y_radps", "gyro_z_radps", "accel_x_mps2", "accel_y_mps2", "accel_z_mps2")
ACCEL = SIX[3:]
ALL = slice(None)

BAD_LOGS: dict[str, tuple[Spoil, tuple[str, ...]]] = {
    "no meta": (without("meta.yaml"), ("log", "no meta.yaml", "write meta.yaml")),
    "no wheels": (without("wheels.csv"), ("log", "no wheel speeds", "wheels.csv")),
    "no imu": (without("imu.csv"), ("log", "no six-axis IMU")),
    "no channel": (
        without(*(f"{c}.csv" for c in ("command", "wheels", "imu", "gnss", "motor", "terrain", "truth"))),
        ("no channel", "add at least one"),
    ),
    "one second": (only_first_second, ("log", "at least")),
    "nan text": (
        cells("imu.csv", "gyro_z_radps", "nan"),
        ("imu.csv", "gyro_z_radps", "'nan'", "line 52", "leave the cell empty"),
    ),
    "empty time cells, as pandas writes NaN": (
        cells("imu.csv", "t_s", "", slice(50, 60)),
        ("imu.csv", "line 52 has no t_s", "needs its time"),
    ),
    "unix time": (
        scaled("imu.csv", ("t_s",), 1.0, 1.7e9),
        ("imu.csv", "looks like Unix time", "start_ns"),
    ),
    **{
        f"{name} runs backwards": (
            back_in_time(f"{name}.csv"),
            (f"{name}.csv", "time runs backwards", "sort the rows"),
        )
        for name in ("command", "wheels", "imu", "gnss", "motor", "terrain", "truth")
    },
    "unknown column": (
        rename("imu.csv", "gyro_z_radps", "gyro_z_dps"),
        ("imu.csv", "unknown column 'gyro_z_dps'", "did you mean 'gyro_z_radps'"),
    ),
    "missing column": (
        drop_column("gnss.csv", "sigma_e_m"),
        ("gnss.csv", "'sigma_e_m' is missing", "needed: t_s"),
    ),
    "missing wheel": (
        drop_column("wheels.csv", "front_left_radps"),
        ("wheels.csv", "not a layout", "give one of"),
    ),
    "missing gyro axis": (drop_column("imu.csv", "gyro_x_radps"), ("no six-axis IMU", "three gyro")),
    "axes swapped": (
        swap("imu.csv", "accel_x_mps2", "accel_z_mps2"),
        ("imu", "gravity stands on +x", "rotate the IMU"),
    ),
    "sides swapped": (
        lambda log: [
            swap("wheels.csv", f"{end}_left_{unit}", f"{end}_right_{unit}")(log)
            for end in ("front", "rear")
            for unit in ("radps", "rad")
        ],
        ("imu", "gyro z turns against the wheels", "swap left and right"),
    ),
    "east and north swapped": (
        lambda log: [
            swap("gnss.csv", "east_m", "north_m")(log),
            swap("gnss.csv", "v_e_mps", "v_n_mps")(log),
        ],
        ("log", "gnss", "turns against the gyro", "east and north may be swapped"),
    ),
    "north upside down": (
        scaled("gnss.csv", ("north_m", "v_n_mps"), -1.0),
        ("log", "gnss", "turns against the gyro"),
    ),
    "gyro upside down": (
        scaled("imu.csv", ("gyro_z_radps",), -1.0),
        ("imu", "gyro z turns against the wheels"),
    ),
    "acceleration in g": (scaled("imu.csv", ACCEL, 1 / 9.80665), ("imu", "looks like g", "9.80665")),
    "no gravity": (scaled("imu.csv", ("accel_z_mps2",), 1.0, -9.81), ("imu", "not 9.8")),
    "gyro in deg/s": (scaled("imu.csv", SIX[:3], 57.29578), ("imu", "gyro", "deg/s")),
    "sigma zero": (
        cells("gnss.csv", "sigma_e_m", "0", ALL),
        ("gnss", "sigma that is zero", "give the receiver's accuracy"),
    ),
    "one sigma negative": (
        cells("gnss.csv", "sigma_n_m", "-1"),
        ("log", "gnss", "sigma that is zero, negative", "t = 10.00 s"),
    ),
    "sigma nan": (cells("gnss.csv", "sigma_n_m", "NaN"), ("gnss.csv", "sigma_n_m", "'NaN'", "line 52")),
    **{
        f"huge {column}": (cells(name, column, value), (name.removesuffix(".csv"), value, "unit"))
        for name, column, value in (
            ("imu.csv", "gyro_z_radps", "1e+300"),
            ("imu.csv", "accel_x_mps2", "-1e+300"),
            ("wheels.csv", "rear_left_radps", "1e+300"),
            ("gnss.csv", "east_m", "1e+300"),
            ("gnss.csv", "sigma_e_m", "1e+300"),
            ("gnss.csv", "v_e_mps", "1e+300"),
            ("truth.csv", "x_m", "1e+300"),
        )
    },
    "beyond a double": (cells("imu.csv", "gyro_z_radps", "1e999"), ("imu.csv", "'1e999'", "line 52")),
    "a single line of 10 MB": (
        text_of("imu.csv", "t_s,gyro_z_radps" + ",x" * 5_000_000),
        ("imu.csv", "unknown column 'x'"),
    ),
    "one cell of 10 MB": (
        text_of("imu.csv", "t_s,gyro_z_radps\n0," + "9" * 10_000_000 + "\n"),
        ("imu.csv", "line 2", "131072"),
    ),
    "one name of 10 MB": (
        text_of("imu.csv", "t_s," + "g" * 10_000_000 + "\n0,0\n"),
        ("imu.csv", "line 1", "131072"),
    ),
    "a name of 100 kB": (
        text_of("imu.csv", "t_s," + "g" * 100_000 + "\n0,0\n"),
        ("imu.csv", "unknown column 'ggg"),
    ),
    "an open quote and 5 MB": (
        text_of("imu.csv", 't_s,gyro_z_radps\n0,"' + "0,1\n" * 1_250_000),
        ("imu.csv", "line 2"),
    ),
    "binary": (text_of("imu.csv", bytes(range(256)) * 400), ("imu.csv", "not UTF-8")),
    "binary, only ASCII": (text_of("imu.csv", b"t_s,gyro_z_radps\n\x00\x01,\x02\n"), ("imu.csv", "zero")),
    "latin-1 in a table": (text_of("imu.csv", b"t_s,gyro_z_\xb0\n0,1\n"), ("imu.csv", "not UTF-8")),
    "latin-1 in meta": (
        text_of("meta.yaml", b"start_ns: 0\ndescription: Stra\xdfe\n"),
        ("meta.yaml", "UTF-8"),
    ),
    "empty table": (text_of("wheels.csv", ""), ("wheels.csv", "empty", "header")),
    "a table that is a folder": (
        lambda log: [(log / "imu.csv").unlink(), (log / "imu.csv").mkdir()],
        ("imu.csv", "cannot be read"),
    ),
    "meta is a list": (text_of("meta.yaml", "- start_ns: 0\n"), ("meta.yaml", "mapping")),
    "meta is a word": (text_of("meta.yaml", "hello\n"), ("meta.yaml", "mapping")),
    "meta is empty": (text_of("meta.yaml", ""), ("meta.yaml", "'start_ns' is missing", "Unix time")),
    "meta breaks off": (text_of("meta.yaml", "start_ns: [1"), ("meta.yaml", "not valid YAML")),
    "meta: unknown key": (meta("wheel_diameter_m: 0.3"), ("meta.yaml", "'wheel_diameter_m'", "known")),
    "meta: wrong unit": (
        meta("wheel_radius_mm: 175"),
        ("meta.yaml", "'wheel_radius_mm'", "write 'wheel_radius_m'"),
    ),
    "meta: out of range": (
        meta("wheel_radius_m: 165"),
        ("meta.yaml", "'wheel_radius_m' is 165", "[0.01, 2]", "unit"),
    ),
    "meta: nan": (meta("track_m: .nan"), ("meta.yaml", "track_m", "nan")),
    "meta: 5000 digits": (meta("track_m: 1" + "0" * 5000), ("meta.yaml",)),
    "meta: 400 digits": (meta("track_m: 1" + "0" * 400), ("meta.yaml", "track_m", "out of range")),
    "meta: hexadecimal giant": (meta("track_m: 0x1" + "0" * 5000), ("meta.yaml", "track_m", "huge number")),
    "meta: giant time": (meta("start_ns: 0x1" + "0" * 5000, drop="start_ns"), ("meta.yaml", "start_ns")),
    "meta: no time": (meta(drop="start_ns"), ("meta.yaml", "'start_ns' is missing")),
    "meta: unknown vehicle": (
        meta("vehicle: shopping_trolley", drop="vehicle"),
        ("unknown vehicle 'shopping_trolley'", "elevate"),
    ),
    "meta: no vehicle": (meta(drop="vehicle"), ("log", "names no vehicle", "--vehicle")),
    "meta: aliases that blow up": (meta(f"{BOMB}]", drop="description"), ("meta.yaml", "'description'")),
    "meta: alias of itself": (
        meta("description: &a [*a]", drop="description"),
        ("meta.yaml", "'description'", "text"),
    ),
    "meta: 10 000 brackets": (meta("track_m: " + "[" * 10_000), ("meta.yaml", "not valid YAML")),
    "meta: 10 MB": (text_of("meta.yaml", "start_ns: 0\n" * 900_000), ("meta.yaml",)),
    "meta: a tag that would run": (
        meta("track_m: !!python/object/apply:os.system [touch owned]"),
        ("meta.yaml", "not valid YAML"),
    ),
}


@pytest.mark.parametrize("case", BAD_LOGS)
def test_bad_log(case: str, good_log: Path, tmp_path: Path, terrafusion) -> None:
    spoil, words = BAD_LOGS[case]
    shutil.copytree(good_log, tmp_path / "log")
    spoil(tmp_path / "log")
    terrafusion("replay", "log", "--out", "results").refused(*words)
    assert not (tmp_path / "results").exists()
    assert not (tmp_path / "owned").exists()


def test_the_good_log_is_good(good_log: Path, terrafusion) -> None:
    """Otherwise the cases above would prove little."""
    outcome = terrafusion("replay", good_log, "--out", "results")
    assert (outcome.status, outcome.err) == (0, "")
    assert "running" in outcome.out


@pytest.mark.parametrize("command", ["inspect", "convert"])
@pytest.mark.parametrize("case", ["huge gyro_z_radps", "huge east_m", "huge x_m", "sigma zero"])
def test_looking_at_a_bad_log_is_quiet(
    case: str, command: str, good_log: Path, tmp_path: Path, terrafusion
) -> None:
    """`inspect` and `convert` say what is odd on standard output, without a word of numpy's."""
    shutil.copytree(good_log, tmp_path / "log")
    spoil, _ = BAD_LOGS[case]
    spoil(tmp_path / "log")
    outcome = terrafusion(command, "log", *(["copy"] if command == "convert" else []))
    assert (outcome.status, outcome.err) == (0, "")
    assert "error" in outcome.out


@pytest.mark.parametrize("case", ["huge gyro_z_radps", "huge east_m", "huge x_m"])
def test_a_bag_gets_no_impossible_numbers(case: str, good_log: Path, tmp_path: Path, terrafusion) -> None:
    shutil.copytree(good_log, tmp_path / "log")
    BAD_LOGS[case][0](tmp_path / "log")
    terrafusion("convert", "log", "out.mcap").refused("log", "beyond anything possible")
    assert not (tmp_path / "out.mcap").exists()


def test_fixes_without_sigma_are_left_out(good_log: Path, tmp_path: Path, terrafusion) -> None:
    """An empty cell is a missing value, no error: wheels and IMU alone are used, and that is said."""
    shutil.copytree(good_log, tmp_path / "log")
    cells("gnss.csv", "sigma_n_m", "", ALL)(tmp_path / "log")
    assert "131 of 131 fixes have a sigma that is" in terrafusion("inspect", "log").out
    outcome = terrafusion("replay", "log", "--out", "results")
    assert (outcome.status, outcome.err) == (0, "")
    assert "no usable GNSS fix" in outcome.out


def files(folder: Path) -> None:
    """What the cases below name."""
    (folder / "empty.bag").touch()
    (folder / "empty.mcap").touch()
    (folder / "text.bag").write_text("this is no bag\n" * 500)
    (folder / "text.mcap").write_text("this is no bag\n" * 500)
    (folder / "text.db3").write_text("this is no bag\n" * 500)
    (folder / "magic.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(5000))
    (folder / "magic.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(5000))
    (folder / "folder").mkdir()
    (folder / "ros2").mkdir()
    (folder / "ros2" / "metadata.yaml").write_text("rosbag2_bagfile_information: 5\n")
    (folder / "notes.txt").write_text("hello")


OUTAGES = (
    "soon",
    "12",
    ":",
    "5:",
    ":5",
    "-5:10",
    "5:0",
    "5:-1",
    "nan:5",
    "5:inf",
    "1e999:5",
    "1:2:3",
)

BAD_WORDS: dict[str, tuple[str, tuple[str, ...]]] = {
    "missing file": ("replay gone.bag --out results", ("gone.bag", "no such file", "check the path")),
    "missing folder": ("inspect gone", ("gone", "no such file")),
    "empty bag": ("replay empty.bag --out results", ("empty.bag", "empty", "again")),
    "empty mcap": ("replay empty.mcap --out results", ("empty.mcap", "empty")),
    "text as bag": ("replay text.bag --out results", ("text.bag", "cannot be read as a ROS bag", "copy")),
    "text as mcap": ("replay text.mcap --out results", ("text.mcap", "cannot be read", "mcap recover")),
    "text as db3": ("replay text.db3 --out results", ("text.db3",)),
    "zeros as bag": ("replay magic.bag --out results", ("magic.bag",)),
    "zeros as mcap": ("replay magic.mcap --out results", ("magic.mcap",)),
    "no log folder": ("replay folder --out results", ("folder", "no meta.yaml")),
    "broken ROS 2 folder": ("replay ros2 --out results", ("ros2", "cannot be read")),
    "unknown kind": ("replay notes.txt --out results", ("notes.txt", "unknown kind", "log folder")),
    "a device": ("inspect /dev/null", ("/dev/null",)),
    "unknown vehicle": (
        "replay LOG --vehicle tank --out results",
        ("unknown vehicle 'tank'", "known are", "husky"),
    ),
    "vehicle file is gone": ("replay LOG --vehicle my.yaml --out results", ("my.yaml", "no such file")),
    "vehicle file is a folder": ("replay LOG --vehicle folder --out results", ("'folder'", "known are")),
    "policy is gone": ("replay LOG --policy my.yaml --out results", ("my.yaml", "no such file")),
    "policy is a text": ("replay LOG --policy notes.txt --out results", ("notes.txt", "mapping")),
    "policy is a log's meta": ("replay LOG --policy LOG/meta.yaml --out results", ("meta.yaml",)),
    **{
        f"outage {text}": (
            f"replay LOG --out results --gnss-outage={text}",
            (f"'{text}'", "--gnss-outage", "START:SECONDS"),
        )
        for text in OUTAGES
    },
    "outage after the end": (
        "replay LOG --out results --gnss-outage 1000:10",
        ("outage", "1000", "after the end", "lasts 26"),
    ),
    "results into a file": ("replay LOG --out notes.txt", ("notes.txt", "folder")),
    "results below a file": ("replay LOG --out notes.txt/results", ("notes.txt", "choose a folder")),
    "results into proc": ("replay LOG --out /proc/results", ("/proc/results", "cannot be written")),
    "demo into a file": ("demo --out notes.txt", ("notes.txt", "choose a folder")),
    "demo into proc": ("demo --out /proc/demo", ("/proc/demo", "cannot be written")),
    "demo, negative seed": ("demo --out d --seed=-1", ("seed", "-1")),
    "simulate into a file": ("simulate straight --out notes.txt", ("notes.txt", "folder")),
    "simulate onto an mcap": ("simulate straight --out empty.mcap", ("empty.mcap", "exists")),
    "simulate into proc": ("simulate straight --out /proc/run", ("/proc/run", "cannot be written")),
    "simulate into another folder": ("simulate straight --out ros2", ("ros2", "not empty")),
    "unknown scenario": ("simulate moonwalk --out s", ("unknown scenario 'moonwalk'", "paper_profile")),
    "scenario is a text": ("simulate notes.txt --out s", ("notes.txt", "mapping")),
    "unknown terrain": ("simulate straight --terrain lava --out s", ("'lava'", "loose_sand")),
    "steep": ("simulate straight --slope-deg 40 --out s", ("slope", "40", "25")),
    "slope nan": ("simulate straight --slope-deg nan --out s", ("slope", "nan")),
    "negative payload": ("simulate straight --payload-kg=-5 --out s", ("payload", "-5")),
    "heavy payload": ("simulate straight --payload-kg 5000 --out s", ("payload", "5000")),
    "negative seed": ("simulate straight --seed=-1 --out s", ("seed", "-1")),
    "unknown vehicle to simulate": ("simulate straight --vehicle tank --out s", ("'tank'", "elevate")),
    "unknown topic": ("convert notes.txt x", ("notes.txt", "unknown kind")),
    "convert into a file": ("convert LOG notes.txt", ("notes.txt", "folder")),
    "convert onto an mcap": ("convert LOG empty.mcap", ("empty.mcap", "exists")),
    "convert below a file": ("convert LOG notes.txt/a.mcap", ("notes.txt", "cannot be written")),
}


@pytest.mark.parametrize("case", BAD_WORDS)
def test_bad_words(case: str, good_log: Path, tmp_path: Path, terrafusion) -> None:
    files(tmp_path)
    line, words = BAD_WORDS[case]
    terrafusion(*line.replace("LOG", str(good_log)).split()).refused(*words)


@functools.cache
def vehicle_text() -> str:
    folder = resources.files("terrafusion.twin.params") / "vehicles"
    return (folder / "husky.yaml").read_text(encoding="utf-8")


BAD_VEHICLES: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "wrong unit": (
        r"^  wheel_radius_m: \{value: [^,]*,",
        "  wheel_radius_mm: {value: 175.0,",
        ("odometry.wheel_radius_mm", "write 'wheel_radius_m'"),
    ),
    "out of range": (
        r"^  wheel_radius_m: \{value: [^,]*,",
        "  wheel_radius_m: {value: 165,",
        ("odometry.wheel_radius_m", "165", "[0.02, 2] m", "unit"),
    ),
    "no source": (
        r"^  wheel_radius_m: .*$",
        "  wheel_radius_m: {value: 0.175}",
        ("odometry.wheel_radius_m", "no source", "where the number comes from"),
    ),
    "bare number": (
        r"^  wheel_radius_m: .*$",
        "  wheel_radius_m: 0.175",
        ("odometry.wheel_radius_m", "without a source", "write {value"),
    ),
    "text": (
        r"^  wheel_radius_m: \{value: [^,]*,",
        "  wheel_radius_m: {value: wide,",
        ("odometry.wheel_radius_m", "'wide'", "give a number in [0.02, 2] m"),
    ),
    "nan": (
        r"^  wheel_radius_m: \{value: [^,]*,",
        "  wheel_radius_m: {value: .nan,",
        ("odometry.wheel_radius_m", "nan"),
    ),
    "missing": (r"^  wheel_radius_m: .*\n", "", ("odometry.wheel_radius_m", "missing", "add it")),
    "missing section": (r"^odometry:\n(  .*\n)+", "", ("'odometry' is missing",)),
    "unknown key": (r"^name: ", "colour: red\nname: ", ("unknown key 'colour'",)),
    "section is a list": (r"^odometry:\n(  .*\n)+", "odometry: [1, 2]\n", ("odometry", "not a section")),
    "axes": (r"axes: .*$", 'axes: ["+x", "+x", "+z"]', ("axes",)),
    "aliases that blow up": (r"^description: .*$", f"{BOMB}]", ("'description'", "text")),
}


@pytest.mark.parametrize("case", BAD_VEHICLES)
def test_bad_vehicle_file(case: str, good_log: Path, tmp_path: Path, terrafusion) -> None:
    pattern, replacement, words = BAD_VEHICLES[case]
    spoilt, count = re.subn(pattern, lambda _: replacement, vehicle_text(), count=1, flags=re.MULTILINE)
    assert count == 1, "the vehicle file has changed: adapt the case"
    (tmp_path / "my.yaml").write_text(spoilt)
    terrafusion("replay", good_log, "--vehicle", "my.yaml", "--out", "results").refused("my.yaml", *words)


@pytest.mark.parametrize("share", [0.0001, 0.1, 0.5, 0.9, 1.0])
def test_truncated_bag(share: float, husky_bag: Path, tmp_path: Path, terrafusion) -> None:
    data = husky_bag.read_bytes()
    (tmp_path / "cut.bag").write_bytes(data[: min(int(share * len(data)), len(data) - 10)])
    terrafusion("replay", "cut.bag", "--vehicle", "husky", "--out", "results").refused(
        "cut.bag", "copy it again"
    )


@pytest.mark.parametrize(("channel", "told"), [("wheels", "no wheel speeds"), ("imu", "no six-axis IMU")])
def test_bag_without_a_channel(channel: str, told: str, good_log: Path, tmp_path: Path, terrafusion) -> None:
    shutil.copytree(good_log, tmp_path / "log")
    (tmp_path / "log" / f"{channel}.csv").unlink()
    assert terrafusion("convert", "log", "part.mcap").status == 0
    outcome = terrafusion("replay", "part.mcap", "--vehicle", "elevate", "--out", "results")
    outcome.refused("part", channel, told)


@pytest.mark.parametrize("share", [0.0005, 0.1, 0.5, 0.9, 1.0])
def test_truncated_mcap(share: float, good_log: Path, tmp_path: Path, terrafusion) -> None:
    assert terrafusion("convert", good_log, "whole.mcap").status == 0
    data = (tmp_path / "whole.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: min(int(share * len(data)), len(data) - 10)])
    outcome = terrafusion("replay", "cut.mcap", "--vehicle", "elevate", "--out", "results")
    outcome.refused("cut.mcap", "copy it again")


@pytest.mark.parametrize("words", [
    "replay LOG", "replay LOG --out r --mode magic", "replay LOG --out r --colour red", "replay", "fly",
    "simulate straight", "simulate straight --out s --seed many", "simulate straight --out s --slope-deg up",
    "replay LOG --out r --stamps arrival", "replay LOG --out r --topic imu", "convert LOG", "demo extra",
])  # fmt: skip
def test_wrong_usage_is_status_2(words: str, good_log: Path, tmp_path: Path, terrafusion) -> None:
    outcome = terrafusion(*words.replace("LOG", str(good_log)).split())
    assert outcome.status == 2, outcome
    assert "Traceback" not in outcome.err
    assert outcome.err.strip()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("line", "status"),
    [
        ("replay gone.bag --out results", 1),
        ("replay text.bag --out results", 1),
        ("replay LOG --out results --gnss-outage=soon", 1),
        ("replay LOG --out results --mode magic", 2),
    ],
)
def test_as_the_shell_sees_it(line: str, status: int, good_log: Path, tmp_path: Path) -> None:
    files(tmp_path)
    words = line.replace("LOG", str(good_log)).split()
    done = subprocess.run(
        [sys.executable, "-c", ENTRY, *words], capture_output=True, text=True, timeout=60, check=False,
        cwd=tmp_path, env=os.environ | {"PYTHONWARNINGS": "default"},
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (status, "")
    assert "Traceback" not in done.stderr
    if status == 1:
        assert done.stderr.startswith("error: ")
        assert done.stderr.count("\n") == 1
