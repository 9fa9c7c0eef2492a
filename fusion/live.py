"""Live use, as a program: a recording is fed message by message, odometry comes out at the rate of the IMU.

    python -m terrafusion.fusion.live LOG [--vehicle NAME] [--realtime]
    python -m terrafusion.fusion.live --soak HOURS

The first prints how long updates and odometry take; `docs/integration.md` has
the same loop as a ROS 2 node. The second repeats a drive of the twin for so
many hours of running time and prints the memory in use.
"""

from __future__ import annotations

import argparse
import dataclasses
import heapq
import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.channels import Imu, Wheels
from terrafusion.datasets.core.errors import DataError, TerrafusionError
from terrafusion.datasets.core.frames import quaternion_to_matrix
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.config.sensor_config import complete_samples, imu_kind, sensor_config_of
from terrafusion.fusion.estimate.estimate import State
from terrafusion.fusion.estimator.estimator import Estimator

Array = NDArray[np.float64]

Message = tuple[int, str, Callable[[Estimator], None]]
"""Time, channel, and the call that gives the sample to an estimator."""

SOAK_SCENARIO = "mixed_terrain"


@dataclass
class Latencies:
    """Computing times, ms: of every `add_imu` that made a keyframe, of the others, and of `odometry`."""

    keyframe: list[float] = field(default_factory=list)
    sample: list[float] = field(default_factory=list)
    odometry: list[float] = field(default_factory=list)

    def lines(self) -> Iterator[str]:
        for spec in dataclasses.fields(self):
            values = getattr(self, spec.name)
            if values:
                p50, p99, worst = np.percentile(values, [50, 99, 100])
                told = f"p50 {p50:.3f} ms, p99 {p99:.3f} ms, max {worst:.3f} ms"
                yield f"{spec.name:9} {told}, {len(values)} calls"


def messages(recording: Recording, wheel_radius_m: float) -> Iterator[Message]:
    """The samples of a recording in the order of time, all others before the IMU of the same time.

    What `replay` gives is given here, too, a magnetometer excepted: encoder angles, velocity and class of the
    fixes, commands, pressures.

    Raises:
        DataError: no IMU, or no wheels.
    """
    kind = imu_kind(recording.imu)
    if recording.imu is None or recording.wheels is None or kind == "none":
        raise DataError(
            "the log lacks IMU or wheels", remedy="live use needs both; see `terrafusion inspect`"
        )
    imu = recording.imu.select(complete_samples(recording.imu, kind))
    streams = [
        _wheels(recording.wheels, wheel_radius_m), _gnss(recording), _commands(recording),
        _pressures(recording), _imu(imu),
    ]  # fmt: skip
    return heapq.merge(*streams, key=lambda message: message[0])


def _imu(imu: Imu) -> Iterator[Message]:
    for t_ns, gyro, accel in zip(imu.t_ns.tolist(), imu.gyro_radps, imu.accel_mps2, strict=True):
        yield t_ns, "imu", lambda e, t=t_ns, g=gyro, a=accel: e.add_imu(t, g, a)  # type: ignore[misc]


def _wheels(wheels: Wheels, radius_m: float) -> Iterator[Message]:
    rows = wheels.side_speeds_mps(radius_m)
    if wheels.angle_rad is not None and np.isfinite(wheels.angle_rad).all():
        turned = Wheels(wheels.t_ns, wheels.angle_rad, wheels.names, "radps")
        rows = np.hstack([rows, turned.side_speeds_mps(radius_m)])
    for t_ns, row in zip(wheels.t_ns.tolist(), rows.tolist(), strict=True):
        if np.isfinite(sum(row)):
            yield t_ns, "wheels", lambda e, t=t_ns, r=row: e.add_wheels(t, *r)  # type: ignore[misc]


def _gnss(recording: Recording) -> Iterator[Message]:
    gnss = recording.gnss
    if gnss is None:
        return
    for i, t_ns in enumerate(gnss.t_ns.tolist()):
        enu, sigma = gnss.enu_m[i], gnss.sigma_enu_m[i]
        if gnss.fix[i] and np.isfinite(enu[:2].sum() + sigma[:2].sum()):
            velocity = None if gnss.velocity_enu_mps is None else gnss.velocity_enu_mps[i]
            sigma_v = float("nan") if gnss.sigma_v_mps is None else float(gnss.sigma_v_mps[i])
            row = (enu, sigma, velocity, sigma_v, int(gnss.fix[i]))
            yield t_ns, "gnss", lambda e, t=t_ns, r=row: e.add_gnss(t, *r)  # type: ignore[misc]


def _commands(recording: Recording) -> Iterator[Message]:
    command = recording.command
    if command is None:
        return
    for t_ns, v in zip(command.t_ns.tolist(), command.v_mps.tolist(), strict=True):
        if np.isfinite(v):
            yield t_ns, "command", lambda e, t=t_ns, v=v: e.add_command(t, v)  # type: ignore[misc]


