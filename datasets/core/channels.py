"""The channels of a recording: numpy arrays whose first axis is time, each channel on its own clock.

`t_ns` is int64 nanoseconds (Unix epoch for real logs) and never decreases. Unknown numbers are NaN.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core import messages
from terrafusion.datasets.core.arrays import Array, TimeRows, TimesNs
from terrafusion.datasets.core.errors import DataError

if TYPE_CHECKING:
    import pandas as pd


TERRAINS = ("asphalt", "gravel", "grass", "medium_sand", "loose_sand", "ploughed_soil", "mud", "snow")
"""Terrain classes by name; `unknown` is none of them."""


class Fix(IntEnum):
    """GNSS fix classes, in rising quality."""

    NONE = 0
    SINGLE = 1
    DGPS = 2
    FLOAT = 3
    FIXED = 4


@dataclass(frozen=True, eq=False, repr=False)
class Channel(TimeRows):
    """What all channels share: a clock and rows."""

    name: ClassVar[str] = ""
    COLUMNS: ClassVar[dict[str, tuple[str, ...]]] = {}
    """Columns of the log folder by field, (N,) or (N, k)."""
    SAMPLE: ClassVar[type[messages.Message]]
    """Type of the channel's messages, whose fields are those of the channel."""
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

    def _check_width(self, field: str, width: int) -> None:
        values = getattr(self, field)
        if values is not None and values.shape != (len(self), width):
            raise ValueError(f"{self.name}: {field} has shape {values.shape}, not ({len(self)}, {width})")

    def samples(self) -> Iterator[messages.Message]:
        """One message a row, in order of time."""
        fields = (getattr(self, spec.name) for spec in dataclasses.fields(self))
        make: Any = self.SAMPLE
        return map(make, *map(_cells, fields))

    def columns(self) -> dict[str, NDArray[Any]]:
        """Columns of the log folder without `t_s`; absent ones left out."""
        table: dict[str, NDArray[Any]] = {}
        for field, names in self.COLUMNS.items():
            values = getattr(self, field)
            if values is not None:
                table |= zip(names, [values] if values.ndim == 1 else values.T, strict=True)
        return table

    def to_pandas(self) -> pd.DataFrame:
        """The columns of the log folder, indexed by `t_ns`."""
        import pandas as pd

        return pd.DataFrame(self.columns(), index=pd.Index(self.t_ns, name="t_ns"))


def _cells(values: Any) -> Iterable[Any]:
    """A field row by row; what is no array is the same in all rows."""
    if not isinstance(values, np.ndarray):
        return itertools.repeat(values)
    return values.tolist() if values.ndim == 1 else values


@dataclass(frozen=True, eq=False, repr=False)
class Command(Channel):
    """Commanded body twist: `v_mps` (N,), `yaw_rate_radps` (N,)."""

    name: ClassVar[str] = "command"
    COLUMNS: ClassVar[dict[str, tuple[str, ...]]] = {
        "v_mps": ("v_mps",),
        "yaw_rate_radps": ("yaw_rate_radps",),
    }
    SAMPLE = messages.CommandSample
    v_mps: Array
    yaw_rate_radps: Array


@dataclass(frozen=True, eq=False, repr=False)
class Wheels(Channel):
    """Wheel speeds `speed` (N, k) of the wheels or sides `names` in `unit` "radps" or "mps".

    `names` is one of the tuples of `LAYOUTS`; ("speed",) is the mean of both
    sides, without information on yaw. `angle_rad` (N, k) is the accumulated
    wheel angle where the log has it.
    """

    name: ClassVar[str] = "wheels"
    SAMPLE = messages.WheelSample
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
        self._check_width("speed", len(self.names))
        self._check_width("angle_rad", len(self.names))

    def columns(self) -> dict[str, NDArray[Any]]:
        table: dict[str, NDArray[Any]] = {
            f"{n}_{self.unit}": self.speed[:, i] for i, n in enumerate(self.names)
        }
        if self.angle_rad is not None:
            table |= {f"{n}_rad": self.angle_rad[:, i] for i, n in enumerate(self.names)}
        return table

    def has_sides(self) -> bool:
        """Whether left and right are measured separately."""
        return len(self.names) > 1

    def side_speeds_mps(self, wheel_radius_m: float) -> Array:
        """Circumferential speed (N, 2) of left and right, m/s; both equal where sides are unknown."""
        return messages.sides(self.speed * (wheel_radius_m if self.unit == "radps" else 1.0), self.names)


@dataclass(frozen=True, eq=False, repr=False)
class Imu(Channel):
    """Angular rate `gyro_radps` (N, 3) and specific force `accel_mps2` (N, 3), body axes.

    At rest on level ground the specific force is (0, 0, +g). Axes the log does
    not have are NaN throughout.
    """

    name: ClassVar[str] = "imu"
    COLUMNS: ClassVar[dict[str, tuple[str, ...]]] = {
        "gyro_radps": ("gyro_x_radps", "gyro_y_radps", "gyro_z_radps"),
        "accel_mps2": ("accel_x_mps2", "accel_y_mps2", "accel_z_mps2"),
    }
    SAMPLE = messages.ImuSample
    gyro_radps: Array
    accel_mps2: Array

    def columns(self) -> dict[str, NDArray[Any]]:
        return {name: axis for name, axis in super().columns().items() if not np.isnan(axis).all()}

    def has_gyro(self) -> bool:
        return not np.isnan(self.gyro_radps).all(axis=0).any()

    def has_accel(self) -> bool:
        return not np.isnan(self.accel_mps2).all(axis=0).any()


