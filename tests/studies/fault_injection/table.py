"""Known changes in real logs, and what the diagnosis names: a table.

    python -m tests.studies.fault_injection.table --out injections [--set wvu_s5t1 ...]

A log is cut into pieces. In turn, every fourth piece is judged and the others are its references; the change
is put into the judged ones only. Unchanged pieces are judged likewise: a gap found there is a false alarm,
or a change within the drive. Pieces in which the robot rests are left out. A crash is a wrong answer.
Answers are kept one by one; the same command continues where it was stopped.
"""

from __future__ import annotations

import argparse
import functools
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.files import check_folder
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.segments import segment, segment_spans
from terrafusion.datasets.readers import open_recordings
from terrafusion.twin.gap.blind.rates import Rate
from terrafusion.twin.gap.diagnose import diagnose
from terrafusion.twin.gap.rollout.sensitivities import Linearisation
from terrafusion.twin.model.vehicle import VehicleParams, load_vehicle
from terrafusion.twin.model.version import model_sha256
from tests.studies.fault_injection.faults import INJECTIONS, Injection, pose_as_gnss
from tests.studies.parts import Task, TaskWorkers, add_options, result_of, run_all

SEVERITIES = (0.5, 1.0, 2.0, 4.0)
SUSPECTS = (
    "encoder_scale", "wheel_radius", "wheel_radius_asymmetry", "gnss_latency", "gnss_lever_arm",
    "imu_yaw_misalignment", "imu_time_offset", "gyro_bias", "gyro_scale", "accel_bias", "track_width",
    "soil_strength", "left_right_friction",
)  # fmt: skip
"""What a test team would ask about after work on wheels and sensors: fewer effects to choose from."""
FOLDS = 4
LEAST_SPEED_MPS = 0.15
"""Mean rim speed of a piece that counts as driven."""


@dataclass(frozen=True)
class LogSet:
    """Logs of one robot on one ground, and how they are cut.

    Attributes:
        pose_sigma_m: the log's reference pose is taken as GNSS with this sigma; None: it is not used.
    """

    logs: tuple[str, ...]
    vehicle: str
    piece_s: float
    soil: str | None = None
    pose_sigma_m: float | None = None


_ASPHALT = ("norlab_drive/asphalt_2024_9_20_8h13s12/raw", "norlab_drive/asphalt_2024_9_25_12h8s57/raw")
_GRASS = (
    "norlab_drive/grass_2024_7_29_14h46s15/raw", "norlab_drive/grass_2024_7_29_14h4s53/raw",
    "norlab_drive/grass_2024_8_8_15h56s39/raw", "norlab_drive/grass_2024_8_8_16h11s19/raw",
)  # fmt: skip
SETS = {
    "wvu_s5t1": LogSet(("wvu_pathfinder/s5t1",), "pathfinder", 12.0),
    "wvu_test17run": LogSet(("wvu_pathfinder/test17run",), "pathfinder", 6.0),
    "husky_parkinglot": LogSet(("husky_parkinglot/test1",), "husky", 20.0, "asphalt"),
    "norlab_asphalt": LogSet(_ASPHALT, "warthog", 10.0),
    "norlab_grass": LogSet(_GRASS, "warthog", 20.0),
    "norlab_grass_pose": LogSet(_GRASS, "warthog", 20.0, pose_sigma_m=0.05),
    "umich_mair": LogSet(("umich_husky/mair_mocap/trial1", "umich_husky/mair_mocap/trial7"), "husky", 8.0),
    "umich_field": LogSet(
        ("umich_husky/field/slip_detect2", "umich_husky/field/sand_small_pebble"), "husky", 10.0
    ),
}
"""What the catalogue has; the poses of `norlab_grass_pose` are lidar ICP taken as GNSS of 5 cm (assumed)."""


