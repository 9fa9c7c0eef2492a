"""Field logs as runs of the benchmark: which files are present, their outages, reference and true ground."""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from terrafusion.datasets.catalog.catalog import at_hand, data_folders, load_catalog
from terrafusion.datasets.checks import run_checks
from terrafusion.datasets.core.errors import DataError, TerrafusionError, errors_of
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers import open_recordings
from terrafusion.fusion.benchmark.methods import known_labels, true_labels
from terrafusion.fusion.benchmark.outage_plan import LEAD_S, LEAD_SHARE, aided_by_truth, plan_outages, until
from terrafusion.fusion.benchmark.twin_runs import FIELD, BenchmarkRun
from terrafusion.fusion.metrics.health import rolled_until_m
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.twin.model.choose import choose_vehicle

AID_SEED = 1
"""Of the noise of fixes simulated from truth."""
NOT_LABELLED = "not labelled"
CUT = "windows"
"""Last word of the name of a recording that is cut into windows of seconds."""
OUTAGES_S, STARTS = (30.0, 60.0, 120.0), 1
"""Lengths of the outages, and how many of each in a log, at most."""
MIN_LEAD_M = 5.0
"""Wheel path before an outage: fixes do not show the heading of a robot at rest."""
MIN_OUTAGE_M = 3.0
"""Outages with a shorter wheel path are left out."""
SLIPPING = ("medium_sand", "loose_sand", "sandy_loam", "ploughed_soil", "mud", "snow", "ice")
UNFORESEEN = (ArithmeticError, RuntimeError, ValueError)
"""Unexpected errors of readers and solver: reported, and ending one replay only."""
Result = TypeVar("Result")
SET_GROUND = {"husky_parkinglot": "firm"}
"""Ground of sets whose title names it and whose logs have no label."""


@dataclass(frozen=True)
class Refusal:
    """A log that was not run, and why."""

    log: str
    why: str

    @property
    def line(self) -> str:
        """Log and reason, for tables."""
        return f"{self.log}: {self.why}"


@dataclass(frozen=True)
class FieldLog:
    """A field log, by its name in the catalogue."""

    name: str

    @property
    def key(self) -> str:
        """Name of its file."""
        return f"{FIELD}-{self.name.replace('/', '_').replace('#', '_')}"


def present_logs() -> list[FieldLog]:
    """Logs of the catalogue whose files are present; an outage fits into none of those cut into windows."""
    return [FieldLog(name) for name in present_recordings() if not name.endswith(f"/{CUT}")]


def runs_of(log: FieldLog) -> list[BenchmarkRun | Refusal]:
    """All runs of a log; `plant` is its ground: "firm", "slipping" or `NOT_LABELLED`."""
    out: list[BenchmarkRun | Refusal] = []
    recordings = attempted(log.name, lambda: opened(log.name))
    for i, one in enumerate(recordings):
        name = log.name if len(recordings) == 1 else f"{log.name}#{i}"
        if isinstance(one, Refusal):
            out.append(one)
        else:
            out += attempted(name, functools.partial(_outage_runs, log, name, one))
    return out


def attempted(name: str, work: Callable[[], Iterable[Result | Refusal]]) -> list[Result | Refusal]:
    """What `work` gives for the log or run of a name; an error becomes a `Refusal`."""
    try:
        with errors_of(name):
            return list(work())
    except (TerrafusionError, *UNFORESEEN) as error:
        return [refusal_of(name, error)]


@functools.lru_cache(maxsize=1)
def opened(log: str) -> list[Recording]:
    """The recordings of a log, cached for consecutive methods."""
    return open_recordings(log)


def _outage_runs(log: FieldLog, name: str, recording: Recording) -> Iterator[BenchmarkRun]:
    check_log(recording)
    reference = reference_of(recording)
    ground = ground_of(log.name, recording) or NOT_LABELLED
    labels = known_labels(true_labels(recording))
    whole = BenchmarkRun(FIELD, ground, name, f"{name}, whole", recording, None, labels)
    if reference == "none":
        yield dataclasses.replace(whole, judged=False)
        return
    if reference == "truth" and recording.gnss is None:
        recording = aided_by_truth(recording, AID_SEED)
    outages = outages_of(recording, STARTS)
    if not outages:
        yield whole
    for outage in outages:
        yield dataclasses.replace(
            whole,
            name=f"{name}, {outage.seconds:g} s from {outage.start_s:.1f} s",
            recording=until(recording, outage.start_s + outage.seconds + 0.5),
            outage=outage,
        )


def present_recordings() -> list[str]:
    """Names of the recordings of the catalogue whose files are all present."""
    folders = data_folders()
    recordings = load_catalog().recordings().items()
    return [name for name, files in recordings if all(at_hand(one, folders) is not None for one in files)]


def refusal_of(name: str, error: Exception) -> Refusal:
    """A refusal without the folder of the file: tables are published."""
    if not isinstance(error, TerrafusionError):
        return Refusal(name, f"FAILED, {type(error).__name__}: {error}")
    file = None if error.file is None else Path(error.file).name
    return Refusal(name, str(error.of(None if file == Path(name).name else file)))


def check_log(recording: Recording) -> None:
    """Refuse what `terrafusion replay` refuses."""
    if recording.wheels is None or recording.imu is None:
        raise DataError("has no wheels or no IMU", remedy="give a log with both")
    params, _ = choose_vehicle(recording, None)
    errors = [found for found in run_checks(recording, params.rig()) if found.severity == "error"]
    if errors:
        raise DataError(
            f"{errors[0].what} ({errors[0].evidence})", channel=errors[0].channel, remedy=errors[0].fix
        )


def reference_of(recording: Recording) -> str:
    """ "truth", "held-out fixes", or "none"."""
    if recording.truth_holds("position"):
        return "truth"
    return "held-out fixes" if recording.gnss is not None and len(recording.gnss) else "none"


def ground_of(log: str, recording: Recording) -> str:
    """ "firm" or "slipping" by the log's label, else by its set; "" without both."""
    labels = {recording.terrain_name} - {""}
    if recording.terrain is not None:
        labels |= set(map(str, recording.terrain.label.tolist()))
    if labels - {"unknown", "mixed"}:
        return "slipping" if labels & set(SLIPPING) else "firm"
    return SET_GROUND.get(log.partition("/")[0], "")


def outages_of(recording: Recording, most_starts: int) -> list[Outage]:
    """Outages of all lengths where wheels, IMU and fixes are present and the wheels roll."""
    wheels, imu, gnss = recording.wheels, recording.imu, recording.gnss
    assert wheels is not None
    assert imu is not None
    assert gnss is not None
    start_ns = recording.start_ns
    first_s = (max(int(c.t_ns[0]) for c in (wheels, imu, gnss)) - start_ns) * 1e-9
    last_s = (min(int(c.t_ns[-1]) for c in (wheels, imu, gnss)) - start_ns) * 1e-9
    radius_m = choose_vehicle(recording, None)[0].rig().wheel_radius_m
    rolled = rolled_until_m(wheels, radius_m)
    if rolled[-1] < MIN_LEAD_M:
        return []
    moved_s = (int(wheels.t_ns[np.searchsorted(rolled, MIN_LEAD_M)]) - start_ns) * 1e-9
    earliest = max(first_s + min(LEAD_S, LEAD_SHARE * (last_s - first_s)), moved_s)
    planned = [o for s in OUTAGES_S for o in plan_outages(earliest, last_s, s, most_starts)]
    return [o for o in planned if np.ptp(rolled[o.covers(wheels.t_ns, start_ns)]) >= MIN_OUTAGE_M]
