"""Bad log folders: exit status 1, one line that says what, where and what to do, no traceback."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.conftest import Terrafusion
from tests.datasets.readers.test_cut_files import ros1_bag

pytestmark = pytest.mark.usefixtures("quick")

Spoil = Callable[[Path], object]


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


SIX = ("gyro_x_radps", "gyro_y_radps", "gyro_z_radps", "accel_x_mps2", "accel_y_mps2", "accel_z_mps2")
ACCEL = SIX[3:]
ALL = slice(None)

BAD_LOGS: dict[str, tuple[Spoil, tuple[str, ...]]] = {
    "no meta": (without("meta.yaml"), ("log", "no meta.yaml", "write meta.yaml")),
    "no wheels": (without("wheels.csv"), ("log", "no wheel speeds", "wheels.csv")),
    "no wheels, gyro in deg/s": (
        lambda log: [without("wheels.csv")(log), scaled("imu.csv", SIX[:3], 57.29578)(log)],
        ("log", "no wheel speeds", "wheels.csv"),
    ),
    "no channel": (
        without(*(f"{c}.csv" for c in ("command", "wheels", "imu", "gnss", "motor", "terrain", "truth"))),
        ("no channel", "add at least one"),
    ),
    "one second": (only_first_second, ("overlap for 1.0 s", "at least")),
    "nan text": (
        cells("imu.csv", "gyro_z_radps", "nan"),
        ("imu.csv", "gyro_z_radps", "'nan'", "line 52", "leave the cell empty"),
    ),
    "empty time cells, as pandas writes NaN": (
        cells("imu.csv", "t_s", "", slice(50, 60)),
        ("imu.csv", "line 52 has no 't_s'", "needs its time"),
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
    "axes swapped": (
        swap("imu.csv", "accel_x_mps2", "accel_z_mps2"),
        ("imu", "gravity stands on +x", "turn the accelerometer", "--apply-fixes"),
    ),
    "sides swapped": (
        lambda log: [
            swap("wheels.csv", f"{end}_left_{unit}", f"{end}_right_{unit}")(log)
            for end in ("front", "rear")
            for unit in ("radps", "rad")
        ],
        ("wheels", "against gyro z", "swap left and right wheels", "--apply-fixes"),
    ),
    "east and north swapped": (
        lambda log: [
            swap("gnss.csv", "east_m", "north_m")(log),
            swap("gnss.csv", "v_e_mps", "v_n_mps")(log),
        ],
        ("log", "gnss", "turns against gyro z", "--apply-fixes"),
    ),
    "north upside down": (
        scaled("gnss.csv", ("north_m", "v_n_mps"), -1.0),
        ("log", "gnss", "turns against gyro z"),
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
        ("gnss", "sigma that is zero", "the usual value"),
    ),
    "one sigma negative": (
        cells("gnss.csv", "sigma_n_m", "-1"),
        ("log", "gnss", "sigma that is zero, negative", "t = 10.00 s"),
    ),
    "sigma nan": (cells("gnss.csv", "sigma_n_m", "NaN"), ("gnss.csv", "sigma_n_m", "'NaN'", "line 52")),
    **{
        f"huge {column}": (cells(name, column, value), (name.removesuffix(".csv"), value, "beyond anything"))
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
        ("imu.csv", "65 536 bytes in line 1"),
    ),
    "one cell of 10 MB": (
        text_of("imu.csv", "t_s,gyro_z_radps\n0," + "9" * 10_000_000 + "\n"),
        ("imu.csv", "65 536 bytes in line 2"),
    ),
    "one name of 10 MB": (
        text_of("imu.csv", "t_s," + "g" * 10_000_000 + "\n0,0\n"),
        ("imu.csv", "65 536 bytes in line 1"),
    ),
    "a name of 60 kB": (
        text_of("imu.csv", "t_s," + "g" * 60_000 + "\n0,0\n"),
        ("imu.csv", "unknown column 'ggg"),
    ),
    "an open quote and 5 MB": (
        text_of("imu.csv", 't_s,gyro_z_radps\n0,"' + "0,1\n" * 1_250_000),
        ("imu.csv", "line 2"),
    ),
    "binary": (text_of("imu.csv", bytes(range(256)) * 400), ("imu.csv", "not UTF-8")),
    "binary, only ASCII": (text_of("imu.csv", b"t_s,gyro_z_radps\n\x00\x01,\x02\n"), ("imu.csv", "zero")),
    "latin-1 in a table": (text_of("imu.csv", b"t_s,gyro_z_\xb0\n0,1\n"), ("imu.csv", "not UTF-8")),
    "empty table": (text_of("wheels.csv", ""), ("wheels.csv", "empty", "header")),
    "a table that is a folder": (
        lambda log: [(log / "imu.csv").unlink(), (log / "imu.csv").mkdir()],
        ("imu.csv", "is no file"),
    ),
}


@pytest.mark.parametrize("case", BAD_LOGS)
def test_bad_log(case: str, good_log: Path, tmp_path: Path, terrafusion) -> None:
    spoil, words = BAD_LOGS[case]
    shutil.copytree(good_log, tmp_path / "log")
    spoil(tmp_path / "log")
    assert terrafusion("replay", "log", "--out", "results").refused(*words)
    assert not (tmp_path / "results").exists()


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
    assert (outcome.status, outcome.err) == (int(command == "inspect"), "")
    assert "error" in outcome.out


@pytest.mark.parametrize("case", ["huge gyro_z_radps", "huge east_m", "huge x_m"])
def test_a_bag_gets_no_impossible_numbers(case: str, good_log: Path, tmp_path: Path, terrafusion) -> None:
    shutil.copytree(good_log, tmp_path / "log")
    BAD_LOGS[case][0](tmp_path / "log")
    assert terrafusion("convert", "log", "out.mcap").refused("log", "beyond anything possible")
    assert not (tmp_path / "out.mcap").exists()


def test_fixes_without_sigma_have_that_of_their_class(good_log: Path, tmp_path: Path, terrafusion) -> None:
    """An empty cell is a missing value, no error: the fixes are used, and what is assumed is said."""
    shutil.copytree(good_log, tmp_path / "log")
    cells("gnss.csv", "sigma_n_m", "", ALL)(tmp_path / "log")
    assert "131 fixes have no sigma; taken from their class" in terrafusion("inspect", "log").out
    outcome = terrafusion("replay", "log", "--out", "results")
    assert (outcome.status, outcome.err) == (0, "")
    assert "no usable GNSS fix" not in outcome.out
    assert "131 fixes have no sigma" in outcome.out


@pytest.mark.parametrize("command", ["inspect", "live"])
def test_a_log_that_is_cut_off_says_so(command: str, tmp_path: Path, terrafusion: Terrafusion) -> None:
    whole = ros1_bag(tmp_path / "whole.bag").read_bytes()
    (tmp_path / "cut.bag").write_bytes(whole[: len(whole) * 3 // 4])
    words = ("--vehicle", "husky") if command == "live" else ()
    found = terrafusion(command, tmp_path / "cut.bag", *words)
    assert "cut.bag is cut off" in found.err
    assert "its data end at t = " in found.err
