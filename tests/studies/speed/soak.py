"""Memory of an estimator over hours: a run of the twin is repeated, each going on where the last ended.

python -m tests.studies.speed.soak HOURS
"""

from __future__ import annotations

import dataclasses
import itertools
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.frames import quaternion_to_matrix
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.live.loop import run
from terrafusion.twin.simulate import simulate

Array = NDArray[np.float64]

SCENARIO = "mixed_terrain"


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
    import os

    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") * 1e-6


def soak(hours: float, print_line: Callable[[str], None] = print) -> tuple[Array, Array]:
    """Memory in use (MB) over running time (h), after every run, as two arrays."""
    recording = simulate(SCENARIO, seed=0)
    estimator = Estimator.for_vehicle("elevate")
    run_h: list[float] = []
    used_mb: list[float] = []
    for n, again in enumerate(repeated(recording), 1):
        run(estimator, again.messages(), lambda _: None)
        run_h.append(n * recording.duration_s() / 3600.0)
        used_mb.append(resident_mb())
        print_line(f"{run_h[-1]:.2f} h: {used_mb[-1]:.1f} MB, {estimator.status}")
        if run_h[-1] >= hours:
            return np.array(run_h), np.array(used_mb)
    raise AssertionError("repeated() never ends")


if __name__ == "__main__":
    hours, used_mb = soak(float(sys.argv[1]))
    slope = np.polyfit(hours[1:], used_mb[1:], 1)[0] if len(hours) > 2 else float("nan")
    print(f"after the first run: {used_mb[-1] - used_mb[0]:+.1f} MB, {slope:+.2f} MB/h")
