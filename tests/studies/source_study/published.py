"""What the source study reports, as numbers, and its robot and profile beside the twin's.

"Evaluation of Wheeled Robot Mobility Limits on Unstructured Terrain": a 32 kg
four-wheel robot in Gazebo Classic on mud and sand, and one drive on real sand.
"""

import math
from dataclasses import dataclass

import numpy as np

from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.scenario.file import load_scenario

SCENARIO = "paper_profile"  # v(t) = 1.0 + 0.5 sin(2 pi t / 60) m/s for 300 s with short stops
VEHICLE = "elevate"
TITLE = "Evaluation of Wheeled Robot Mobility Limits on Unstructured Terrain"
_RPM = 30.0 / math.pi


@dataclass(frozen=True)
class StudyCase:
    """One of the study's three runs with its row of Tab. 4, mean percent."""

    terrain: str
    slope_deg: float
    slip: float
    odometry: float
    imu: float
    gnss: float

    @property
    def label(self) -> str:
        """The case in words."""
        ground = f"{self.slope_deg:g} deg" if self.slope_deg else "flat"
        return f"{self.terrain.replace('_', ' ')}, {ground}"


CASES = (
    StudyCase("mud", 0.0, slip=2.0, odometry=2.6, imu=4.9, gnss=45.7),
    StudyCase("loose_sand", 5.0, slip=27.0, odometry=27.0, imu=9.3, gnss=17.9),
    StudyCase("medium_sand", 5.0, slip=1.0, odometry=1.4, imu=7.3, gnss=57.1),
)
"""The scenarios of Tab. 4 and of Figs. 4 to 9."""

FRICTION = {"mud": (0.1, 0.2), "loose_sand": (0.4, 0.6), "medium_sand": (0.8, 1.0)}
"""Tab. 3: range of the effective friction coefficient of each terrain."""


@dataclass(frozen=True)
class Figure:
    """A figure of Tab. 1, Tab. 2 or the scenario: the study's and the twin's."""

    name: str
    study: float
    twin: float
    unit: str

    @property
    def same(self) -> bool:
        """Whether they agree to the digits the study gives."""
        return math.isclose(self.study, self.twin, rel_tol=2e-3)


def platform_figures() -> tuple[Figure, ...]:
    """Every figure of Tab. 1 and 2 that the model has, and the profile."""
    vehicle, scenario = load_vehicle(VEHICLE), load_scenario(SCENARIO)
    drive, sensors = vehicle.drive, vehicle.sensors
    motor_w = 0.25 * drive.stall_torque_nm * drive.no_load_speed_radps
    counts = 2.0 * math.pi / (sensors.wheels.quantum_rad * drive.gear_ratio) / 4.0
    moving = np.concatenate([s.v_mps + s.v_amplitude_mps * np.array([-1.0, 1.0]) for s in scenario.drive])
    return (
        Figure("mass", 32.0, vehicle.body.mass_kg, "kg"),
        Figure("largest payload", 60.0, vehicle.body.payload_max_kg, "kg"),
        Figure("power of a motor", 150.0, motor_w, "W"),
        Figure("motor speed", 11_700.0, drive.no_load_speed_radps * _RPM, "rev/min"),
        Figure("motor torque", 0.200, drive.torque_limit_nm, "N m"),
        Figure("top speed", 2.0, drive.max_speed_mps, "m/s"),
        Figure("wheel diameter", 0.350, 2.0 * vehicle.wheel.radius_m, "m"),
        Figure("wheel width", 0.145, vehicle.wheel.width_m, "m"),
        Figure("wheelbase", 0.420, vehicle.body.wheelbase_m, "m"),
        Figure("encoder counts a motor turn", 500.0, counts, ""),
        Figure("RTK position", 0.02, sensors.gnss.sigma_horizontal_m, "m"),
        Figure("stand-alone position", 1.5, vehicle.realism.gnss_single_sigma_m, "m"),
        Figure("rate of the IMU's log", 100.0, sensors.imu.rate_hz, "Hz"),
        Figure("slowest command", 0.5, float(moving.min()), "m/s"),
        Figure("fastest command", 1.5, float(moving.max()), "m/s"),
        Figure("period of the profile", 60.0, scenario.drive[0].period_s, "s"),
        Figure("length of a run", 300.0, scenario.duration_s, "s"),
    )
