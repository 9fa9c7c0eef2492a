"""Hours of live data, faster than real time: do memory, computing time and snapshots stay bounded?

    python -m tests.studies.soak --hours 3

A drive of the twin, IMU at 100 Hz, is repeated, each run going on where the last one ended, with ground
memory on, with self-calibration and, for a third of the time, with calibration states in the graph. Odometry
is asked for at 50 Hz, as by `terrafusion live`. Computing time is CPU time of the calls that make a keyframe.
Memory and snapshots are compared with those after the first run, in which the estimator fills its buffers.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import multiprocessing
import os
import sys
import time
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.frames import quaternion_to_matrix
from terrafusion.datasets.core.messages import ImuSample
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.grounds.memory import GroundMemory
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.simulate import simulate

Array = NDArray[np.float64]

SCENARIO = "mixed_terrain"
WINDOW_S = 600.0
"""Length of the windows at both ends whose computing times are compared."""
ODOMETRY_NS = 20_000_000
MOST_MB, MOST_SLOWER, MOST_LARGER = 15.0, 1.2, 1.2
"""Allowed growth of memory, ratio of the last to the first 99th percentile, and of snapshots to the first."""


def repeated(recording: Recording) -> Iterator[Recording]:
    """A run again and again, each beginning where and when the one before ended.

    Time runs on and so do the encoders; the fixes are turned and shifted in the plane by the truth.

    Raises:
        DataError: the run has no truth.
    """
    truth, imu, wheels, gnss = recording.truth, recording.imu, recording.wheels, recording.gnss
    if truth is None or truth.quaternion is None or imu is None or wheels is None or gnss is None:
        raise DataError("only a run with truth, IMU, wheels and GNSS can be repeated")
    lasts_ns = int(imu.t_ns[-1] - imu.t_ns[0]) + round(float(np.median(np.diff(imu.t_ns))))
    yaw = np.unwrap(np.arctan2(*quaternion_to_matrix(truth.quaternion[[0, -1]])[:, [1, 0], 0].T))
    R, shift = np.eye(3), np.zeros(3)
    angle = wheels.angle_rad
    rolled = np.zeros(0) if angle is None else angle[-1] - angle[0]
    step = _about_z(yaw[1] - yaw[0])
    for n in itertools.count():
        after = n * lasts_ns
        yield dataclasses.replace(
            recording,
            imu=dataclasses.replace(imu, t_ns=imu.t_ns + after),
            wheels=dataclasses.replace(
                wheels, t_ns=wheels.t_ns + after, angle_rad=None if angle is None else angle + n * rolled
            ),
            gnss=dataclasses.replace(
                gnss,
                t_ns=gnss.t_ns + after,
                enu_m=gnss.enu_m @ R.T + shift,
                velocity_enu_mps=None if gnss.velocity_enu_mps is None else gnss.velocity_enu_mps @ R.T,
            ),
            command=None,
            barometer=None,
            motor=None,
            terrain=None,
        )
        shift = shift + R @ (truth.position_m[-1] - step @ truth.position_m[0])
        R = R @ step


def _about_z(angle_rad: float) -> Array:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def resident_mb() -> float:
    """Memory in use by this process, MB (Linux)."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") * 1e-6


