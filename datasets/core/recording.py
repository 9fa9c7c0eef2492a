"""`Recording`: one drive, real or simulated, as channels on their own clocks.

Every channel holds numpy arrays whose first axis is time; `t_ns` is int64
nanoseconds (Unix epoch for real logs) and never decreases. Unknown numbers are
NaN, absent channels are None. Reality and twin emit this same type.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from enum import IntEnum
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.trajectory import Trajectory

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]
TimesNs = NDArray[np.int64]

TERRAINS = ("asphalt", "gravel", "grass", "medium_sand", "loose_sand", "ploughed_soil", "mud", "snow")
"""Terrain classes by name; `unknown` stands for none of them."""


class Fix(IntEnum):
    """GNSS fix classes, in rising quality."""

    NONE = 0
    SINGLE = 1
    DGPS = 2
    FLOAT = 3
    FIXED = 4


@dataclass(frozen=True, eq=False)
class Channel:
    """What all channels share: a clock and rows."""

    name: ClassVar[str] = ""
    t_ns: TimesNs

    def __post_init__(self) -> None:
        t = np.asarray(self.t_ns)
        if t.ndim != 1 or t.dtype != np.int64:
            raise TypeError(f"{self.name}: t_ns must be a 1-D int64 array, not {t.dtype} {t.shape}")
        for spec in dataclasses.fields(self):
            value = getattr(self, spec.name)
            if isinstance(value, np.ndarray) and len(value) != len(t):
                raise ValueError(f"{self.name}.{spec.name} has {len(value)} rows for {len(t)} times")
        back = np.flatnonzero(t[1:] < t[:-1])  # a difference could overflow
        if back.size:
            i = int(back[0])
            raise DataError(
                f"time runs backwards by {(int(t[i]) - int(t[i + 1])) * 1e-9:.6f} s after row {i}",
                channel=self.name,
                time_s=(int(t[i]) - int(t[0])) * 1e-9,
                remedy="sort the rows or split the log at the clock jump",
            )

    def __len__(self) -> int:
        return len(self.t_ns)

    def select(self, rows: Any) -> Self:
        """The same channel with the rows of a boolean mask, slice or index array."""
        changed = {
            spec.name: getattr(self, spec.name)[rows]
            for spec in dataclasses.fields(self)
            if isinstance(getattr(self, spec.name), np.ndarray)
        }
        return dataclasses.replace(self, **changed)

    def between(self, start_ns: int, end_ns: int) -> Self:
        """Rows with start_ns <= t < end_ns."""
        first, last = np.searchsorted(self.t_ns, [start_ns, end_ns], side="left")
        return self.select(slice(int(first), int(last)))

    def columns(self) -> dict[str, NDArray[Any]]:
        """Columns of the log folder (see docs/conventions.md) without `t_s`; absent ones left out."""
        raise TypeError(f"{type(self).__name__} has no table form")

    def to_pandas(self) -> pd.DataFrame:
        """The columns of the log folder, indexed by `t_ns`."""
        import pandas as pd

        return pd.DataFrame(self.columns(), index=pd.Index(self.t_ns, name="t_ns"))


def _named(values: Array, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
    return {name: values[:, i] for i, name in enumerate(names) if not np.isnan(values[:, i]).all()}


@dataclass(frozen=True, eq=False)
class Command(Channel):
    """Commanded body twist: `v_mps` (N,), `yaw_rate_radps` (N,)."""

    name: ClassVar[str] = "command"
    v_mps: Array
    yaw_rate_radps: Array

    def columns(self) -> dict[str, NDArray[Any]]:
        return {"v_mps": self.v_mps, "yaw_rate_radps": self.yaw_rate_radps}


@dataclass(frozen=True, eq=False)
class Wheels(Channel):
    """Wheel speeds `speed` (N, k) of the wheels or sides `names` in `unit` "radps" or "mps".

    `names` is one of the tuples of `LAYOUTS`; ("speed",) is the mean of both
    sides and says nothing about yaw. `angle_rad` (N, k) is the accumulated
    wheel angle where the log has it.
    """

    name: ClassVar[str] = "wheels"
    LAYOUTS: ClassVar[tuple[tuple[str, ...], ...]] = (
        ("left", "right"),
        ("front_left", "front_right", "rear_left", "rear_right"),
        ("speed",),
    )
    speed: Array
    names: tuple[str, ...]
    unit: str
    angle_rad: Array | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.names not in self.LAYOUTS or self.unit not in ("radps", "mps"):
            raise ValueError(f"wheels: unknown layout {self.names} in {self.unit}")
        if self.speed.shape != (len(self), len(self.names)):
            raise ValueError(f"wheels: speed has shape {self.speed.shape} for {len(self.names)} wheels")
        if self.angle_rad is not None and self.angle_rad.shape != self.speed.shape:
            raise ValueError(f"wheels: angle_rad has shape {self.angle_rad.shape}, speed {self.speed.shape}")

    def columns(self) -> dict[str, NDArray[Any]]:
        table: dict[str, NDArray[Any]] = {
            f"{n}_{self.unit}": self.speed[:, i] for i, n in enumerate(self.names)
        }
        if self.angle_rad is not None:
            table |= {f"{n}_rad": self.angle_rad[:, i] for i, n in enumerate(self.names)}
        return table

    def has_sides(self) -> bool:
        """Whether left and right are told apart."""
        return len(self.names) > 1

    def side_speeds_mps(self, wheel_radius_m: float) -> Array:
        """Circumferential speed (N, 2) of left and right, m/s; both equal where sides are unknown."""
        metres = self.speed * (wheel_radius_m if self.unit == "radps" else 1.0)
        if len(self.names) == 1:
            return np.repeat(metres, 2, axis=1)
        left = [i for i, n in enumerate(self.names) if n.endswith("left")]
        right = [i for i, n in enumerate(self.names) if n.endswith("right")]
        return np.stack([metres[:, left].mean(axis=1), metres[:, right].mean(axis=1)], axis=1)


@dataclass(frozen=True, eq=False)
class Imu(Channel):
    """Angular rate `gyro_radps` (N, 3) and specific force `accel_mps2` (N, 3), body axes.

    At rest on level ground the specific force is (0, 0, +g). Axes the log does
    not have are NaN throughout.
    """

    name: ClassVar[str] = "imu"
    gyro_radps: Array
    accel_mps2: Array

    def columns(self) -> dict[str, NDArray[Any]]:
        gyro = _named(self.gyro_radps, ("gyro_x_radps", "gyro_y_radps", "gyro_z_radps"))
        return gyro | _named(self.accel_mps2, ("accel_x_mps2", "accel_y_mps2", "accel_z_mps2"))

    def has_gyro(self) -> bool:
        return not np.isnan(self.gyro_radps).all(axis=0).any()

    def has_accel(self) -> bool:
        return not np.isnan(self.accel_mps2).all(axis=0).any()


@dataclass(frozen=True, eq=False)
class Gnss(Channel):
    """Antenna position `enu_m` (N, 3) about the recording's datum with 1-sigma `sigma_enu_m` (N, 3).

    `velocity_enu_mps` (N, 3) and `sigma_v_mps` (N,) where the receiver reports
    them; `fix` (N,) holds `Fix` values.
    """

    name: ClassVar[str] = "gnss"
    enu_m: Array
    sigma_enu_m: Array
    fix: NDArray[np.uint8]
    velocity_enu_mps: Array | None = None
    sigma_v_mps: Array | None = None

    def columns(self) -> dict[str, NDArray[Any]]:
        table: dict[str, NDArray[Any]] = {
            "east_m": self.enu_m[:, 0],
            "north_m": self.enu_m[:, 1],
            "sigma_e_m": self.sigma_enu_m[:, 0],
            "sigma_n_m": self.sigma_enu_m[:, 1],
        }
        if not (np.isnan(self.enu_m[:, 2]).all() and np.isnan(self.sigma_enu_m[:, 2]).all()):
            table |= {"up_m": self.enu_m[:, 2], "sigma_u_m": self.sigma_enu_m[:, 2]}
        if self.velocity_enu_mps is not None:
            table |= {f"v_{axis}_mps": self.velocity_enu_mps[:, i] for i, axis in enumerate("enu")}
        if self.sigma_v_mps is not None:
            table["sigma_v_mps"] = self.sigma_v_mps
        table["fix"] = np.array([Fix(f).name.lower() for f in self.fix], dtype=object)
        return table


@dataclass(frozen=True, eq=False)
class Motor(Channel):
    """Motor currents `current_a` (N, 2) left and right, and voltages `voltage_v` (N, 2) where known."""

    name: ClassVar[str] = "motor"
    current_a: Array
    voltage_v: Array | None = None

    def columns(self) -> dict[str, NDArray[Any]]:
        table: dict[str, NDArray[Any]] = {"left_a": self.current_a[:, 0], "right_a": self.current_a[:, 1]}
        if self.voltage_v is not None:
            table |= {"left_v": self.voltage_v[:, 0], "right_v": self.voltage_v[:, 1]}
        return table


@dataclass(frozen=True, eq=False)
class Barometer(Channel):
    """Static pressure `pressure_pa` (N,), as measured.

    A pressure and no altitude: an altitude needs a sea-level pressure, which logs do not hold.
    """

    name: ClassVar[str] = "barometer"
    pressure_pa: Array

    def columns(self) -> dict[str, NDArray[Any]]:
        return {"pressure_pa": self.pressure_pa}


@dataclass(frozen=True, eq=False)
class Magnetometer(Channel):
    """Magnetic flux density `field_t` (N, 3), body axes, tesla; the field that the robot stands in."""

    name: ClassVar[str] = "magnetometer"
    field_t: Array

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.field_t.shape != (len(self), 3):
            raise ValueError(f"magnetometer: field_t has shape {self.field_t.shape}, not ({len(self)}, 3)")

    def columns(self) -> dict[str, NDArray[Any]]:
        return {f"field_{axis}_t": self.field_t[:, i] for i, axis in enumerate("xyz")}


@dataclass(frozen=True, eq=False)
class Terrain(Channel):
    """Terrain `label` (N,) of str, and `probabilities` (N, k) over `classes` where known.

    `source` tells who says so: "annotation", "camera", "detector", "simulation".
    A label holds from its time until the next.
    """

    name: ClassVar[str] = "terrain"
    label: NDArray[Any]
    source: str = "annotation"
    classes: tuple[str, ...] = ()
    probabilities: Array | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        wanted = (len(self), len(set(self.classes)))
        if self.probabilities is not None and self.probabilities.shape != wanted:
            raise ValueError(f"terrain: probabilities have shape {self.probabilities.shape}, not {wanted}")

    def columns(self) -> dict[str, NDArray[Any]]:
        table: dict[str, NDArray[Any]] = {"label": self.label}
        if self.probabilities is not None:
            table |= {f"p_{name}": self.probabilities[:, i] for i, name in enumerate(self.classes)}
        return table


@dataclass(frozen=True)
class Overrides:
    """What a log says of its robot that differs from the vehicle file (None: nothing)."""

    wheel_radius_m: float | None = None
    track_m: float | None = None
    antenna_m: tuple[float, float, float] | None = None
    imu_m: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class ClockJump:
    """A step of a channel's clock that was taken out on reading, because it was asked for.

    From `t_ns` on (repaired time) the log's own times stood `step_s` off: negative where time ran back.
    """

    channel: str
    t_ns: int
    step_s: float


@dataclass(frozen=True, eq=False)
class Recording:
    """One drive.

    `datum` is (latitude deg, longitude deg, height m) of the ENU origin where
    it is known. `truth_channels` names what the truth really holds ("position",
    "yaw", "orientation", "velocity"); `truth_frame` is "base" or "antenna".
    `imu_frame_id` is the frame the log gives its IMU, where it gives one. `notes` records what a
    reader assumed or left out, in sentences; `clock_jumps` what it repaired in the times.
    """

    name: str
    start_ns: int
    vehicle: str | None = None
    command: Command | None = None
    wheels: Wheels | None = None
    imu: Imu | None = None
    gnss: Gnss | None = None
    motor: Motor | None = None
    terrain: Terrain | None = None
    truth: Trajectory | None = None
    datum: tuple[float, float, float] | None = None
    truth_channels: tuple[str, ...] = ()
    truth_frame: str = "base"
    overrides: Overrides = field(default_factory=Overrides)
    description: str = ""
    terrain_name: str = ""
    licence: str = ""
    source: str = ""
    notes: tuple[str, ...] = ()
    clock_jumps: tuple[ClockJump, ...] = ()
    imu_frame_id: str = ""
    barometer: Barometer | None = None
    magnetometer: Magnetometer | None = None

    CHANNELS: ClassVar[tuple[str, ...]] = (
        "command", "wheels", "imu", "gnss", "motor", "terrain", "barometer", "magnetometer",
    )  # fmt: skip

    def channels(self) -> dict[str, Channel]:
        """The channels that are present, by name, without the truth."""
        found = {name: getattr(self, name) for name in self.CHANNELS}
        return {name: channel for name, channel in found.items() if channel is not None and len(channel)}

    def end_ns(self) -> int:
        """Time of the last sample of any channel."""
        ends = [int(channel.t_ns[-1]) for channel in self.channels().values()]
        if self.truth is not None and len(self.truth):
            ends.append(int(self.truth.t_ns[-1]))
        return max(ends, default=self.start_ns)

    def duration_s(self) -> float:
        """Seconds from `start_ns` to the last sample."""
        return (self.end_ns() - self.start_ns) * 1e-9

    def with_notes(self, *notes: str) -> Recording:
        """The same recording with further notes."""
        return dataclasses.replace(self, notes=(*self.notes, *notes))


def differences(a: Any, b: Any, where: str = "") -> list[str]:
    """Names of the fields in which two recordings (or parts of them) differ, [] when they are equal.

    Arrays are compared to the bit, except that any NaN equals any other.
    """
    if dataclasses.is_dataclass(a) and type(a) is type(b):
        names = [spec.name for spec in dataclasses.fields(a)]
        return [
            found
            for name in names
            for found in differences(getattr(a, name), getattr(b, name), f"{where}.{name}".lstrip("."))
        ]
    return [] if _equal(a, b) else [where]


def _equal(a: Any, b: Any) -> bool:
    if not (isinstance(a, np.ndarray) and isinstance(b, np.ndarray)):
        return type(a) is type(b) and bool(a == b)
    if a.shape != b.shape:
        return False
    if a.dtype.kind != "f":
        return bool(a.tolist() == b.tolist())
    return bool(((np.isnan(a) & np.isnan(b)) | ((a == b) & (np.signbit(a) == np.signbit(b)))).all())