@dataclass(frozen=True, eq=False, repr=False)
class Gnss(Channel):
    """Antenna position `enu_m` (N, 3) about the recording's datum with 1-sigma `sigma_enu_m` (N, 3).

    `velocity_enu_mps` (N, 3) and `sigma_v_mps` (N,) where the receiver reports
    them; `fix` (N,) holds `Fix` values.
    """

    name: ClassVar[str] = "gnss"
    SAMPLE = messages.GnssSample
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

    def samples(self) -> Iterator[messages.Message]:
        """One message a row."""
        if self.sigma_v_mps is not None:
            return super().samples()
        return dataclasses.replace(self, sigma_v_mps=np.full(len(self), np.nan)).samples()


@dataclass(frozen=True, eq=False, repr=False)
class Motor(Channel):
    """Motor currents `current_a` (N, 2) left and right, and voltages `voltage_v` (N, 2) where known."""

    name: ClassVar[str] = "motor"
    COLUMNS: ClassVar[dict[str, tuple[str, ...]]] = {
        "current_a": ("left_a", "right_a"),
        "voltage_v": ("left_v", "right_v"),
    }
    SAMPLE = messages.MotorSample
    current_a: Array
    voltage_v: Array | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Steering(Channel):
    """Steering angles `angle_rad` (N, k) of `names`, rad, positive to the left.

    `names` is one of the tuples of `LAYOUTS`: ("angle",) is the mean of the front wheels, ("front", "rear")
    are the means of each axle, ("steering_wheel",) is the steering wheel, whose angle is the front wheels'
    times a steering ratio.
    """

    name: ClassVar[str] = "steering"
    SAMPLE = messages.SteeringSample
    LAYOUTS: ClassVar[tuple[tuple[str, ...], ...]] = (
        ("angle",),
        ("front", "rear"),
        Wheels.LAYOUTS[1],
        ("steering_wheel",),
    )
    angle_rad: Array
    names: tuple[str, ...]

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.names not in self.LAYOUTS:
            raise ValueError(f"steering: unknown layout {self.names}")
        self._check_width("angle_rad", len(self.names))

    def columns(self) -> dict[str, NDArray[Any]]:
        return {f"{name}_rad": self.angle_rad[:, i] for i, name in enumerate(self.names)}

    def drive(self) -> str:
        """The drive that the angles suggest."""
        return "four_wheel_steer" if self.axle_angles_rad()[:, 1].any() else "ackermann"

    def axle_angles_rad(self, steering_ratio: float = 1.0) -> Array:
        """Mean angle (N, 2) of front and rear wheels, rad; `steering_ratio` is used for a steering wheel."""
        return messages.axles(self.angle_rad, self.names, steering_ratio)


@dataclass(frozen=True, eq=False, repr=False)
class Barometer(Channel):
    """Static pressure `pressure_pa` (N,), as measured.

    A pressure and no altitude: an altitude needs a sea-level pressure, which logs do not hold.
    """

    name: ClassVar[str] = "barometer"
    COLUMNS: ClassVar[dict[str, tuple[str, ...]]] = {"pressure_pa": ("pressure_pa",)}
    SAMPLE = messages.BarometerSample
    pressure_pa: Array

    POSSIBLE_PA: ClassVar[tuple[float, float]] = (30e3, 110e3)
    """Where robots drive: 9 km high (International Standard Atmosphere) to below the Dead Sea."""


@dataclass(frozen=True, eq=False, repr=False)
class Magnetometer(Channel):
    """Magnetic flux density `field_t` (N, 3), body axes, tesla; at the robot."""

    name: ClassVar[str] = "magnetometer"
    COLUMNS: ClassVar[dict[str, tuple[str, ...]]] = {"field_t": ("field_x_t", "field_y_t", "field_z_t")}
    SAMPLE = messages.MagnetometerSample
    field_t: Array

    POSSIBLE_T: ClassVar[tuple[float, float]] = (15e-6, 80e-6)
    """Size of the field: Earth's is 22 to 67 uT (World Magnetic Model 2020), widened by iron of the robot."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_width("field_t", 3)


@dataclass(frozen=True, eq=False, repr=False)
class Terrain(Channel):
    """Terrain `label` (N,) of str, and `probabilities` (N, k) over `classes` where known.

    `source` is its origin: "annotation", "camera", "detector", "simulation".
    A label holds from its time until the next.
    """

    name: ClassVar[str] = "terrain"
    SAMPLE = messages.TerrainSample
    label: NDArray[Any]
    source: str = "annotation"
    classes: tuple[str, ...] = ()
    probabilities: Array | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_width("probabilities", len(set(self.classes)))

    @classmethod
    def throughout(cls, start_ns: int, label: str) -> Self:
        """One label from the start of a log on."""
        return cls(np.array([start_ns], dtype=np.int64), np.array([label], dtype=object))

    def columns(self) -> dict[str, NDArray[Any]]:
        table: dict[str, NDArray[Any]] = {"label": self.label}
        if self.probabilities is not None:
            table |= {f"p_{name}": self.probabilities[:, i] for i, name in enumerate(self.classes)}
        return table

    def samples(self) -> Iterator[messages.Message]:
        """One message a row."""
        rows = [None] * len(self) if self.probabilities is None else self.probabilities.tolist()
        for t_ns, label, row in zip(self.t_ns.tolist(), self.label, rows, strict=True):
            named = None if row is None else dict(zip(self.classes, row, strict=True))
            yield messages.TerrainSample(t_ns, str(label), self.source, named)
