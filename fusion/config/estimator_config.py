"""Settings of the estimator; every one has a default that suits a ground robot."""

import math
from dataclasses import dataclass, field
from typing import TypedDict

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.quantity import Quantity, checked_number
from terrafusion.datasets.core.sensors import Rig
from terrafusion.fusion.config.sensor_config import SensorConfig
from terrafusion.fusion.grounds.memory import GroundMemory
from terrafusion.fusion.noise.labels import GroundLabels
from terrafusion.fusion.noise.modes import INNOVATION_METHODS, MODES, ROBUST_LOSSES, ModeTuning, load_modes
from terrafusion.fusion.noise.policy import Policy, load_policy
from terrafusion.fusion.terrain.classifier import TerrainModel


class EstimatorOptions(TypedDict, total=False):
    """Fields of `EstimatorConfig` that a caller may set beside robot, mode, policy and sensors."""

    tuning: ModeTuning
    robust_loss: str
    innovation_method: str
    keyframe_s: float
    lag_s: float
    wheel_wait_s: float
    gnss_gate: float
    wheel_gate_sigma: float
    yaw_sigma_start_rad: float
    start_without_gnss_s: float
    calibrate: bool
    self_calibrate: bool
    declination_rad: float | None
    labels: GroundLabels | None
    terrain_model: TerrainModel | None


_RANGES = {
    "keyframe_s": Quantity("s", 0.01, 1.0),
    "lag_s": Quantity("s", 0.0, 3600.0),
    "wheel_wait_s": Quantity("s", 0.0, 3600.0),
    "gnss_gate": Quantity("", 0.0, 1.0),
    "wheel_gate_sigma": Quantity("", 0.0, 1e6),
    "yaw_sigma_start_rad": Quantity("rad", 0.0, math.pi),
    "start_without_gnss_s": Quantity("s", 0.0, 1e9),
    "declination_rad": Quantity("rad", -math.pi, math.pi),
}


_KINDS: tuple[tuple[str, type, str, str], ...] = (
    ("rig", Rig, "rig", "give Vehicle.load(NAME).rig(), or use Estimator.for_vehicle(NAME)"),
    ("policy", Policy, "policy", "give a Policy, as of `policy.load(FILE)`"),
    ("terrain_model", TerrainModel, "terrain model", "give the file that `terrafusion terrain train` wrote"),
    ("grounds", GroundMemory, "memory of grounds", "give the `grounds` of a result"),
)
"""Fields that are objects: their type, what it is called, and what to give."""
_NONE = ("terrain_model", "grounds")
"""Those of them that may be absent."""


