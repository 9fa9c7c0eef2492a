"""Which term of dead reckoning an outage's error consists of, for terrafusion and the plain EKF.

    python -m tests.studies.opponents.decompose [LOG...] [--seconds 10] [--mode fixed]

Errors e(t) against the reference in an outage are fitted by the linear error model of planar dead reckoning,

    e(t) = e0 + heading J d(t) + scale d(t) + drift J (t d(t) - integral of d) ,  J = turn by 90 deg,

with the displacement d(t) of the reference since the start (Borenstein and Feng 1996, systematic errors of
odometry, continuous form). The table gives the length of each term at the end of the outage, m, as a mean
over outages, and what the four leave. Where the reference is held-out fixes that are not RTK, `as read` is
terrafusion's position plus the receiver's drift that it estimates: what the fixes should read. They hold
that drift, too.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from terrafusion.fusion.api.replays import replay
from terrafusion.fusion.metrics.scores import Outage
from tests.studies.opponents import ekf, estimators, ins, smoother
from tests.studies.opponents.drives import Drive, all_drives, longest, vehicle_of
from tests.studies.opponents.inertial import Inertial
from tests.studies.opponents.protocol import Streams, blocked_in

Array = NDArray[np.float64]
TERMS = ("end", "start", "heading", "scale", "drift", "rest", "signed scale %", "heading deg")
LOGS = (
    "norlab_drive/gravel_2024_8_6_11h37s32/windows",
    "norlab_drive/grass_2024_8_8_15h56s39/raw",
    "norlab_drive/asphalt_2024_9_20_9h27s52/windows",
    "umich_husky/mair_mocap/trial1",
    "wvu_pathfinder/s5t1",
    "wvu_pathfinder/test17run",
)
"""Logs of the tuning half, and one on which an RTK receiver makes the start of an outage easy to judge."""
RTK_M = 0.1
"""Fixes with a smaller sigma hold next to nothing of the drift state."""
DRIFT = ("gnss_drift_e_m", "gnss_drift_n_m")
RIDGE = np.array([1e-4, 1e-4, 1e-3, 1e-3, 1e-1])
"""Weak prior information, so that terms that an outage does not tell apart are shared out, not blown up."""


@dataclass(frozen=True)
class Path:
    """Times (N,), s, and positions (N, 2), m, of the point the reference is of."""

    t_s: Array
    xy_m: Array


def terms(path: Path, streams: Streams, start_s: float, seconds: float) -> Array | None:
    """The numbers of `TERMS` for one outage; None with fewer than four references in it."""
    r = streams.reference
    r = r[(r[:, 0] >= start_s) & (r[:, 0] < start_s + seconds - 1e-6)]
    if len(r) < 4:
        return None
    at = np.column_stack([np.interp(r[:, 0], path.t_s, path.xy_m[:, c]) for c in (0, 1)])
    e = (at - r[:, 1:]) @ np.array([1.0, 1.0j])
    d = (r[:, 1:] - r[0, 1:]) @ np.array([1.0, 1.0j])
    t = r[:, 0] - r[0, 0]
    area = np.r_[0.0, np.cumsum(0.5 * (d[1:] + d[:-1]) * np.diff(t))]
    columns = np.column_stack([np.ones_like(d), 1j * np.ones_like(d), 1j * d, d, 1j * (t * d - area)])
    A, b = np.vstack([columns.real, columns.imag]), np.r_[e.real, e.imag]
    x = np.linalg.solve(A.T @ A + np.diag(RIDGE * len(r)), A.T @ b)
    last = columns[-1] * x
    lengths = [abs(last[0] + last[1]), *np.abs(last[2:]), abs(e[-1] - last.sum())]
    return np.array([abs(e[-1]), *lengths, 100.0 * x[3], np.degrees(x[2])])


def paths_of(drive: Drive, inputs: Inertial, seconds: float, mode: str) -> list[tuple[str, float, Path]]:
    """Name of the estimator, start of the outage and its path, for all outages."""
    out = []
    streams = inputs.streams
    antenna = np.array(vehicle_of(drive.recording, None).rig().sensors.gnss.antenna_m, dtype=float)
    of_antenna = len(streams.reference) == len(streams.fixes)
    for starts in streams.passes(seconds):
        blocked = blocked_in(starts, seconds)
        runs = {"EKF": Path(*ekf.run(streams, blocked))}
        runs["GTSAM"] = Path(*smoother.run(inputs, blocked, estimators.noise_of("GTSAM smoother")))
        runs["INS"] = Path(*ins.run(inputs, blocked, estimators.noise_of("INS")))
        result = replay(drive.recording, mode=mode, outages=[Outage(round(a, 3), seconds) for a in starts])
        estimate = result.estimate
        point = np.zeros(3)
        if of_antenna or drive.recording.truth_frame == "antenna":
            point = antenna
        poses = estimate.trajectory
        xy: Array = (poses.position_m + Rotation.from_quat(poses.quaternion).apply(point))[:, :2]
        t_s: Array = np.asarray((poses.t_ns - drive.recording.start_ns) * 1e-9, dtype=float)
        runs[mode] = Path(t_s, xy)
        if of_antenna and estimate.linear is not None and float(np.median(inputs.fixes[:, 4])) > RTK_M:
            drift = [estimate.linear_names.index(name) for name in DRIFT]
            runs["as read"] = Path(t_s, xy + estimate.linear[:, drift])
        out += [(name, a, path) for name, path in runs.items() for a in starts]
    return out


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.opponents.decompose")
    parser.add_argument("logs", nargs="*", default=LOGS)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--mode", default="fixed")
    given = parser.parse_args()
    print(f"{'log':>46} {'n':>3} {'estimator':>9} " + " ".join(f"{name:>14}" for name in TERMS))
    for drive in longest(all_drives(given.logs), 1):
        inputs = Inertial.of(drive.recording, vehicle_of(drive.recording, None))
        if inputs is None or not inputs.streams.passes(given.seconds):
            continue
        found: dict[str, list[Array]] = {}
        for name, start_s, path in paths_of(drive, inputs, given.seconds, given.mode):
            row = terms(path, inputs.streams, start_s, given.seconds)
            if row is not None:
                found.setdefault(name, []).append(row)
        for name, rows in found.items():
            numbers = " ".join(f"{x:14.3f}" for x in np.mean(rows, axis=0))
            print(f"{drive.name:>46} {len(rows):3d} {name:>9} {numbers}", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
