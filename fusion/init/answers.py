"""What the user says of a robot that no log shows, and what is assumed of the rest."""

import math
from dataclasses import dataclass, field

from terrafusion.datasets.core.config import structure
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.robot import DRIVES, KnownNumber, RobotFile
from terrafusion.fusion.outputs.robot_file import raw_number

SOURCES = ("measured", "data_sheet")
"""How an answer may be known; the first without a word."""
POINTS = ("antenna_m", "imu_m")
MASS_SIGMA = {"measured": 0.02, "data_sheet": 0.05}
"""Relative 1 sigma of a weighed mass, and of one from a data sheet, maybe without a payload (assumed)."""


@dataclass(frozen=True)
class Answers:
    """Numbers of the robot; None where the user does not know.

    Attributes:
        topics: topic by channel, of a bag with several sensors of a kind.
    """

    name: str
    drive: str | None = None
    wheel_radius_m: KnownNumber | None = None
    track_m: KnownNumber | None = None
    wheelbase_m: KnownNumber | None = None
    antenna_m: KnownNumber | None = None
    imu_m: KnownNumber | None = None
    mass_kg: KnownNumber | None = None
    topics: dict[str, str] = field(default_factory=dict)


def parse(text: str, name: str) -> str | KnownNumber:
    """An answer by its name: a word, a number `0.12` or `0.12:data_sheet`, or a point `0.1,0,0.6`.

    Raises:
        ConfigError: it is malformed or out of range.
    """
    if name == "drive":
        if text.strip() not in DRIVES:
            raise ConfigError(f"the drive is '{text.strip()}'", remedy=f"give one of {', '.join(DRIVES)}")
        return text.strip()
    size = 3 if name in POINTS else 1
    numbers, _, source = text.partition(":")
    known = source.strip() or SOURCES[0]
    try:
        values = tuple(float(part) for part in numbers.split(","))
    except ValueError:
        values = ()
    if len(values) != size or not all(map(math.isfinite, values)) or known not in SOURCES:
        example = "0.12" if size == 1 else "0.1,0,0.6"
        raise ConfigError(
            f"{name} is '{text}'", remedy=f"write it as {example} (measured) or {example}:data_sheet"
        )
    sigma = abs(values[0]) * MASS_SIGMA[known] if name == "mass_kg" else None
    number = KnownNumber(values if size > 1 else values[0], known, sigma)
    structure(RobotFile, {"robot": {name: raw_number(number)}}, file=f"'{text}'")
    return number