@dataclass(frozen=True)
class EstimatorConfig:
    """Settings of an `Estimator`.

    Attributes:
        rig: geometry and sensors of the robot.
        vehicle: its name, for what the terrain model knows of single robots.
        mode: "adaptive" (noise follows the detected terrain), "fixed" (one noise for all grounds),
            "robust" (fixed, with a robust loss) or "innovation" (fixed, wheels and GNSS adapted by
            their innovations).
        policy: noise by terrain.
        tuning: of the modes.
        robust_loss: mode "robust": "cauchy" or "gnc".
        innovation_method: mode "innovation": "sage_husa" or "variational".
        keyframe_s: time between keyframes.
        lag_s: length of the smoothing window.
        wheel_wait_s: how long a keyframe waits for a late wheel sample.
        gnss_gate: chi-square probability beyond which a fix is rejected.
        wheel_gate_sigma: normalised wheel innovation beyond which an increment is rejected.
        yaw_sigma_start_rad: heading uncertainty at which the graph is started.
        start_without_gnss_s: time without a fix after which the start is in a local frame (at once if
            `inputs` has none).
        inputs: sensors that the estimator will be given; without all six IMU axes the graph is planar.
        calibrate: also estimate `key_state.CALIBRATION`: wheel radius, antenna, IMU rotation, delays.
        self_calibrate: learn antenna, delay of GNSS, gyro scale and wheel scale while driving
            (`calibration.online`); not together with `calibrate`.
        declination_rad: magnetic north, east of true north; with it a magnetometer measures the
            heading, without it it holds that of GNSS or the start.
        labels: the ground over time, in place of the detector as far as wheels and IMU do not contradict
            it; None: it detects.
        terrain_model: of the detector, trained on this robot (`terrafusion terrain train`); None: the shipped
            one. Its grounds that the policy does not know have the pooled noise, and the slip of the drive.
        grounds: what the robot learned of its grounds on earlier drives; with it grounds are recognised by
            `grounds.memory` and learned.
    """

    rig: Rig
    vehicle: str | None = None
    mode: str = "adaptive"
    policy: Policy = field(default_factory=load_policy)
    tuning: ModeTuning = field(default_factory=load_modes)
    robust_loss: str = "cauchy"
    innovation_method: str = "variational"
    keyframe_s: float = 0.1
    lag_s: float = 5.0
    wheel_wait_s: float = 0.3
    gnss_gate: float = 0.999
    wheel_gate_sigma: float = 6.0
    yaw_sigma_start_rad: float = 0.12
    start_without_gnss_s: float = 30.0
    inputs: SensorConfig = field(default_factory=SensorConfig)
    calibrate: bool = False
    self_calibrate: bool = True
    declination_rad: float | None = None
    labels: GroundLabels | None = None
    grounds: GroundMemory | None = None
    terrain_model: TerrainModel | None = None

    def __repr__(self) -> str:
        inputs = [
            key if value is True else f"{key} {value}" for key, value in vars(self.inputs).items() if value
        ]
        vehicle = self.vehicle or "unnamed vehicle"
        return (
            f"EstimatorConfig ({vehicle}, {self.mode}, policy '{self.policy.name}')\n"
            f"  a keyframe every {self.keyframe_s:g} s, lag {self.lag_s:g} s\n"
            f"  sensors: {', '.join(inputs)}"
        )

    def __post_init__(self) -> None:
        for key, kind, what, remedy in _KINDS:
            value = getattr(self, key)
            if not (isinstance(value, kind) or (value is None and key in _NONE)):
                raise ConfigError(f"a {type(value).__name__} is no {what}", remedy=remedy)
        if self.terrain_model is not None:
            model = self.terrain_model
            if self.vehicle not in model.vehicles:
                raise ConfigError(
                    f"the terrain model is of {', '.join(model.vehicles)}, the vehicle is {self.vehicle}",
                    remedy="train one on its own logs with `terrafusion terrain train`",
                )
            object.__setattr__(self, "policy", self.policy.with_grounds(model.classes))
        if self.grounds is not None and self.grounds.robot not in ("", self.vehicle or ""):
            raise ConfigError(
                f"the memory of grounds is that of '{self.grounds.robot}', "
                f"the robot here is '{self.vehicle}'",
                remedy="keep one memory a robot, or give the vehicle by that name",
            )
        for what, value, known in (
            ("mode", self.mode, MODES),
            ("robust_loss", self.robust_loss, ROBUST_LOSSES),
            ("innovation_method", self.innovation_method, INNOVATION_METHODS),
        ):
            if value not in known:
                raise ConfigError(f"unknown {what} '{value}'", remedy=f"this version has {', '.join(known)}")
        for key, range_ in _RANGES.items():
            if (value := getattr(self, key)) is not None or key != "declination_rad":
                checked_number(value, range_, file="the estimator", key=key)
        if self.lag_s < 5 * self.keyframe_s:
            raise ConfigError(f"lag_s is {self.lag_s}", remedy="give at least five keyframes")


def checked_config(config: object) -> EstimatorConfig:
    """The configuration.

    Raises:
        ConfigError: it is none, such as the name of a vehicle.
    """
    if isinstance(config, EstimatorConfig):
        return config
    raise ConfigError(
        f"a {type(config).__name__} is no configuration",
        remedy="give an EstimatorConfig, or use Estimator.for_vehicle(NAME)",
    )
