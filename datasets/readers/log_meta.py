"""`meta.yaml` of a log folder, strictly; a bag written by this library carries the same keys."""

from __future__ import annotations

import difflib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from terrafusion.datasets.core.config import Quantity, checked_number, read_yaml, shown
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.recording import ClockJump, Overrides

TEXT_KEYS = (
    "name",
    "vehicle",
    "terrain",
    "description",
    "licence",
    "source",
    "terrain_source",
    "imu_frame_id",
)
NUMBER_KEYS = {
    "wheel_radius_m": Quantity("m", 0.01, 2.0),
    "track_m": Quantity("m", 0.05, 10.0),
    "antenna_m": Quantity("m", -20.0, 20.0, size=3),
    "imu_m": Quantity("m", -20.0, 20.0, size=3),
}
DATUM = (
    ("latitude", Quantity("deg", -90.0, 90.0)),
    ("longitude", Quantity("deg", -180.0, 180.0)),
    ("height", Quantity("m", -1000.0, 20000.0)),
)
TRUTH_CHANNELS = ("position", "yaw", "orientation", "velocity")
TRUTH_FRAMES = ("base", "antenna")
HISTORY_KEYS = ("notes", "clock_jumps", "keep_empty")
KEYS = ("start_ns", *TEXT_KEYS, *NUMBER_KEYS, "datum", "truth_channels", "truth_frame", *HISTORY_KEYS)
MAX_START_NS = 8 * 10**18
"""Leaves room for any t_s in int64."""


@dataclass(frozen=True)
class Meta:
    """What `meta.yaml` says.

    `truth_channels` is None where the file does not tell, `notes` are those of the log, `remarks`
    what was odd about the file; with `keep_empty` rows and tables without a value are kept.
    """

    start_ns: int
    texts: dict[str, str] = field(default_factory=dict)
    overrides: Overrides = field(default_factory=Overrides)
    datum: tuple[float, float, float] | None = None
    truth_channels: tuple[str, ...] | None = None
    truth_frame: str = "base"
    notes: tuple[str, ...] = ()
    clock_jumps: tuple[ClockJump, ...] = ()
    keep_empty: bool = False
    remarks: tuple[str, ...] = ()


def read_meta(path: Path) -> Meta:
    """Read and check `meta.yaml`.

    Raises:
        ConfigError: not YAML, unknown key, wrong type, value out of range; names key and remedy.
    """
    return parse_meta(read_yaml(path), path)


def parse_meta(content: dict[str, Any], path: Path) -> Meta:
    """Check the keys and values of `meta.yaml`; errors as in `read_meta`, about the file `path`."""
    raw = {key: value for key, value in content.items() if value is not None}
    for key in raw:
        if key not in KEYS:
            raise _unknown_key(path, key)
    numbers: dict[str, Any] = {
        key: checked_number(raw[key], quantity, file=path, key=key)
        for key, quantity in NUMBER_KEYS.items()
        if key in raw
    }
    channels, remarks = _truth_channels(path, raw)
    return Meta(
        start_ns=_start_ns(path, raw),
        texts={key: _text(path, key, raw[key]) for key in TEXT_KEYS if key in raw},
        overrides=Overrides(**numbers),
        datum=_datum(path, raw["datum"]) if "datum" in raw else None,
        truth_channels=channels,
        truth_frame=_truth_frame(path, raw.get("truth_frame", "base")),
        notes=tuple(_texts(path, raw, "notes")),
        clock_jumps=_clock_jumps(path, raw.get("clock_jumps", [])),
        keep_empty=_flag(path, raw, "keep_empty"),
        remarks=remarks,
    )


def _unknown_key(path: Path, key: str) -> ConfigError:
    stem = key.rsplit("_", 1)[0]
    same = [k for k in NUMBER_KEYS if k.rsplit("_", 1)[0] == stem or k == f"{key}_m"]
    close = difflib.get_close_matches(key, KEYS, n=1)
    if same:
        remedy = f"write '{same[0]}', in metres (the unit is part of the name)"
    else:
        remedy = (f"did you mean '{close[0]}'? " if close else "") + f"known: {', '.join(KEYS)}"
    return ConfigError(f"unknown key '{shown(key)}'", file=path, remedy=remedy)


def _start_ns(path: Path, raw: dict[str, Any]) -> int:
    value = raw.get("start_ns")
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= MAX_START_NS:
        said = f"'start_ns' is '{shown(value)}'" if "start_ns" in raw else "'start_ns' is missing"
        raise ConfigError(
            said, file=path, remedy="give the Unix time of t_s = 0 in whole nanoseconds (0 when unknown)"
        )
    return value


def _text(path: Path, key: str, value: Any) -> str:
    if not isinstance(value, str):
        raise ConfigError(f"'{key}' is '{shown(value)}'", file=path, remedy="give a text, in quotes")
    return value


def _datum(path: Path, value: Any) -> tuple[float, float, float]:
    if not isinstance(value, list) or len(value) != 3:
        raise ConfigError(
            f"'datum' is '{shown(value)}'", file=path, remedy="give [latitude deg, longitude deg, height m]"
        )
    lat, lon, height = (
        checked_number(number, quantity, file=path, key=f"datum {name}")
        for number, (name, quantity) in zip(value, DATUM, strict=True)
    )
    return (float(lat), float(lon), float(height))  # type: ignore[arg-type]


def _truth_channels(path: Path, raw: dict[str, Any]) -> tuple[tuple[str, ...] | None, tuple[str, ...]]:
    if "truth_channels" not in raw:
        return None, ()
    value = _texts(path, raw, "truth_channels", f"give a list from {', '.join(TRUTH_CHANNELS)}")
    strange = [name for name in value if name not in TRUTH_CHANNELS]
    named = ", ".join(shown(name) for name in strange)
    remarks = (f"meta.yaml: truth channels {named} are not used; known are {', '.join(TRUTH_CHANNELS)}",)
    return tuple(value), remarks if strange else ()


def _texts(path: Path, raw: dict[str, Any], key: str, remedy: str = "give a list of texts") -> list[str]:
    value = raw.get(key, [])
    if not isinstance(value, list) or not all(isinstance(text, str) for text in value):
        raise ConfigError(f"'{key}' is '{shown(value)}'", file=path, remedy=remedy)
    return value


def _flag(path: Path, raw: dict[str, Any], key: str) -> bool:
    value = raw.get(key, False)
    if not isinstance(value, bool):
        raise ConfigError(f"'{key}' is '{shown(value)}'", file=path, remedy="give true or false")
    return value


def _clock_jumps(path: Path, value: Any) -> tuple[ClockJump, ...]:
    entries = value if isinstance(value, list) else [value]
    for entry in entries:
        if not (
            isinstance(entry, dict)
            and entry.keys() == {"channel", "t_ns", "step_s"}
            and isinstance(entry["channel"], str)
            and type(entry["t_ns"]) is int
            and abs(entry["t_ns"]) < 2**63
            and type(entry["step_s"]) in (int, float)
            and abs(entry["step_s"]) < 1e10
        ):
            raise ConfigError(
                f"'clock_jumps' has the entry '{shown(entry)}'",
                file=path,
                remedy="give entries of channel, t_ns (whole nanoseconds) and step_s (seconds)",
            )
    return tuple(ClockJump(e["channel"], e["t_ns"], float(e["step_s"])) for e in entries)


def _truth_frame(path: Path, value: Any) -> str:
    if value not in TRUTH_FRAMES:
        raise ConfigError(
            f"'truth_frame' is '{shown(value)}'", file=path, remedy=f"give one of {', '.join(TRUTH_FRAMES)}"
        )
    return str(value)