@dataclass(frozen=True, eq=False)
class Source:
    """The logs of a set, opened, and the pieces of each that are driven."""

    vehicle: VehicleParams
    recordings: list[Recording]
    spans: list[tuple[int, float, float]]
    cache: dict[int, dict[str, Linearisation]] = field(default_factory=dict)

    @classmethod
    def of(cls, logs: LogSet) -> Source:
        vehicle = load_vehicle(logs.vehicle)
        recordings = [r for name in logs.logs for r in open_recordings(name, rig=vehicle.rig())]
        if logs.pose_sigma_m is not None:
            recordings = [pose_as_gnss(r, logs.pose_sigma_m) for r in recordings]
        found = []
        for i, recording in enumerate(recordings):
            for begin, end in segment_spans(recording, logs.piece_s):
                if driven(segment(recording, begin, end), vehicle):
                    found.append((i, begin, end))
        return cls(vehicle, recordings, found)

    def judged(self, fold: int) -> list[int]:
        """Numbers of the pieces that are judged in a fold."""
        return list(range(fold % FOLDS, len(self.spans), FOLDS))

    def cache_for(self, fold: int) -> dict[str, Linearisation]:
        """Linearisations of a fold; those of another are dropped."""
        if fold not in self.cache:
            self.cache.clear()
        return self.cache.setdefault(fold, {})

    def cut(
        self, numbers: Sequence[int], injection: Injection | None = None, severity: float = 0.0
    ) -> list[Recording]:
        """Pieces, with the change in them where one is given.

        Raises:
            DataError: the logs do not have its channel.
        """
        logs = [i for i, _, _ in (self.spans[k] for k in numbers)]
        changed = {
            i: self.recordings[i]
            if injection is None
            else injection.into(self.recordings[i], self.vehicle, severity)
            for i in dict.fromkeys(logs)
        }
        return [segment(changed[i], begin, end) for i, begin, end in (self.spans[k] for k in numbers)]


def driven(run: Recording, vehicle: VehicleParams) -> bool:
    """Whether the robot moves in a piece."""
    if run.wheels is None or len(run.wheels) < 3:
        return False
    speed = run.wheels.side_speeds_mps(vehicle.odometry.wheel_radius_m)
    return bool(np.nanmean(np.abs(speed)) > LEAST_SPEED_MPS)


def verdict_on(answer: dict[str, Any], injection: Injection | None) -> dict[str, Any]:
    """What an answer says, and whether it is right: a gap whose first cause has the change in its class."""
    causes = answer["causes"]
    first = causes[0]
    wanted = () if injection is None else injection.named
    ranks = [k for k, c in enumerate(causes) if c["effect"] in wanted]
    rank = ranks[0] + 1 if ranks else None
    seen = answer["gap"]["detected"]
    named = seen and answer["verdict"] in ("effect", "ambiguous", "parameters")
    right = not seen if injection is None else bool(named and set(first["class"]) & set(wanted))
    return {
        "p_value": answer["gap"]["p_value"], "verdict": answer["verdict"], "first": first["effect"],
        "class": first["class"], "named": answer["named"], "rank": rank, "right": right,
        "estimate": None if injection is None or rank is None else estimated(causes[rank - 1], injection),
        "share": (answer["shrink"] or {}).get("share"),
    }  # fmt: skip


def estimated(cause: dict[str, Any], injection: Injection) -> list[float] | None:
    """Size and one sigma of the change, in its unit, as its best cause has it."""
    for key, factor in injection.estimates.items():
        if key in cause["parameters"]:
            told = cause["parameters"][key]
            return [factor * told["value"], abs(factor) * (told["sigma"] or 0.0)]
    return None


def cases(logs: Sequence[str]) -> Iterator[tuple[str, Injection | None, float, int]]:
    """Set, change, severity and fold of every row: in each fold nothing, which comes first as it shows the
    false alarms, and changes in turn."""
    changes = [(i, j) for i in range(len(INJECTIONS)) for j in range(len(SEVERITIES))]
    for name in logs:
        for fold in range(FOLDS):
            yield name, None, 0.0, fold
    for name in logs:
        for fold in range(FOLDS):
            for i, j in changes:
                if (j - i) % FOLDS == fold:  # the severities of a change fall on different pieces
                    yield name, INJECTIONS[i], SEVERITIES[j], fold


