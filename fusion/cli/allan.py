"""`terrafusion allan`: Allan deviation of a simulated or recorded IMU."""

from typing import Annotated

import typer

from terrafusion.fusion.cli.command import Result
from terrafusion.fusion.cli.common import HowRead

SubjectsArgument = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[VEHICLE|LOG]...",
        help="Vehicles, by name or YAML file, whose IMU is simulated at rest; or logs of a robot at rest.",
    ),
]


def allan(subjects: SubjectsArgument = None) -> Result:
    """Allan deviation of IMUs at rest, and the noise parameters read from it (IEEE Std 952-1997).

    Without an argument: the simulated IMU of the vehicle elevate, beside the parameters it was made from.

    Examples:

    terrafusion allan husky

    terrafusion allan parked.mcap
    """
    from terrafusion.twin.analysis.allan import recording_at_rest, vehicle_at_rest
    from terrafusion.twin.model.vehicle import vehicle_names

    found = []
    for subject in subjects or ["elevate"]:
        if subject in vehicle_names() or subject.endswith((".yaml", ".yml")):
            found.append(vehicle_at_rest(subject))
            continue
        found += map(recording_at_rest, HowRead().open_all([subject], None))
    lines = [line for one in found for line in one.lines()]
    return Result(lines, document=[one.to_json() for one in found])
