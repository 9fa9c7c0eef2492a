"""Outages after coarse fixes on ground that slips and ground that does not: with the drift watched or not.

    python -m tests.studies.coarse_slides [LOG...]

Fixes of a stand-alone receiver are made from the truth of the longest run of each log. Developed on the logs
of `DEVELOPED`; the others judge. Printed: mean error at the end of the outages, m, and share of the errors
inside their 95 % ellipses; last the ratio of errors with a 95 % interval (bootstrap over logs).
"""

from __future__ import annotations

import argparse
from pathlib import Path
from unittest.mock import patch

import numpy as np

from terrafusion.fusion.estimator.drift_watch import DriftWatch
from tests.studies.field_runs import catalogued
from tests.studies.opponents import ours
from tests.studies.opponents.drives import Drive, drives_of, longest, vehicle_of
from tests.studies.opponents.protocol import streams_of
from tests.studies.parts import TaskWorkers, add_options, answers

DEVELOPED = (
    "norlab_drive/gravel_2024_8_6_11h37s32/windows", "norlab_drive/ice_2024_7_30_16h30s21/windows",
    "norlab_drive/grass_2024_7_29_14h4s53/raw", "norlab_drive/asphalt_2024_9_25_12h8s57/raw",
)  # fmt: skip
SECONDS = (10.0, 30.0)


def rows_of(drive: Drive, seconds: float, watched: bool) -> tuple[int, float, float]:
    """Number of outages, mean error at their end, share inside."""
    streams = streams_of(drive.recording, vehicle_of(drive.recording, None))
    if streams is None or not streams.passes(seconds):
        return 0, np.nan, np.nan
    refused = patch.object(DriftWatch, "test_wheels", lambda *_: False)
    if watched:
        rows, _ = ours.rows(drive.recording, streams, seconds, "fixed")
    else:
        with refused:
            rows, _ = ours.rows(drive.recording, streams, seconds, "fixed")
    inside = [row.share_inside for row in rows if row.share_inside is not None]
    return len(rows), float(np.mean([r.error_m for r in rows])), float(np.mean(inside)) if inside else np.nan


def compared(name: str) -> list[tuple[float, int, float, float, float, float]]:
    """Of one log: seconds, outages, error without and with the watch, shares inside likewise."""
    found = []
    for drive in longest(drives_of(f"{name}@consumer"), 1):
        for seconds in SECONDS:
            n, before_m, held = rows_of(drive, seconds, watched=False)
            if n:
                _, after_m, holds = rows_of(drive, seconds, watched=True)
                found.append((seconds, n, before_m, after_m, held, holds))
    return found


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.coarse_slides")
    norlab = [name for name in catalogued() if name.startswith("norlab_drive/")]
    parser.add_argument("logs", nargs="*", default=[*DEVELOPED, *(n for n in norlab if n not in DEVELOPED)])
    parser.add_argument("--out", type=Path, help="folder for parts; the same command continues")
    add_options(parser)
    given = parser.parse_args()
    print(f"{'log':>48} {'s':>3} {'n':>3} {'error':>7} {'watched':>7} {'inside':>7} {'watched':>7}")
    logs: dict[str, list[float]] = {}
    found = answers(given.logs, compared, TaskWorkers.of(given), given.out)
    for name, rows in zip(given.logs, found, strict=True):
        for seconds, n, *figures in rows:
            print(f"{name:>48} {seconds:3.0f} {n:3d} {' '.join(f'{x:7.2f}' for x in figures)}")
            part = "developed" if name in DEVELOPED else "judged"
            logs.setdefault(f"{part} {name}", []).append(np.log(figures[1] / figures[0]))
    rng = np.random.default_rng(0)
    for part in ("developed", "judged"):
        x = np.array([np.mean(v) for name, v in logs.items() if name.startswith(part)])
        if not len(x):
            continue
        spread = np.quantile(rng.choice(x, (4000, len(x))).mean(axis=1), [0.025, 0.975])
        low, high = np.exp(spread)
        print(f"{part}: watched over not, {len(x)} logs: {np.exp(x.mean()):.2f} [{low:.2f}, {high:.2f}]")
    return 0


if __name__ == "__main__":
    from tests.studies import coarse_slides

    raise SystemExit(coarse_slides.main())  # workers know the logs by the module's own name