def _pressures(recording: Recording) -> Iterator[Message]:
    barometer = recording.barometer
    if barometer is None:
        return
    for t_ns, p in zip(barometer.t_ns.tolist(), barometer.pressure_pa.tolist(), strict=True):
        yield t_ns, "barometer", lambda e, t=t_ns, p=p: e.add_pressure(t, p)  # type: ignore[misc]


def run(
    estimator: Estimator,
    arriving: Iterator[Message],
    publish: Callable[[State], None],
    realtime: bool = False,
) -> Latencies:
    """Feed messages as they arrive and publish odometry after every IMU sample, once there is a start."""
    taken, began, first_ns = Latencies(), time.perf_counter(), None
    for t_ns, channel, give in arriving:
        first_ns = t_ns if first_ns is None else first_ns
        if realtime:
            time.sleep(max(0.0, (t_ns - first_ns) * 1e-9 - (time.perf_counter() - began)))
        before, begun = estimator.latest(), time.perf_counter()
        give(estimator)
        if channel != "imu":
            continue
        fed = time.perf_counter()
        state = estimator.odometry()
        done = time.perf_counter()
        made = estimator.latest() is not before
        (taken.keyframe if made else taken.sample).append((fed - begun) * 1e3)
        if state is not None:
            taken.odometry.append((done - fed) * 1e3)
            publish(state)
    return taken


def repeated(recording: Recording) -> Iterator[Recording]:
    """A drive again and again, each beginning where and when the one before ended.

    Time runs on and so do the encoders; the fixes are turned and shifted in the plane by the truth.

    Raises:
        DataError: the drive has no truth.
    """
    truth, imu, wheels, gnss = recording.truth, recording.imu, recording.wheels, recording.gnss
    if truth is None or truth.quaternion is None or imu is None or wheels is None or gnss is None:
        raise DataError("only a drive with truth, IMU, wheels and GNSS can be repeated")
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
    """Memory in use (MB) over running time (h), after every drive, as two arrays."""
    from terrafusion.twin.simulate import simulate

    drive = simulate(SOAK_SCENARIO, seed=0)
    estimator = Estimator.for_vehicle("elevate")
    run_h: list[float] = []
    used_mb: list[float] = []
    for n, again in enumerate(repeated(drive), 1):
        run(estimator, messages(again, estimator.config.rig.wheel_radius_m), lambda _: None)
        run_h.append(n * drive.duration_s() / 3600.0)
        used_mb.append(resident_mb())
        print_line(f"{run_h[-1]:.2f} h: {used_mb[-1]:.1f} MB, {estimator.status}")
        if run_h[-1] >= hours:
            return np.array(run_h), np.array(used_mb)
    raise AssertionError("repeated() never ends")


def main(arguments: list[str] | None = None) -> int:
    """The command line of the module's docstring."""
    parser = argparse.ArgumentParser(prog="python -m terrafusion.fusion.live")
    parser.add_argument("log", nargs="?", help="a log, as of `terrafusion replay`")
    parser.add_argument("--vehicle", help="name or YAML file; by default what the log says")
    parser.add_argument("--realtime", action="store_true", help="at the pace of the recording")
    parser.add_argument("--soak", type=float, metavar="HOURS", help="repeat a simulated drive for so long")
    asked = parser.parse_args(arguments)
    if (asked.log is None) == (asked.soak is None):
        parser.error("give a log, or --soak HOURS")
    try:
        if asked.soak is not None:
            hours, used_mb = soak(asked.soak)
            slope = np.polyfit(hours[1:], used_mb[1:], 1)[0] if len(hours) > 2 else float("nan")
            print(f"after the first drive: {used_mb[-1] - used_mb[0]:+.1f} MB, {slope:+.2f} MB/h")
        else:
            _live(asked.log, asked.vehicle, asked.realtime)
    except TerrafusionError as error:
        print(f"error: {error}")
        return 1
    return 0


def _live(log: str, vehicle: str | None, realtime: bool) -> None:
    from terrafusion.datasets.readers import open_recording
    from terrafusion.fusion.replay import choose_vehicle

    recording = open_recording(log)
    robot, _ = choose_vehicle(recording, vehicle)
    inputs = sensor_config_of(recording, recording.gnss)
    estimator = Estimator(EstimatorConfig(robot.rig(), robot.name, inputs=inputs))
    newest: list[State | None] = [None]

    def publish(state: State) -> None:
        newest[0] = state

    taken = run(estimator, messages(recording, robot.odometry.wheel_radius_m), publish, realtime)
    for line in taken.lines():
        print(line)
    if newest[0] is None:
        raise DataError("the estimator never started", remedy="see `terrafusion inspect`")
    state = newest[0]
    print(f"{state.status}: {state.position_m.round(2).tolist()} m, slip {state.slip:.2f}")


if __name__ == "__main__":
    raise SystemExit(main())
