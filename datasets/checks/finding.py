"""Types shared by the log checks, and building blocks of their repairs."""

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from terrafusion.datasets.core.arrays import Array, Mask, TimesNs
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import Rig

Repair = Callable[[Recording], Recording]
T = TypeVar("T")


@dataclass(frozen=True)
class Finding:
    """One inconsistency of a log.

    Attributes:
        code: stable name of its kind, such as "imu-axes".
        severity: "error" (results would be wrong) or "warning" (results are less accurate).
        evidence: the numbers behind it.
        fix: what to do about it.
        repair: function that does so; None where the correct numbers cannot be inferred.
        imu_axes: where the whole IMU is mounted otherwise, its axes along body x, y, z; else ().
    """

    code: str
    severity: str
    channel: str
    what: str
    evidence: str
    fix: str
    repair: Repair | None = field(default=None, repr=False, compare=False)
    imu_axes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, str | bool]:
        """The fields by name, for JSON; `repairable` stands for the repair."""
        texts = {name: getattr(self, name) for name in ("code", "severity", "channel", "what", "evidence")}
        return {**texts, "fix": self.fix, "repairable": self.repair is not None}


@dataclass(frozen=True)
class CheckContext:
    """Input of a check: the recording, and the robot's geometry where known."""

    recording: Recording
    rig: Rig | None
    computed: dict[Any, Any] = field(init=False, default_factory=dict, repr=False, compare=False)
    """Results of the functions that are computed `once`."""

    def wheel_radius_m(self) -> float | None:
        """Wheel radius of the log, else of the rig; 1 where wheel speeds are in m/s."""
        wheels = self.recording.wheels
        return 1.0 if wheels is not None and wheels.unit == "mps" else self.true_radius_m()

    def true_radius_m(self) -> float | None:
        """Wheel radius of the log, else of the rig, whatever the unit of the wheel speeds."""
        return self.recording.overrides.wheel_radius_m or (self.rig.wheel_radius_m if self.rig else None)

    def known(self, name: str) -> float:
        """A number of the vehicle file's `SensorNumbers` that the estimator corrects by; 0 without one."""
        number = getattr(self.rig.known, name) if self.rig else None
        return 0.0 if number is None else float(number.number)

    def known_sigma(self, name: str) -> float:
        """1 sigma of such a number; 0 without one."""
        number = getattr(self.rig.known, name) if self.rig else None
        return 0.0 if number is None else float(number.sigma or 0.0)

    def since_start_s(self, t_ns: np.int64 | int) -> float:
        """Seconds from the start of the recording."""
        return (int(t_ns) - self.recording.start_ns) * 1e-9  # Python integers: int64 could overflow


def once(of: Callable[[CheckContext], T]) -> Callable[[CheckContext], T]:
    """Caches a function's result in the context; callers must not modify it."""

    @functools.wraps(of)
    def cached(context: CheckContext) -> T:
        if of not in context.computed:
            context.computed[of] = of(context)
        found: T = context.computed[of]
        return found

    return cached


def with_fields(recording: Recording, channel: str, **fields: Any) -> Recording:
    """The recording with some fields of one channel (or of "truth") replaced."""
    changed = dataclasses.replace(getattr(recording, channel), **fields)
    return dataclasses.replace(recording, **{channel: changed})


def changed(channel: str, change: Callable[..., Any], **given: Any) -> Repair:
    """A repair that replaces a channel by what `change` makes of it and of the arguments `given`."""
    return lambda recording: dataclasses.replace(
        recording, **{channel: change(getattr(recording, channel), **given)}
    )


def changed_field(channel: str, field: str, change: Callable[[Array], Array]) -> Repair:
    """A repair that replaces a field of a channel by what `change` makes of it."""
    return changed(channel, lambda old: dataclasses.replace(old, **{field: change(getattr(old, field))}))


def scaled(channel: str, factor: float, field: str) -> Repair:
    """A repair that multiplies a field of a channel."""
    return changed_field(channel, field, lambda values: values * factor)


def without_rows(channel: str, rows: Mask) -> Repair:
    """A repair that drops the rows of a mask."""
    return changed(channel, lambda old: old.select(~rows))


def retiming(channel: str, change: Callable[[TimesNs], TimesNs]) -> Repair:
    """A repair that gives a channel (or "truth") the times that `change` makes of its own."""
    return lambda recording: retimed(recording, channel, change(getattr(recording, channel).t_ns))


def retimed(recording: Recording, name: str, t_ns: TimesNs) -> Recording:
    """The recording with other times for one channel (or "truth"); it starts no later than they do.

    A log without a calendar starts at 0, which is its only sign: it stays so.
    """
    start_ns = (
        min(recording.start_ns, int(t_ns[0])) if len(t_ns) and recording.start_ns else recording.start_ns
    )
    return dataclasses.replace(with_fields(recording, name, t_ns=t_ns), start_ns=start_ns)


def clocks_of(recording: Recording) -> dict[str, TimesNs]:
    """Times of all sampled channels, and of the truth."""
    return {name: t_ns for name, t_ns in recording.clocks().items() if name != "terrain"}


def period_s(t_ns: TimesNs) -> float:
    """Median of the intervals that are not zero; 1 where there is none."""
    steps = np.diff(t_ns)
    steps = steps[steps > 0]
    return float(np.median(steps)) * 1e-9 if steps.size else 1.0
