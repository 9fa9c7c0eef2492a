"""`terrafusion.calibrate_sensors`: a robot's sensor numbers from its logs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from terrafusion.datasets.core.arguments import checked_path, checked_progress
from terrafusion.datasets.readers.logs import Log, opened
from terrafusion.fusion.outputs.robot_file import write_robot
from terrafusion.fusion.sensor_calibration import SensorCalibration
from terrafusion.fusion.sensor_calibration import calibrate_sensors as run
from terrafusion.twin.model.vehicle import VehicleParams, as_vehicle


@dataclass(frozen=True, eq=False, repr=False)
class LearnedSensors(SensorCalibration):
    """What logs show of a robot's sensors: `numbers`, `summary` and `write`."""

    def write(self, path: str | Path) -> Path:
        """Write the vehicle file, for `vehicle=` everywhere; see `robot_file.write_robot`."""
        return write_robot(checked_path(path, "path"), self)


def calibrate_sensors(
    logs: Log | Sequence[Log],
    vehicle: str | Path | VehicleParams | None = None,
    *,
    progress: Callable[[float], None] | None = None,
) -> LearnedSensors:
    """Learn antenna, gyro, wheel scale and delays of a robot from fixes of its logs, without any twin.

    Args:
        logs: recordings, or paths or catalogue names, of one robot, in the order in which it drove them.
        vehicle: name, YAML file or `Vehicle`; by default what the logs say.
        progress: called with the share done, 0 to 1.

    Raises:
        TerrafusionError: no log has fixes, or a log or the vehicle cannot be used.
    """
    checked_progress(progress)
    known = None if vehicle is None else as_vehicle(vehicle)
    return LearnedSensors(
        **vars(run(opened(logs, None if known is None else known.rig()), vehicle, progress=progress))
    )