def answered(
    source: Source,
    logs: LogSet,
    injection: Injection | None,
    severity: float,
    fold: int,
    effects: Sequence[str] | None = None,
) -> dict[str, Any]:
    """One row: the diagnosis of a fold's pieces with the change in them, among some effects or all."""
    judged = source.judged(fold)
    others = [k for k in range(len(source.spans)) if k not in judged]
    began = time.perf_counter()
    try:
        runs = source.cut(judged, injection, severity)
    except TerrafusionError as error:
        return {"skipped": str(error)}
    try:
        normal, cache = source.cut(others), source.cache_for(fold)
        answer = diagnose(
            runs, normal, source.vehicle, logs.soil, effects=effects, source="wheels", cache=cache
        ).to_json()
    except Exception as error:  # a crash is a wrong answer, whatever it was
        return {"crash": f"{type(error).__name__}: {error}", "right": False}
    told = verdict_on(answer, injection)
    return {**told, "runs": len(judged), "references": len(others), "elapsed_s": time.perf_counter() - began}


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the table, or go on with it; 0, or 1 after a known error."""
    parser = argparse.ArgumentParser(description="Known changes in real logs, and what the diagnosis names.")
    parser.add_argument("--out", type=Path, required=True, help="folder for the answers and the table")
    parser.add_argument("--set", action="append", choices=sorted(SETS), help="logs; default: all")
    parser.add_argument(
        "--suspects", action="store_true", help="only sensors, wheels and ground, see SUSPECTS"
    )
    parser.add_argument("--unchanged", action="store_true", help="no changes: false alarms alone")
    parser.add_argument("--sum", action="store_true", help="run nothing: sums of the answers that are there")
    add_options(parser)
    given = parser.parse_args(arguments)
    workers = None if given.sum else TaskWorkers.of(given)
    try:
        effects = SUSPECTS if given.suspects else ()
        run(given.out, given.set or sorted(SETS), effects, workers, unchanged=given.unchanged)
    except TerrafusionError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def run(
    out: Path,
    sets: Sequence[str],
    effects: Sequence[str],
    workers: TaskWorkers | None,
    unchanged: bool = False,
) -> None:
    """The table of some sets, written to `out`; rows of other sources or effects are made anew.

    Args:
        effects: to choose from; none for the whole catalogue.
        workers: None to run nothing.
        unchanged: judge segments as they are alone.

    Raises:
        TerrafusionError: a log is not at hand or cannot be read, or the folder cannot be written.
    """
    check_folder(out)
    code = f"{model_sha256()} {' '.join(effects)}"
    tasks = []
    for name, injection, severity, fold in cases(sets):
        if unchanged and injection is not None:
            continue
        change = None if injection is None else INJECTIONS.index(injection)
        what = (name, change, severity, fold, tuple(effects) or None)
        tasks.append(Task("/".join(map(str, what[:4])), code, what))
    if workers is not None:
        run_all(tasks, row_of, out / "parts", workers)
    rows = [row for task in tasks if (row := result_of(task, out / "parts")) is not None]
    text = "\n".join([*sums(rows), "", *table(rows)])
    (out / "injections.md").write_text(text + "\n", encoding="utf-8")
    print(text)


@functools.lru_cache(maxsize=1)
def source_of(name: str) -> Source:
    """The logs of a set, read once in a process."""
    return Source.of(SETS[name])


def row_of(case: tuple[str, int | None, float, int, tuple[str, ...] | None]) -> dict[str, Any]:
    """One row: set, number of the change, severity, fold, and the effects to choose from."""
    name, change, severity, fold, effects = case
    injection = None if change is None else INJECTIONS[change]
    found = answered(source_of(name), SETS[name], injection, severity, fold, effects)
    what, size = ("unchanged", 0.0) if injection is None else (injection.name, severity * injection.size)
    return {"set": name, "change": what, "severity": severity, "size": size, **found}


HEAD = ("set", "change", "size", "p", "verdict", "first (class)", "rank", "estimated", "right")


def table(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Rows as lines of a Markdown table."""
    lines = ["| " + " | ".join(HEAD) + " |", "|" + " --- |" * len(HEAD)]
    for row in rows:
        lines.append("| " + " | ".join([row["set"], row["change"], f"{row['size']:g}", *_told(row)]) + " |")
    return lines


