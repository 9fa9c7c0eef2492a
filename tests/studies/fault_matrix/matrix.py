"""A matrix of faults: does the estimator, or its verdict, fail silently?

    python -m tests.studies.fault_matrix.matrix --cells 1000 --minutes 60 --out OUT

A cell is one or two faults, a log, a mode and live or batch, drawn at random with a seed: cell i is the same
in every run, and a run of the same code goes on where one was stopped. The truth is kept from the verdict;
where a log has none, the estimate of the clean log stands for it. *Silent*: an error of more than 10 m or,
for more than 1 % of the time, of five sigmas, while the verdict is good. Rules of the verdict were set on
cells below 1000 (`DEVELOPED`); those from there on only judge them.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import dataclasses
import functools
import os
import re
import sys
import threading
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.recording import Overrides, Recording
from terrafusion.datasets.readers import open_recording
from terrafusion.fusion.metrics.scores import Outage, score
from terrafusion.fusion.replay import ReplayResult, replay
from terrafusion.twin.model.vehicle import VehicleParams, load_vehicle, with_overrides
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate
from tests.studies.fault_matrix.faults import FAULTS
from tests.studies.parts import Task, TaskWorkers, add_options, code_of, library_code, result_of, run_all

TWIN = ("skid", "steered")
FIELD = {"husky": ("husky_parkinglot/test1", 130.0, 60.0), "pathfinder": ("wvu_pathfinder/s5t1", 80.0, 40.0)}
MODES = ("fixed", "robust", "adaptive", "innovation")
FAR_M, FIVE_SIGMA, STRAY = 10.0, 25.0, 0.01
SLOWER, HANG_S = 10.0, 120
LEAST_CLEAN_S = 0.3
"""No clean log is replayed faster: it is tried only where a cell took ten times longer."""
DEVELOPED = 1000
BAD = ("crash", "hang", "slow", "not_finite", "silent")


@dataclasses.dataclass(frozen=True)
class Cell:
    """One trial."""

    number: int
    log: str
    mode: str
    batch: bool
    faults: tuple[str, ...]

    @classmethod
    def drawn(cls, number: int, logs: tuple[str, ...]) -> Cell:
        """The cell of a number."""
        rng = np.random.default_rng([30, number])
        names = list(FAULTS)
        # The first fault goes round, so that each is met equally often; half the cells have a second one.
        first = names[number % len(names)]
        second = [str(rng.choice([n for n in names if n != first]))] if rng.random() < 0.5 else []
        log, mode = str(rng.choice(list(logs))), str(rng.choice(list(MODES)))
        return cls(number, log, mode, bool(rng.random() < 0.3), (first, *second))

    def faulty(self, log: Recording) -> Recording:
        """The log with the faults of the cell in it."""
        rng = np.random.default_rng([31, self.number])
        for name in self.faults:
            log = FAULTS[name](log, rng)
        return log


@functools.cache
def vehicle_of(name: str) -> VehicleParams | None:
    """The robot of a log; None for what the log says."""
    if name == "steered":
        return with_overrides(load_vehicle("elevate"), Overrides(drive="ackermann"))
    return load_vehicle("elevate") if name == "skid" else None


@functools.cache
def clean_log(name: str) -> Recording:
    """A drive of the twin of 40 s, or a slice of a field log."""
    vehicle = vehicle_of(name)
    if vehicle is not None:
        legs = (
            DriveSegment(3.0),
            DriveSegment(9.0, 0.9, 0.15),
            DriveSegment(9.0, 0.6, -0.35),
            DriveSegment(9.0, 1.0, 0.05),
            DriveSegment(10.0, 0.8, 0.3),
        )
        scenario = Scenario("matrix", 40.0, drive=legs, route=(RouteLeg("grass"),), heading_deg=35.0)
        return simulate(scenario, vehicle=vehicle, seed=8)
    path, begin_s, seconds = FIELD[name]
    log = open_recording(path)
    begin_ns = log.start_ns + round(begin_s * 1e9)
    end_ns = begin_ns + round(seconds * 1e9)
    cut = {key: channel.between(begin_ns, end_ns) for key, channel in log.channels().items()}
    return dataclasses.replace(log, start_ns=begin_ns, truth=None, truth_channels=(), **cut)


@functools.cache
def clean_run(name: str, mode: str, batch: bool) -> tuple[ReplayResult, float]:
    """The clean log, replayed, and its seconds in all."""
    begun = time.process_time()
    log = dataclasses.replace(clean_log(name), truth=None, truth_channels=())
    result = replay(log, vehicle=vehicle_of(name), mode=mode, batch=batch)
    return result, time.process_time() - begun


def error_of(result: ReplayResult, name: str, mode: str) -> tuple[float, float]:
    """Largest error of the position, m, and the share of times with more than five sigmas."""
    if name in TWIN:
        errors = score(
            result.estimate, clean_log(name), antenna_m=result.vehicle.sensors.gnss.antenna_m
        ).errors
        assert errors is not None
        return float(errors.distance_m().max()), float(np.mean(2.0 * errors.nees() > FIVE_SIGMA))
    ours, truth = result.estimate.trajectory, clean_run(name, mode, True)[0].estimate.trajectory
    at = np.clip(np.searchsorted(truth.t_ns, ours.t_ns), 0, len(truth) - 1)
    inside = (ours.t_ns >= truth.t_ns[0]) & (ours.t_ns <= truth.t_ns[-1])
    error = np.array(
        [np.interp(ours.t_ns, truth.t_ns, truth.position_m[:, i]) - ours.position_m[:, i] for i in (0, 1)]
    )[:, inside]
    assert ours.covariance is not None
    assert truth.covariance is not None
    P = (ours.covariance[:, :2, :2] + truth.covariance[at, :2, :2])[inside]
    if not inside.any():
        return 0.0, 0.0
    square = np.einsum("in,nij,jn->n", error, np.linalg.inv(P), error)
    return float(np.hypot(*error).max()), float(np.mean(square > FIVE_SIGMA))


def tried(cell: Cell) -> dict[str, Any]:
    """The outcome of a cell: refused, or a verdict and errors, or a defect."""
    row: dict[str, Any] = dataclasses.asdict(cell)
    begun = time.process_time()
    try:
        with ended_after(HANG_S):
            log = dataclasses.replace(cell.faulty(clean_log(cell.log)), truth=None, truth_channels=())
            outages = (Outage(25.0, 8.0),) if cell.number % 8 == 0 else ()
            vehicle = vehicle_of(cell.log)
            result = replay(log, vehicle=vehicle, mode=cell.mode, batch=cell.batch, outages=outages)
        seconds = time.process_time() - begun
        row |= judged(result, cell) | {"seconds": round(seconds, 2)}
        if row["outcome"] == "ok" and seconds > SLOWER * LEAST_CLEAN_S:
            clean_s = clean_run(cell.log, cell.mode, cell.batch)[1]
            row["outcome"] = "slow" if seconds > SLOWER * clean_s else "ok"
    except TerrafusionError as error:
        row |= {"outcome": "refused", "why": str(error)[:200]}
    except TimeoutError:
        row["outcome"] = "hang"
    except Exception:
        row |= {"outcome": "crash", "why": traceback.format_exc()[-600:]}
    return row


@contextlib.contextmanager
def ended_after(seconds: float) -> Iterator[None]:
    """TimeoutError in this thread after so long; workers of a cluster compute outside the main thread."""
    raised = ctypes.py_object(TimeoutError)
    thread = ctypes.c_ulong(threading.get_ident())
    timer = threading.Timer(seconds, ctypes.pythonapi.PyThreadState_SetAsyncExc, (thread, raised))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def judged(result: ReplayResult, cell: Cell) -> dict[str, Any]:
    """Verdict, errors and what becomes of them."""
    path = result.estimate.trajectory
    finite = bool(np.isfinite(path.position_m).all() and np.isfinite(path.covariance).all())
    if not finite:
        return {"outcome": "not_finite"}
    off_m, beyond = error_of(result, cell.log, cell.mode)
    wrong = off_m > FAR_M or beyond > STRAY
    value = result.verdict.value
    outcome = "silent" if wrong and value == "good" else "warned" if wrong else "ok"
    return {
        "outcome": outcome,
        "verdict": value,
        "off_m": round(off_m, 2),
        "beyond": round(beyond, 3),
        "why": [reason[:120] for reason in result.verdict.reasons],
    }


def table(rows: list[dict[str, Any]]) -> str:
    """Counts by fault, by log and mode, and the cells that failed."""
    lines = [f"cells {len(rows)}"]
    total = Counter(row["outcome"] for row in rows)
    names = ("ok", "warned", "refused", *BAD)
    for name in names:
        lines.append(f"{name} {total[name]} of {len(rows)}")
    for part, numbers in (
        ("", range(10**9)),
        ("developed: ", range(DEVELOPED)),
        ("judged: ", range(DEVELOPED, 10**9)),
    ):
        own = [row for row in rows if row["number"] in numbers]
        right = [row for row in own if row["outcome"] == "ok"]
        doubted = sum(row["verdict"] != "good" for row in right)
        lines.append(f"{part}ok and yet not good {doubted} of {len(right)}")
        if part:
            lines.append(f"{part}silent {sum(row['outcome'] == 'silent' for row in own)} of {len(own)}")
    lines += ["", "Reasons for right results that are not good (a cell may have several):", ""]
    lines += [f"- {count} {reason}" for reason, count in doubts(rows).most_common()]
    lines += ["", "| fault | cells | " + " | ".join(names) + " |", "| --- " * (len(names) + 2) + "|"]
    for fault in FAULTS:
        own = Counter(row["outcome"] for row in rows if fault in row["faults"])
        lines.append(f"| {fault} | {sum(own.values())} | " + " | ".join(str(own[n]) for n in names) + " |")
    for key in ("log", "mode", "batch"):
        for value in sorted({row[key] for row in rows}):
            own = Counter(row["outcome"] for row in rows if row[key] == value)
            counts = " | ".join(str(own[n]) for n in names)
            lines.append(f"| {key} {value} | {sum(own.values())} | {counts} |")
    failed = [row for row in rows if row["outcome"] in BAD]
    lines += ["", "Cells that failed:", ""]
    for row in failed:
        lines.append(
            f"- {row['number']} {row['outcome']}: {' + '.join(row['faults'])}; {row['log']}, {row['mode']}, "
            f"{'batch' if row['batch'] else 'live'}: {row.get('off_m')} m, {row.get('beyond')} beyond 5 sigma"
        )
    return "\n".join(lines)


def doubts(rows: list[dict[str, Any]]) -> Counter[str]:
    """Right results that are not called good, by reason without its numbers."""
    found = Counter[str]()
    for row in rows:
        if row["outcome"] == "ok" and row["verdict"] != "good":
            checked = [why.startswith("Log check, ") for why in row["why"]]
            found["cells in which a log check alone names a fault"] += all(checked)
            found.update(
                {re.sub(r"[0-9][0-9.]*", "N", why.split(" (")[0].split(";")[0]) for why in row["why"]}
            )
    return found


def run(
    cells: int, workers: TaskWorkers, out: Path, first: int = 0, faults: Sequence[str] = tuple(FAULTS)
) -> list[dict[str, Any]]:
    """Try cells with one of `faults` in turn until all are done or the time is over.

    What is in `out`, of this code, is not done again.
    """
    logs = (*TWIN, *FIELD) if os.environ.get("TERRAFUSION_DATA", "") else TWIN
    code = f"{library_code()} {code_of(*sorted(Path(__file__).parent.glob('*.py')))}"
    drawn = (Cell.drawn(number, logs) for number in range(first, first + cells))
    tasks = [Task(f"cell {cell}", code, cell) for cell in drawn if set(faults) & set(cell.faults)]
    run_all(tasks, tried, out / "parts", workers)
    return [row for task in tasks if (row := result_of(task, out / "parts")) is not None]


def main() -> int:
    """Run and print the table; 0, or 1 after a known error."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--cells", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--faults", nargs="*", choices=[*FAULTS], default=[*FAULTS])
    parser.add_argument("--out", type=Path, required=True)
    add_options(parser)
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    try:
        rows = run(given.cells, TaskWorkers.of(given), given.out, given.first, given.faults)
    except TerrafusionError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(table(rows))
    return 0


if __name__ == "__main__":
    from tests.studies.fault_matrix import matrix

    sys.exit(matrix.main())  # workers know the cells by the module's own name
