"""Settings of a node."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.frames import NEAREST_TO_POLE_DEG
from terrafusion.datasets.readers.open import STAMPS
from terrafusion.fusion.inputs.validation import MOST_HEIGHT_M, as_numbers
from terrafusion.fusion.live.published import Frames
from terrafusion.fusion.noise.modes import MODES
from terrafusion.fusion.terrain.classifier import TerrainModel

DATUM = "give latitude and longitude in degrees and the height in metres"


@dataclass(frozen=True)
class LiveOptions:
    """Settings of a node.

    Attributes:
        vehicle: name or YAML file.
        mode, terrain_model: as in `EstimatorConfig`.
        topics: topic by channel, as `--topic`; the others are found by type and name.
        stamps: "header", or "receipt" for a robot whose clocks do not agree.
        frames: names of the frames.
        frequency: odometry a second, at most; it comes with samples of the IMU.
        publish_tf: whether the transforms are published.
        datum: latitude, longitude (deg) and height (m) of the map's origin; the first fix where it is None.
        wait_s: how long samples wait for others of the same time.
        use_sim_time: times of receipt are those of `/clock`.
        grounds: file of the robot's ground memory: read if it is there, and written when the node ends.
        prefix: stands before the topics of odometry, slip and ground, such as "/robot1".
    """

    vehicle: str | None = None
    mode: str = "adaptive"
    topics: Mapping[str, str] = field(default_factory=dict)
    stamps: str = "header"
    frames: Frames = field(default_factory=Frames)
    frequency: float = 50.0
    publish_tf: bool = True
    datum: tuple[float, float, float] | None = None
    wait_s: float = 0.02
    use_sim_time: bool = False
    prefix: str = ""
    terrain_model: TerrainModel | None = None
    grounds: Path | None = None

    def __post_init__(self) -> None:
        for what, value, known in (("mode", self.mode, MODES), ("stamps", self.stamps, STAMPS)):
            if value not in known:
                raise ConfigError(f"{what} is '{value}'", remedy=f"give one of {', '.join(known)}")
        if not self.frequency > 0.0:
            raise ConfigError(f"frequency is {self.frequency}", remedy="give Hz above 0")
        if not 0.0 <= self.wait_s <= 0.5:
            raise ConfigError(f"wait is {self.wait_s} s", remedy="give 0 to 0.5 s")
        if self.datum is not None:
            if np.shape(self.datum) != (3,):
                raise ConfigError(f"the datum {self.datum!r} has not three numbers", remedy=DATUM)
            checked_datum(*self.datum)


def checked_datum(latitude: float, longitude: float, height_m: float) -> tuple[float, float, float]:
    """A datum, deg and m.

    Raises:
        ConfigError: it is not on Earth, or on a pole, where no direction is east.
        DataError: it is no numbers.
    """
    latitude, longitude, height_m = as_numbers((latitude, longitude, height_m), "the datum", "datum").tolist()
    if not (
        abs(latitude) <= 90.0 - NEAREST_TO_POLE_DEG
        and abs(longitude) <= 180.0
        and abs(height_m) <= MOST_HEIGHT_M
    ):
        raise ConfigError(
            f"the datum {latitude:g}, {longitude:g}, {height_m:g} is on a pole or not on Earth", remedy=DATUM
        )
    return latitude, longitude, height_m
