"""The short form of a vehicle file: a robot's numbers, each with how it is known.

robot:
  extends: generic
  drive: skid_steer
  wheel_radius_m: {value: 0.165, known: measured}
  antenna_m: {value: [0.1, 0.0, 0.6], known: measured}
  gnss_delay_s: {value: 0.21, known: calibrated, sigma: 0.01, logs: [monday, tuesday]}
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

from terrafusion.datasets.core.quantity import Parsed, Quantity, RejectedError, Word, shown

KNOWN = ("measured", "data_sheet", "calibrated", "assumed")
"""How a number is known; what is assumed gets a wide prior and is estimated while driving."""
LENGTH_SIGMA_M = {"measured": 0.02, "data_sheet": 0.05}
"""1 sigma of a length with a tape, and from a drawing of the robot (assumed)."""
ANTENNA_SIGMA_M = 0.25
"""1 sigma of an antenna somewhere on a small robot (assumed)."""
DRIVES = ("differential", "skid_steer", "tracked", "ackermann", "four_wheel_steer")
"""How a robot turns: two driven wheels and casters, wheels or tracks that skid, steered front wheels,
steered front and rear wheels."""
SKIDDING = ("skid_steer", "tracked")
"""Those whose wheels or tracks skid in every turn."""


def antenna_spread_m(wheelbase_m: float) -> float:
    """1 sigma of an antenna anywhere between the axles, from their middle; at least a small robot's."""
    return max(ANTENNA_SIGMA_M, wheelbase_m / math.sqrt(12.0))


@dataclass(frozen=True)
class KnownNumber:
    """A number of a robot and how it is known.

    Attributes:
        value: a number, or (3,) for a point in the body frame.
        known: one of `KNOWN`.
        sigma: 1 sigma; of a point that of x and y. None: as usual for what is so `known`.
        logs: from which it was calibrated.
        gained_nats: information that these logs gave, nats.
    """

    value: float | tuple[float, ...]
    known: str
    sigma: float | tuple[float, float] | None = None
    logs: tuple[str, ...] = ()
    gained_nats: float | None = None

    @property
    def number(self) -> float:
        """The value of a single number."""
        assert isinstance(self.value, float)
        return self.value

    @property
    def source(self) -> str:
        """How it is known, in words."""
        words = self.known.replace("_", " ")
        words += f" from {', '.join(self.logs)}" if self.logs else ""
        return words if self.sigma is None else f"{words}: 1 sigma {self.sigma}"


@dataclass(frozen=True)
class Known(Parsed):
    """Annotation of a number that stands in a file as `{value, known, sigma, logs, gained_nats}`.

    Beside a measured value or one of a data sheet `sigma` may be left out if it is a length.
    """

    quantity: Quantity

    @property
    def unit(self) -> str:
        """Unit of the number."""
        return self.quantity.unit

    def hint(self) -> str:
        return f"{{value: {self.quantity.allowed()}, known: one of {', '.join(KNOWN)}}}"

    def parse(self, raw: Any) -> KnownNumber:
        if not isinstance(raw, Mapping):
            raise RejectedError(f"'{{key}}' is '{shown(raw)}'; how is it known?", f"write {self.hint()}")
        for name in raw:
            if name not in KnownNumber.__dataclass_fields__:
                what = f"'{{key}}' has the unknown entry '{shown(name)}'"
                raise RejectedError(what, f"known here: {', '.join(KnownNumber.__dataclass_fields__)}")
        value = self.quantity.parse_part(raw.get("value"), ".value")
        known = Word(KNOWN).parse_part(raw.get("known"), ".known")
        sigma = None
        if "sigma" in raw:
            pair = isinstance(raw["sigma"], (list, tuple)) and self.quantity.size
            positive = Quantity(self.unit, 1e-9, 1e3, size=2 if pair else 0)
            sigma = positive.parse_part(raw["sigma"], ".sigma")
        elif known == "calibrated" or (known in LENGTH_SIGMA_M and self.unit != "m"):
            raise RejectedError("'{key}' has no sigma", "add sigma, the standard deviation of the value")
        logs = raw.get("logs", [])
        if not isinstance(logs, list) or not all(isinstance(log, str) for log in logs):
            raise RejectedError(f"'{{key}}.logs' is '{shown(logs)}'", "give a list of names")
        gained = None
        if "gained_nats" in raw:
            gained = Quantity("nats").parse_part(raw["gained_nats"], ".gained_nats")
        return KnownNumber(value, known, sigma, tuple(logs), gained)

    def schema(self) -> dict[str, Any]:
        value = self.quantity.schema()
        sigma: dict[str, Any] = {"type": "number", "exclusiveMinimum": 0}
        if self.quantity.size:
            sigma = {"anyOf": [sigma, {"type": "array", "items": sigma, "minItems": 2, "maxItems": 2}]}
        return {
            "type": "object",
            "description": value.pop("description"),
            "properties": {
                "value": value,
                "known": {"enum": list(KNOWN)},
                "sigma": sigma,
                "logs": {"type": "array", "items": {"type": "string"}},
                "gained_nats": {"type": "number"},
            },
            "required": ["value", "known"],
            "additionalProperties": False,
        }