@dataclass
class Soak:
    """What was measured: a row a run; CPU time (ms) of each call that made a keyframe, and its time (s)."""

    end_s: list[float] = field(default_factory=list)
    used_mb: list[float] = field(default_factory=list)
    dump_kb: list[float] = field(default_factory=list)
    at_s: Sequence[float] = field(default_factory=lambda: array("f"))
    cpu_ms: Sequence[float] = field(default_factory=lambda: array("f"))

    def p99_ms(self, begin_s: float, end_s: float) -> float:
        """99th percentile of the computing times of a window."""
        at = np.array(self.at_s)
        return float(np.percentile(np.array(self.cpu_ms)[(at >= begin_s) & (at <= end_s)], 99))

    def lines(self, name: str) -> Iterator[str]:
        """The figures, one a line."""
        last_s, window_s = self.end_s[-1], min(WINDOW_S, 0.5 * self.end_s[-1])
        first, last = self.p99_ms(0.0, window_s), self.p99_ms(last_s - window_s, last_s)
        grown_mb, dump_kb = self.used_mb[-1] - self.used_mb[0], max(self.dump_kb)
        met = grown_mb <= MOST_MB and last <= MOST_SLOWER * first and dump_kb <= MOST_LARGER * self.dump_kb[0]
        yield f"{name}: hours {last_s / 3600.0:.2f}"
        yield f"{name}: memory {self.used_mb[0]:.1f} to {self.used_mb[-1]:.1f} MB, grown {grown_mb:.1f} MB"
        yield f"{name}: p99 {first:.2f} ms, at the end {last:.2f} ms, ratio {last / first:.2f}"
        yield (
            f"{name}: snapshot {self.dump_kb[0]:.0f} to {self.dump_kb[-1]:.0f} kB, largest {dump_kb:.0f} kB"
        )
        yield f"{name}: targets {'met' if met else 'missed'}"
        yield ""
        yield "| hour | memory, MB | p99 of ten minutes, ms | snapshot, kB |"
        yield "| --- | --- | --- | --- |"
        for hour in np.arange(0.5, last_s / 3600.0 + 0.25, 0.5).tolist():
            at_s = min(3600.0 * hour, last_s)
            i = int(np.searchsorted(self.end_s, at_s - 1e-6))
            p99 = self.p99_ms(at_s - window_s, at_s)
            yield f"| {at_s / 3600.0:.2f} | {self.used_mb[i]:.1f} | {p99:.2f} | {self.dump_kb[i]:.0f} |"


def soak(seconds: float, calibrate: bool, scenario: str = SCENARIO, longest_s: float = float("inf")) -> Soak:
    """Feed a live estimator for so long, and for `longest_s` of real time at most.

    `calibrate`: calibration states instead of self-calibration.
    """
    until = time.monotonic() + longest_s
    recording = simulate(scenario, seed=0)
    vehicle = load_vehicle("elevate")
    estimator = Estimator(
        EstimatorConfig(vehicle.rig(), vehicle.name, calibrate=calibrate, grounds=GroundMemory())
    )
    at_s, cpu_ms = array("f"), array("f")  # lists of floats would grow by 3 MB an hour
    found, begin_ns, asked = Soak(at_s=at_s, cpu_ms=cpu_ms), recording.start_ns, 0
    for again in repeated(recording):
        for message in again.messages():
            before, begun = estimator.latest(), time.thread_time()
            estimator.add(message)
            spent = time.thread_time() - begun
            if isinstance(message, ImuSample) and message.t_ns // ODOMETRY_NS > asked:
                asked = message.t_ns // ODOMETRY_NS
                estimator.odometry()
            # The call that starts the estimator makes all keyframes that waited for it.
            if before is not None and estimator.latest() is not before:
                at_s.append((message.t_ns - begin_ns) * 1e-9)
                cpu_ms.append(spent * 1e3)
        assert again.imu is not None
        found.end_s.append((int(again.imu.t_ns[-1]) - begin_ns) * 1e-9)
        found.used_mb.append(resident_mb())
        found.dump_kb.append(len(estimator.dump()) * 1e-3)
        print(f"{found.end_s[-1] / 3600.0:.2f} h: {found.used_mb[-1]:.1f} MB", file=sys.stderr, flush=True)
        if found.end_s[-1] >= seconds or time.monotonic() > until:
            break
    if not found.cpu_ms:
        raise DataError("the estimator never started")
    return found


def main() -> None:
    """Soak both kinds of calibration, each in a process of its own, and print their figures."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--hours", type=float, default=3.0)
    parser.add_argument("--seconds", type=float, default=7200.0, help="stop after so long, of real time")
    given = parser.parse_args()
    for name, calibrate, share in (("self-calibration", False, 1.0), ("calibration states", True, 1 / 3)):
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            found = pool.apply(
                soak, (share * 3600.0 * given.hours, calibrate, SCENARIO, share * given.seconds)
            )
        print("\n".join(found.lines(name)), end="\n\n", flush=True)


if __name__ == "__main__":
    main()
