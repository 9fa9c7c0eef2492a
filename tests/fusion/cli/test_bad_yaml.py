"""Bad `meta.yaml` and vehicle files: a line an error, that names the key, the value and what is allowed."""

from __future__ import annotations

import functools
import re
import shutil
from collections.abc import Callable
from importlib import resources
from pathlib import Path

import pytest

pytestmark = pytest.mark.usefixtures("quick")

Spoil = Callable[[Path], object]


def written(content: str | bytes) -> Spoil:
    """Replace meta.yaml."""
    data = content.encode() if isinstance(content, str) else content
    return lambda log: (log / "meta.yaml").write_bytes(data)


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

BAD_META: dict[str, tuple[Spoil, tuple[str, ...]]] = {
    "latin-1 in meta": (
        written(b"start_ns: 0\ndescription: Stra\xdfe\n"),
        ("meta.yaml", "UTF-8"),
    ),
    "meta is a list": (written("- start_ns: 0\n"), ("meta.yaml", "mapping")),
    "meta is a word": (written("hello\n"), ("meta.yaml", "mapping")),
    "meta is empty": (written(""), ("meta.yaml", "'start_ns' is missing", "Unix time")),
    "meta breaks off": (written("start_ns: [1"), ("meta.yaml", "not valid YAML")),
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
    "meta: aliases that blow up": (meta(f"{BOMB}]", drop="description"), ("meta.yaml", "aliases")),
    "meta: alias of itself": (
        meta("description: &a [*a]", drop="description"),
        ("meta.yaml", "line", "inside itself"),
    ),
    "meta: merge keys": (
        meta("a: &a {b: 1}", "c: {<<: *a}"),
        ("meta.yaml", "line", "merge keys '<<' are not allowed"),
    ),
    "meta: 10 000 brackets": (meta("track_m: " + "[" * 10_000), ("meta.yaml", "not valid YAML")),
    "meta: 10 MB": (written("start_ns: 0\n" * 900_000), ("meta.yaml",)),
    "meta: a tag that would run": (
        meta("track_m: !!python/object/apply:os.system [touch owned]"),
        ("meta.yaml", "not valid YAML"),
    ),
}


@pytest.mark.parametrize("case", BAD_META)
def test_bad_meta(case: str, good_log: Path, tmp_path: Path, terrafusion) -> None:
    spoil, words = BAD_META[case]
    shutil.copytree(good_log, tmp_path / "log")
    spoil(tmp_path / "log")
    assert terrafusion("replay", "log", "--out", "results").refused(*words)
    assert not (tmp_path / "results").exists()
    assert not (tmp_path / "owned").exists()


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
        ("odometry.wheel_radius_m", "no source", "add source: data sheet, measurement or assumed"),
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
    "aliases that blow up": (r"^description: .*$", f"{BOMB}]", ("line 3", "aliases")),
}


@pytest.mark.parametrize("case", BAD_VEHICLES)
def test_bad_vehicle_file(case: str, good_log: Path, tmp_path: Path, terrafusion) -> None:
    pattern, replacement, words = BAD_VEHICLES[case]
    spoilt, count = re.subn(pattern, lambda _: replacement, vehicle_text(), count=1, flags=re.MULTILINE)
    assert count == 1, "the vehicle file has changed: adapt the case"
    (tmp_path / "my.yaml").write_text(spoilt)
    assert terrafusion("replay", good_log, "--vehicle", "my.yaml", "--out", "results").refused(
        "my.yaml", *words
    )