def sums(rows: Sequence[dict[str, Any]]) -> list[str]:
    """By set, then by change with a column a severity: Markdown tables."""
    nulls = [row for row in rows if row["change"] == "unchanged" and "skipped" not in row]
    alarms = Rate(sum(not row["right"] for row in nulls), len(nulls))
    low, high = alarms.interval()
    lines = [
        f"Alarms on unchanged segments: {alarms.hits} of {alarms.count} ({low:.2f} to {high:.2f})",
        "",
        "| logs | unchanged: alarms | changes | seen | right | change first; of three | no channel for |",
        "|" + " --- |" * 7,
    ]
    for name in dict.fromkeys(row["set"] for row in rows):
        mine = [row for row in rows if row["set"] == name]
        missing = dict.fromkeys(row["change"] for row in mine if "skipped" in row)
        told = [row for row in mine if "skipped" not in row]
        still, judged = ([r for r in told if (r["change"] == "unchanged") == same] for same in (True, False))
        false = f"{sum(not r['right'] for r in still)} of {len(still)}"
        first = f"{_ranked(judged, 1)}; {_ranked(judged, 3)}"
        right = sum(r["right"] for r in judged)
        counts = [false, len(judged), sum(map(_seen, judged)), right, first, ", ".join(missing)]
        lines.append("| " + " | ".join([f"`{name}`", *map(str, counts)]) + " |")
    changed = [row for row in rows if row["change"] != "unchanged" and "skipped" not in row]
    heads = [f"severity {severity:g}: seen, first, right" for severity in SEVERITIES]
    lines += ["", "| change (size at 1) | " + " | ".join(heads) + " |", "|" + " --- |" * (1 + len(heads))]
    for injection in INJECTIONS:
        cells = []
        for severity in SEVERITIES:
            some = [r for r in changed if (r["change"], r["severity"]) == (injection.name, severity)]
            right = sum(r["right"] for r in some)
            cells.append(f"{sum(map(_seen, some))}, {_ranked(some, 1)}, {right} of {len(some)}")
        size = f"{injection.name} ({injection.size:g} {injection.unit})".replace(" )", ")")
        lines.append(f"| {size} | " + " | ".join(cells) + " |")
    return lines


def _seen(row: dict[str, Any]) -> bool:
    return bool(row.get("verdict", "no_gap") != "no_gap")


def _ranked(rows: Sequence[dict[str, Any]], within: int) -> int:
    """Rows in which the change, or one it cannot be told from, is among the first causes."""
    return sum(row.get("rank") is not None and row["rank"] <= within for row in rows)


def _told(row: dict[str, Any]) -> list[str]:
    if "skipped" in row:
        return ["", "cannot be judged", row["skipped"], "", "", ""]
    if "crash" in row:
        return ["", "crash", row["crash"], "", "", "no"]
    others = [name for name in row["class"] if name != row["first"]]
    first = row["first"] + (f" ({', '.join(others)})" if others else "")
    size = "" if row["estimate"] is None else "{:.3g} +- {:.2g}".format(*row["estimate"])
    rank = "" if row["rank"] is None else str(row["rank"])
    return [f"{row['p_value']:.3f}", row["verdict"], first, rank, size, "yes" if row["right"] else "no"]


if __name__ == "__main__":
    sys.exit(main())