Ratio = Annotated[KnownNumber, Known(Quantity("", -0.5, 1.0))]
Delay = Annotated[KnownNumber, Known(Quantity("s", -5.0, 5.0))]
Tilt = Annotated[KnownNumber, Known(Quantity("rad", -0.8, 0.8))]
Place = Annotated[KnownNumber, Known(Quantity("m", -20.0, 20.0, size=3))]


@dataclass(frozen=True)
class SensorNumbers:
    """Numbers of a robot's sensors that the estimator starts from and goes on to learn; None: assumed.

    Attributes:
        antenna_m: of GNSS, body frame.
        gyro_scale: true yaw rate over that of the gyro, less one; gyro_bias_radps: its reading at rest.
        yaw_factor: true yaw rate over that of the wheels and the track, where there is no gyro.
        wheel_scale: true distance over that of the wheels, less one; usual slip included.
        gnss_delay_s, wheel_delay_s: lateness of the stamps against those of the IMU.
        course_lag_s: time by which the course follows the heading, of a robot that skids outwards in turns.
        slip_per_grade: additional slip over the sine of the slope, uphill positive.
        imu_roll_rad, imu_pitch_rad, imu_yaw_rad: angles at which the IMU is mounted: readings turned about x,
            then y, then z by them are in body axes.
    """

    antenna_m: Place | None = None
    gyro_scale: Ratio | None = None
    gyro_bias_radps: Annotated[KnownNumber, Known(Quantity("rad/s", -1.0, 1.0))] | None = None
    yaw_factor: Annotated[KnownNumber, Known(Quantity("", 0.05, 2.0))] | None = None
    wheel_scale: Ratio | None = None
    gnss_delay_s: Delay | None = None
    wheel_delay_s: Delay | None = None
    course_lag_s: Delay | None = None
    slip_per_grade: Annotated[KnownNumber, Known(Quantity("", -1.0, 5.0))] | None = None
    imu_roll_rad: Tilt | None = None
    imu_pitch_rad: Tilt | None = None
    imu_yaw_rad: Annotated[KnownNumber, Known(Quantity("rad", -3.1416, 3.1416))] | None = None


@dataclass(frozen=True)
class Robot(SensorNumbers):
    """Section `robot`: what differs from the vehicle that it `extends`, a name or a file beside this one.

    `imu_axes` are the sensor axes along body x, y, z; they turn a bag's messages in the frame `imu_frame`.
    `gnss_sigma_m` is that of fixes that report none, horizontal; twice that upwards.
    """

    extends: str = "generic"
    name: str | None = None
    description: str | None = None
    drive: Annotated[str, Word(DRIVES)] | None = None
    wheel_radius_m: Annotated[KnownNumber, Known(Quantity("m", 0.02, 2.0))] | None = None
    track_m: Annotated[KnownNumber, Known(Quantity("m", 0.05, 5.0))] | None = None
    wheelbase_m: Annotated[KnownNumber, Known(Quantity("m", 0.05, 5.0))] | None = None
    mass_kg: Annotated[KnownNumber, Known(Quantity("kg", 0.1, 50000.0))] | None = None
    imu_m: Place | None = None
    gnss_sigma_m: Annotated[KnownNumber, Known(Quantity("m", 1e-3, 100.0))] | None = None
    imu_axes: tuple[str, ...] | None = None
    imu_frame: str | None = None
    topics: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class RobotFile:
    """A vehicle file of the short form."""

    robot: Robot
