"""`meta.yaml` of a log folder, strictly; a bag written by this library carries the same keys."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from terrafusion.datasets.core.config import Prepared, structure
from terrafusion.datasets.core.quantity import Quantity, Switch, Whole, Word, shown
from terrafusion.datasets.core.recording import ClockJump, Overrides
from terrafusion.datasets.core.sensors import DRIVES
from terrafusion.datasets.core.yaml_file import read_yaml

TRUTH_CHANNELS = ("position", "yaw", "orientation", "velocity")
MAX_START_NS = 8 * 10**18
"""Leaves room for any t_s in int64."""
_Metres = Annotated[tuple[float, float, float], Quantity("m", -20.0, 20.0, size=3)]


@dataclass(frozen=True, kw_only=True)
class DescriptionFile:
    """Keys of `meta.yaml` that a column map may have, too."""

    name: str | None = None
    vehicle: str | None = None
    terrain: str | None = None
    description: str | None = None
    licence: str | None = None
    source: str | None = None
    terrain_source: str | None = None
    imu_frame_id: str | None = None
    wheel_radius_m: Annotated[float, Quantity("m", 0.01, 2.0)] | None = None
    track_m: Annotated[float, Quantity("m", 0.05, 10.0)] | None = None
    drive: Annotated[str, Word(DRIVES)] | None = None
    wheelbase_m: Annotated[float, Quantity("m", 0.05, 10.0)] | None = None
    steering_ratio: Annotated[float, Quantity("", 0.05, 100.0)] | None = None
    antenna_m: _Metres | None = None
    imu_m: _Metres | None = None
    datum: (
        tuple[
            Annotated[float, Quantity("deg of latitude", -90.0, 90.0)],
            Annotated[float, Quantity("deg of longitude", -180.0, 180.0)],
            Annotated[float, Quantity("m of height", -1000.0, 20000.0)],
        ]
        | None
    ) = None
    truth_channels: tuple[str, ...] | None = None
    truth_frame: Annotated[str, Word(("base", "antenna"))] = "base"


@dataclass(frozen=True)
class ClockJumpFile:
    """A jump of a channel's clock that was repaired."""

    channel: str
    t_ns: Annotated[int, Whole("", -(2.0**63), 2.0**63 - 1024, meaning="whole nanoseconds")]
    step_s: Annotated[float, Quantity("s", -1e10, 1e10)]


def _listed(raw: Any) -> Any:
    return raw if isinstance(raw, (list, tuple)) else [raw]


@dataclass(frozen=True, kw_only=True)
class MetaFile(DescriptionFile):
    """Keys of `meta.yaml`."""

    start_ns: Annotated[
        int,
        Whole("", 0, MAX_START_NS, meaning="the Unix time of t_s = 0 in whole nanoseconds (0 when unknown)"),
    ]
    notes: tuple[str, ...] = ()
    clock_jumps: Annotated[tuple[ClockJumpFile, ...], Prepared(_listed, {"type": "object"})] = ()
    keep_empty: Switch = False


KEYS = tuple(field.name for field in dataclasses.fields(MetaFile))
TEXT_KEYS = KEYS[:8]


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
    given = {key: value for key, value in content.items() if value is not None}
    file = structure(MetaFile, given, file=path)
    strange = [shown(name) for name in file.truth_channels or () if name not in TRUTH_CHANNELS]
    remark = (
        f"meta.yaml: truth channels {', '.join(strange)} are not used; known are {', '.join(TRUTH_CHANNELS)}"
    )
    return Meta(
        start_ns=file.start_ns,
        texts={key: getattr(file, key) for key in TEXT_KEYS if key in given},
        overrides=Overrides(**{key.name: getattr(file, key.name) for key in dataclasses.fields(Overrides)}),
        datum=file.datum,
        truth_channels=file.truth_channels,
        truth_frame=file.truth_frame,
        notes=file.notes,
        clock_jumps=tuple(ClockJump(jump.channel, jump.t_ns, jump.step_s) for jump in file.clock_jumps),
        keep_empty=file.keep_empty,
        remarks=(remark,) if strange else (),
    )
