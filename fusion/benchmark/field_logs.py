"""Field logs as runs of the benchmark: which files are present, their outages, reference and true ground."""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from terrafusion.datasets.catalog.catalog import CatalogFile, at_hand, data_folders, load_catalog
from terrafusion.datasets.checks import run_checks
from terrafusion.datasets.core.errors import DataError, TerrafusionError, errors_of
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers import open_recordings
from terrafusion.fusion.benchmark.joined_windows import joined_runs
from terrafusion.fusion.benchmark.methods import known_labels, true_labels
from terrafusion.fusion.benchmark.outage_plan import aided_by_truth, lead_s, plan_outages, until
from terrafusion.fusion.benchmark.twin_runs import FIELD, BenchmarkRun
from terrafusion.fusion.metrics.health import rolled_until_m
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.twin.model.choose import choose_vehicle

AID_SEED = 1
"""Of the noise of fixes simulated from truth."""
NOT_LABELLED = "not labelled"
WHOLE, CUT = "raw", "windows"
"""Windows cut from a run that the catalogue also has as a whole are left out."""
OUTAGES_S = (30.0, 60.0, 120.0)
MIN_RUN_S = 10.0
"""Shorter recordings are windows cut from a run: consecutive ones are joined."""
MIN_JOINED_S = 25.0
"""Shorter joined runs are left out: no outage fits into them."""
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
    """A field log and the largest number of outages of each length."""

    name: str
    starts: int

    @property
    def key(self) -> str:
        """Name of its file."""
        return f"{FIELD}-{self.starts}-{self.name.replace('/', '_').replace('#', '_')}"


def present_logs(starts: int) -> list[FieldLog]:
    """Logs of the catalogue whose files are present."""
    return [FieldLog(name, starts) for name in catalogued()]


def runs_of(log: FieldLog) -> list[BenchmarkRun | Refusal]:
    """All runs of a log; `plant` is its ground: "firm", "slipping" or `NOT_LABELLED`."""
    return each_run(log.name, lambda name, _, recording: _outage_runs(log, name, recording))


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
    outages = outages_of(recording, log.starts)
    if not outages:
        yield whole
    for outage in outages:
        yield dataclasses.replace(
            whole,
            name=f"{name}, {outage.seconds:g} s from {outage.start_s:.1f} s",
            recording=until(recording, outage.start_s + outage.seconds + 0.5),
            outage=outage,
        )


def catalogued() -> list[str]:
    """Recordings of the catalogue whose files are all present, without windows cut from another of them."""
    folders = data_folders()

    def complete(files: list[CatalogFile]) -> bool:
        return all(at_hand(entry, folders) is not None for entry in files)

    names = [name for name, files in load_catalog().recordings().items() if complete(files)]
    cut = {f"{name.removesuffix(WHOLE)}{CUT}" for name in names if name.endswith(f"/{WHOLE}")}
    return [name for name in names if name not in cut]


def each_run(
    log: str, run: Callable[[str, int, Recording], Iterable[Result | Refusal]]
) -> list[Result | Refusal]:
    """Results of `run(name, number, recording)` for every run of a log; an error becomes a `Refusal`."""
    out: list[Result | Refusal] = []
    try:
        recordings, joined = read_runs(log)
    except (TerrafusionError, *UNFORESEEN) as error:
        return [refusal_of(log, error)]
    for i, recording in enumerate(recordings):
        name = log if joined or len(recordings) == 1 else f"{log}#{i}"
        try:
            with errors_of(name):
                out += run(name, i, recording)
        except (TerrafusionError, *UNFORESEEN) as error:
            out.append(refusal_of(name, error))
    return out


def refusal_of(name: str, error: Exception) -> Refusal:
    """A refusal without the folder of the file: tables are published."""
    if not isinstance(error, TerrafusionError):
        return Refusal(name, f"FAILED, {type(error).__name__}: {error}")
    file = None if error.file is None else Path(error.file).name
    reason = TerrafusionError(
        error.what,
        file=None if file == Path(name).name else file,
        channel=error.channel,
        time_s=error.time_s,
        remedy=error.remedy,
    )
    return Refusal(name, str(reason))


@functools.lru_cache(maxsize=1)
def read_runs(log: str) -> tuple[list[Recording], bool]:
    """The runs of a log, and whether they were joined from windows; cached for consecutive modes."""
    recordings = open_recordings(log)
    if len(recordings) == 1 or max(r.duration_s() for r in recordings) >= MIN_RUN_S:
        return recordings, False
    joined = [run for run in joined_runs(log, recordings) if run.duration_s() >= MIN_JOINED_S]
    runs = [run for run in joined if run.truth is not None]
    if not runs:
        raise DataError(
            f"holds {len(recordings)} windows that form no run of {MIN_JOINED_S:g} s with a truth",
            remedy="give a log of one run",
        )
    return runs, True


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
    listed = recording.truth_channels
    if recording.truth is not None and len(recording.truth) and (not listed or "position" in listed):
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
    earliest = max(first_s + lead_s(first_s, last_s), moved_s)
    planned = [o for s in OUTAGES_S for o in plan_outages(earliest, last_s, s, most_starts)]
    return [o for o in planned if np.ptp(rolled[o.covers(wheels.t_ns, start_ns)]) >= MIN_OUTAGE_M]
