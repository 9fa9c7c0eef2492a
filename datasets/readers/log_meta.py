"""`meta.yaml` of a log folder; a bag written by this library carries the same keys.

Known keys are read strictly, any others are kept as they are and named in one remark.
"""

import dataclasses
import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from terrafusion.datasets.core.config import Prepared, structure
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.json_text import finite
from terrafusion.datasets.core.quantity import Quantity, Switch, Whole, Word, shown
from terrafusion.datasets.core.recording import ClockJump, Overrides
from terrafusion.datasets.core.scratch import UNFINISHED
from terrafusion.datasets.core.sensors import DRIVES

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


def _listed(raw: Any) -> Any:
    return raw if isinstance(raw, (list, tuple)) else [raw]


@dataclass(frozen=True, kw_only=True)
class MetaFile(DescriptionFile):
    """Keys of `meta.yaml`."""

    start_ns: Annotated[
        int,
        Whole("", 0, MAX_START_NS, meaning="the Unix time of t_s = 0 in whole nanoseconds (0 when unknown)"),
    ]
    unturned: tuple[Annotated[str, Word(("imu", "magnetometer"))], ...] = ()
    notes: tuple[str, ...] = ()
    clock_jumps: Annotated[tuple[ClockJump, ...], Prepared(_listed, {"type": "object"})] = ()
    keep_empty: Switch = False


KEYS = tuple(field.name for field in dataclasses.fields(MetaFile))
OTHER_UNITS = ("mm", "cm", "km", "in", "ft")
"""Lengths in these are refused: left out, the vehicle's own number would take their place unseen."""


@dataclass(frozen=True, kw_only=True)
class Meta(MetaFile):
    """What `meta.yaml` says: its keys, and what it is worth.

    `truth_channels` is None where the file does not tell, `notes` are those of the log, `remarks`
    what was odd about the file, `metadata` its unknown keys; with `keep_empty` rows and tables without a
    value are kept.
    """

    remarks: tuple[str, ...] = ()
    metadata: dict[str, Any] = field(default_factory=dict)

    def overrides(self) -> Overrides:
        """The robot's geometry, as far as the log states it."""
        return Overrides(**{key.name: getattr(self, key.name) for key in dataclasses.fields(Overrides)})


def parse_meta(content: dict[str, Any], path: Path) -> Meta:
    """The keys of `meta.yaml`, as read from the file `path`.

    Raises:
        ConfigError: missing key, wrong type, value out of range; names key and remedy.
    """
    given = {key: value for key, value in content.items() if value is not None}
    if given.keys() == {UNFINISHED}:
        raise ConfigError("the log was not written to its end", file=path, remedy="write it again")
    unknown = {key: value for key, value in given.items() if _is_extra(key, given)}
    file = structure(MetaFile, {k: value for k, value in given.items() if k not in unknown}, file=path)
    strange = [shown(name) for name in file.truth_channels or () if name not in TRUTH_CHANNELS]
    remarks = []
    if unknown:
        named = ", ".join(map(_named, unknown))
        remarks.append(f"warning: meta.yaml: unknown keys are kept, but not used: {named}")
    if strange:
        known = ", ".join(TRUTH_CHANNELS)
        remarks.append(f"meta.yaml: truth channels {', '.join(strange)} are not used; known are {known}")
    return Meta(**vars(file), remarks=tuple(remarks), metadata=finite(unknown))


def _is_extra(key: str, given: Mapping[str, Any]) -> bool:
    """Whether a key is neither known, nor `start_ns` misspelt, nor a length in another unit."""
    stem, _, unit = key.rpartition("_")
    if "start_ns" not in given and difflib.get_close_matches(key, ["start_ns"]):
        return False
    return key not in KEYS and not (unit in OTHER_UNITS and f"{stem}_m" in KEYS)


def _named(key: str) -> str:
    meant = difflib.get_close_matches(key, KEYS, n=1, cutoff=0.8)
    return f"{shown(key)} (did you mean {meant[0]}?)" if meant else shown(key)
