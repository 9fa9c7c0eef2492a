"""What the checks of the input doctor take and give."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import Rig

Repair = Callable[[Recording], Recording]


@dataclass(frozen=True)
class Finding:
    """One oddity.

    Attributes:
        code: stable name of the kind, such as "imu-axes".
        severity: "error" (results would be wrong) or "warning" (results suffer).
        channel: the channel it was found on.
        what: the oddity, in words.
        evidence: the numbers it was found by.
        fix: what to do about it.
        repair: does that to a recording; None where nobody can know the true numbers.
    """

    code: str
    severity: str
    channel: str
    what: str
    evidence: str
    fix: str
    repair: Repair | None = field(default=None, repr=False, compare=False)

    def to_dict(self) -> dict[str, str | bool]:
        """The fields by name, for JSON; `repairable` stands for the repair."""
        texts = {name: getattr(self, name) for name in ("code", "severity", "channel", "what", "evidence")}
        return {**texts, "fix": self.fix, "repairable": self.repair is not None}


@dataclass(frozen=True)
class CheckContext:
    """What a check looks at: the recording, and the robot's geometry where known."""

    recording: Recording
    rig: Rig | None

    def wheel_radius_m(self) -> float | None:
        """Wheel radius of the log, else of the rig; 1 where speeds are in m/s already."""
        wheels = self.recording.wheels
        if wheels is not None and wheels.unit == "mps":
            return 1.0
        return self.recording.overrides.wheel_radius_m or (self.rig.wheel_radius_m if self.rig else None)

    def since_start_s(self, t_ns: np.int64) -> float:
        """Seconds from the start of the recording."""
        return (int(t_ns) - self.recording.start_ns) * 1e-9  # int: far times overflow int64
