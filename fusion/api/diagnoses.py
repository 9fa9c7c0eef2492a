"""`terrafusion.diagnose`: where robot and twin differ, and which effect causes it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from pathlib import Path

from terrafusion.datasets.core.arguments import checked_names, checked_path, checked_progress, checked_whole
from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.datasets.core.tables import text_html
from terrafusion.datasets.readers.logs import Log, opened
from terrafusion.fusion.reports.gap import write_diagnosis
from terrafusion.fusion.reports.gap_text import answer
from terrafusion.twin.gap.answer.diagnosis import GapDiagnosis
from terrafusion.twin.gap.diagnose import diagnose as run
from terrafusion.twin.model.choose import vehicle_of_logs
from terrafusion.twin.model.soil import SoilParams
from terrafusion.twin.model.vehicle import VehicleParams, as_vehicle

Soils = str | SoilParams | Mapping[str, str | SoilParams] | None


@dataclass(frozen=True, eq=False, repr=False)
class Diagnosis(GapDiagnosis):
    """A diagnosis: `summary`, `to_json` and `report`."""

    def summary(self) -> str:
        """The answer on one screen, as `terrafusion gap` prints it: the verdict in words first."""
        return repr(self)

    def report(self, out: str | Path) -> Path:
        """Writes diagnosis.json and report.html into a folder and returns the page.

        Raises:
            TerrafusionError: the folder cannot be written.
        """
        folder = checked_path(out, "out")
        write_diagnosis(folder, self)
        return folder / "report.html"

    def __repr__(self) -> str:
        return "\n".join(answer(self))

    def _repr_html_(self) -> str:
        return text_html(repr(self))


def diagnose(
    runs: Log | Sequence[Log],
    *,
    references: Log | Sequence[Log] = (),
    vehicle: str | Path | VehicleParams | None = None,
    terrain: Soils = None,
    effects: str | Sequence[str] | None = None,
    significance: float = 0.05,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> Diagnosis:
    """Compare runs with reference runs of the same robot through its twin.

    Args:
        runs: one log or several: the robot as it is now.
        references: logs that count as normal; none: replicates of the twin stand in for them.
        vehicle: the twin's vehicle: name, YAML file or `Vehicle`; None: the logs'.
        terrain: ground of all logs, or grounds by the logs' labels; None: each label's soil of the library.
        effects: candidate or candidates by name; None: the whole catalogue.
        significance: threshold of the test for a gap.
        seed: of the replicates.
        progress: called with the share done, 0 to 1.

    Raises:
        ConfigError: an unknown effect, soil or vehicle.
        DataError: a log without what the diagnosis needs, or given twice.
    """
    seed = checked_whole(seed, "seed")
    checked_progress(progress)
    if not isinstance(significance, Real):
        raise ConfigError(f"'significance' is {significance!r}", remedy="give a number from 0.001 to 0.5")
    rig = None if vehicle is None else as_vehicle(vehicle).rig()
    judged, normal = opened(runs, rig), opened(references, rig)
    if not judged:
        raise DataError("no run to diagnose was given", remedy="give at least one")
    robot, assumed = vehicle_of_logs([*judged, *normal], vehicle)
    params = as_vehicle(robot)
    judged, normal = opened(judged, params.rig()), opened(normal, params.rig())
    result = run(
        judged, normal, params, terrain,
        effects=None if effects is None else checked_names(effects, "effects"),
        significance=significance, seed=seed,
        progress=progress,
    )  # fmt: skip
    return Diagnosis(**{**vars(result), "notes": (*assumed, *result.notes)})
