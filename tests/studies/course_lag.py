"""By how much the course of a robot that skids follows its heading, from the truth of field logs.

    python -m tests.studies.course_lag [LOG...] [--runs 3]

In a turn at rate w a body at speed v drifts outwards by -a w - lag v w: `a` is the place of its centre of
rotation at walking pace, `lag` how that moves with the speed. Both are fitted to the lateral velocity of the
truth, by least squares over half seconds; the intervals leave out one eighth of the run after the other
(jackknife, Efron and Tibshirani 1993, sec. 11.5). A turned truth is a third unknown.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.frames import quaternion_to_matrix
from terrafusion.datasets.core.trajectory import Trajectory
from tests.studies.opponents.drives import Drive, default_logs, drives_of, longest

Array = NDArray[np.float64]

OVER_S, GAP, MOST_MPS = 0.5, 1.5, 5.0
"""Velocities are differences over the first; where the truth has gaps, or jumps, they are left out."""
LEAST_ROWS, PARTS = 200, 8


@dataclass(frozen=True)
class CourseLag:
    """Lag and its 1 sigma, s; place of the centre of rotation at walking pace and its 1 sigma, m."""

    lag_s: float
    lag_sigma_s: float
    place_m: float
    place_sigma_m: float


def motion(truth: Trajectory) -> Array:
    """Forward and lateral velocity, m/s, and yaw rate, rad/s: (N, 3)."""
    assert truth.quaternion is not None
    known = np.isfinite(truth.position_m[:, :2]).all(axis=1) & np.isfinite(truth.quaternion).all(axis=1)
    t_s = (truth.t_ns[known] - truth.t_ns[known][0]) * 1e-9
    place = truth.position_m[known, :2] @ np.array([1.0, 1.0j])
    axes = quaternion_to_matrix(truth.quaternion[known])
    yaw = np.unwrap(np.arctan2(axes[:, 1, 0], axes[:, 0, 0]))
    half = max(round(0.5 * OVER_S / float(np.median(np.diff(t_s)))), 1)
    dt = t_s[2 * half :] - t_s[: -2 * half]
    velocity = (place[2 * half :] - place[: -2 * half]) / dt * np.exp(-1j * yaw[half:-half])
    rate = (yaw[2 * half :] - yaw[: -2 * half]) / dt
    good = (dt < GAP * OVER_S) & (np.abs(velocity) < MOST_MPS)
    return np.column_stack([velocity.real, velocity.imag, rate])[good]


def fitted(rows: Array) -> CourseLag:
    """The numbers that explain the lateral velocity of `motion`."""
    forward, lateral, rate = rows.T
    terms = -np.column_stack([forward * rate, rate, forward])
    keep = np.arange(len(rows)) * PARTS // len(rows)
    found = np.linalg.lstsq(terms, lateral)[0]
    parts = [np.linalg.lstsq(terms[keep != k], lateral[keep != k])[0] for k in range(PARTS)]
    sigma = np.std(parts, axis=0) * np.sqrt(PARTS - 1)
    return CourseLag(float(found[0]), float(sigma[0]), float(found[1]), float(sigma[1]))


def with_heading(name: str, runs: int) -> list[Drive]:
    """The longest drives of a log whose truth has headings."""
    try:
        drives = longest([d for d in drives_of(name) if d.fixes in ("log", "rtk")], runs)
    except DataError:
        return []
    truths = [d.recording.truth for d in drives]
    return [
        d
        for d, truth in zip(drives, truths, strict=True)
        if truth is not None and truth.quaternion is not None
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a line a run, and the mean lag of each ground."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.course_lag", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)  # fmt: skip
    parser.add_argument("logs", nargs="*", metavar="LOG", help="by default all at hand")
    parser.add_argument("--runs", type=int, default=3, help="of a log with many runs, the longest")
    given = parser.parse_args(arguments)
    grounds: dict[str, list[CourseLag]] = {}
    print(f"{'log':60s} lag, s            centre of rotation, m")
    for drive in [d for name in given.logs or default_logs() for d in with_heading(name, given.runs)]:
        truth, recording = drive.recording.truth, drive.recording
        assert truth is not None
        rows = motion(truth)
        if len(rows) < LEAST_ROWS:
            continue
        one = fitted(rows)
        ground = f"{recording.vehicle} on {recording.terrain_name or 'unlabelled ground'}"
        grounds.setdefault(ground, []).append(one)
        print(
            f"{drive.log:60s} {one.lag_s:+.2f} +- {one.lag_sigma_s:.2f}   "
            f"{one.place_m:+.2f} +- {one.place_sigma_m:.2f}",
            flush=True,
        )
    for ground, found in grounds.items():
        weight = np.array([1.0 / max(one.lag_sigma_s, 0.01) ** 2 for one in found])
        mean = float(weight @ [one.lag_s for one in found] / weight.sum())
        low, high = min(one.lag_s for one in found), max(one.lag_s for one in found)
        print(f"{ground}: {mean:.2f} s, {low:.2f} to {high:.2f} s, {len(found)} runs")


if __name__ == "__main__":
    main()
