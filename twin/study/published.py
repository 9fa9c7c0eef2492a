"""What the source study reports, as numbers.

"Evaluation of Wheeled Robot Mobility Limits on Unstructured Terrain": a 32 kg
four-wheel robot in Gazebo Classic on mud and sand, and one drive on real sand.
"""

from __future__ import annotations

from dataclasses import dataclass

TITLE = "Evaluation of Wheeled Robot Mobility Limits on Unstructured Terrain"


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
