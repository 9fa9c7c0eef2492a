"""`Recording`: one log, real or simulated, as channels on their own clocks.

Absent channels are None. Reality and twin emit this same type.
"""

from __future__ import annotations

import dataclasses
import heapq
from collections.abc import Iterator
from dataclasses import dataclass, field
from operator import itemgetter
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from terrafusion.datasets.core.arrays import TimesNs
from terrafusion.datasets.core.channels import (
    Barometer,
    Channel,
    Command,
    Gnss,
    Imu,
    Magnetometer,
    Motor,
    Steering,
    Terrain,
    Wheels,
)
from terrafusion.datasets.core.messages import Message
from terrafusion.datasets.core.printable import counted
from terrafusion.datasets.core.quantity import Quantity, Whole
from terrafusion.datasets.core.tables import clock_line, clock_rows, clock_table_html
from terrafusion.datasets.core.trajectory import Trajectory

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Overrides:
    """Robot geometry given by a log, which overrides the vehicle file (None: not given)."""

    wheel_radius_m: float | None = None
    track_m: float | None = None
    antenna_m: tuple[float, float, float] | None = None
    imu_m: tuple[float, float, float] | None = None
    drive: str | None = None
    wheelbase_m: float | None = None
    steering_ratio: float | None = None


@dataclass(frozen=True)
class ClockJump:
    """A clock step of a channel that was removed on reading, on request.

    From `t_ns` on (repaired time) the log's own times stood `step_s` off: negative where time ran back.
    """

    channel: str
    t_ns: Annotated[int, Whole("", -(2.0**63), 2.0**63 - 1024, meaning="whole nanoseconds")]
    step_s: Annotated[float, Quantity("s", -1e10, 1e10)]


@dataclass(frozen=True, eq=False, repr=False)
class Recording:
    """One log.

    `datum` is (latitude deg, longitude deg, height m) of the ENU origin where
    it is known. `truth_channels` names what the truth really holds ("position",
    "yaw", "orientation", "velocity"; () for all of it): the rest of `truth` is removed.
    `truth_frame` is "base" or "antenna". `metadata` is what else the log says of itself.
    `imu_frame_id` is the frame the log gives its IMU, where it gives one; `unturned` names the channels that
    are still in its axes, as no vehicle was given to turn them into the body's. `notes` records what a
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
    unturned: tuple[str, ...] = ()
    barometer: Barometer | None = None
    magnetometer: Magnetometer | None = None
    steering: Steering | None = None
    metadata: dict[str, Any] = field(default_factory=dict)

    CHANNELS: ClassVar[tuple[str, ...]] = (
        "command", "wheels", "imu", "gnss", "motor", "terrain", "barometer", "magnetometer",
        "steering",
    )  # fmt: skip

    def __post_init__(self) -> None:
        if self.truth is not None and self.truth_channels:
            object.__setattr__(self, "truth", self.truth.limited_to(self.truth_channels))

    def __repr__(self) -> str:
        return "\n".join([self._title(), *map(clock_line, self._rows())])

    def _repr_html_(self) -> str:
        return clock_table_html(self._title(), self._rows())

    def channels(self) -> dict[str, Channel]:
        """The channels that are present, by name, without the truth."""
        found = {name: getattr(self, name) for name in self.CHANNELS}
        return {name: channel for name, channel in found.items() if channel is not None and len(channel)}

    def clocks(self) -> dict[str, TimesNs]:
        """Times (N,) of the channels that are present, and of the truth, by name."""
        clocks = {name: channel.t_ns for name, channel in self.channels().items()}
        if self.truth is not None and len(self.truth):
            clocks["truth"] = self.truth.t_ns
        return clocks

    def truth_holds(self, channel: str) -> bool:
        """Whether there is a truth, and "position", "yaw", "orientation" or "velocity" of it can be used."""
        there = self.truth is not None and len(self.truth) > 0
        return there and (not self.truth_channels or channel in self.truth_channels)

    def end_ns(self) -> int:
        """Time of the last sample of any channel."""
        return max((int(t_ns[-1]) for t_ns in self.clocks().values()), default=self.start_ns)

    def duration_s(self) -> float:
        """Seconds from `start_ns` to the last sample."""
        return (self.end_ns() - self.start_ns) * 1e-9

    def messages(self) -> Iterator[Message]:
        """Every sample of every channel in order of time, the IMU last of several at one time.

        An estimator that is fed in this order has all else that belongs to an instant when the IMU closes it.
        """
        order = [name for name in self.CHANNELS if name not in ("wheels", "imu")] + ["wheels", "imu"]
        channels = self.channels()
        streams = [channels[name].samples() for name in order if name in channels]
        return heapq.merge(*streams, key=itemgetter(0))

    def to_pandas(self) -> dict[str, pd.DataFrame]:
        """A table for each channel that is present, and "truth", indexed by `t_ns`.

        Channels keep their own clocks: join two with `pandas.merge_asof`.
        """
        tables = {name: channel.to_pandas() for name, channel in self.channels().items()}
        if self.truth is not None and len(self.truth):
            tables["truth"] = self.truth.to_pandas()
        return tables

    def _title(self) -> str:
        robot = self.vehicle or "unnamed vehicle"
        ground = f", {self.terrain_name}" if self.terrain_name else ""
        notes = counted(len(self.notes), "note")
        return f"Recording '{self.name}': {robot}{ground}, {self.duration_s():.1f} s, {notes}"

    def _rows(self) -> list[tuple[str, ...]]:
        return clock_rows(self.clocks(), self.start_ns)

    def with_notes(self, *notes: str) -> Recording:
        """The same recording with further notes."""
        return dataclasses.replace(self, notes=(*self.notes, *notes))
