"""Trials of the calibration states on drives of the twin whose vehicle file is wrong.

    python -m tests.studies.calibration_trials --seeds 5

prints the tables of docs/explanation/calibration-states.md.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid

from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.graph.slow_states import CALIBRATION_SIGMA, CRAWL_MPS
from terrafusion.fusion.outputs.linear_states import series
from terrafusion.fusion.replay import ReplayResult, replay
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate
from tests.studies.parts import TaskWorkers, add_options, answers

Array = NDArray[np.float64]

VEHICLE, GROUND = "elevate", "asphalt"
GROUNDS = (GROUND, "medium_sand", "loose_sand")
"""Where the slip that acceleration asks for is measured, and `ELSEWHERE` is sought besides."""
ELSEWHERE = ("antenna_x_m", "wheel_delay_s", "gnss_delay_s")
RADIUS_SHARE, ANTENNA_M, IMU_YAW_RAD, WHEEL_S, GNSS_S, TRACK_SHARE = (
    0.02,
    0.10,
    np.radians(2.0),
    0.05,
    0.15,
    0.10,
)
"""How wrong the vehicle file is."""
SURGE_STEP_S = 0.1


def exciting(ground: str = GROUND) -> Scenario:
    """Two minutes with turns to both sides at several speeds, and starts and stops."""
    turns = [
        part
        for v, rate in ((1.0, 0.6), (1.2, -0.6), (0.8, 0.8), (1.4, -0.5), (1.0, 0.9), (1.0, -0.9))
        for part in (DriveSegment(8.0, v, rate), DriveSegment(6.0, v, 0.0, 0.4, 0.0, 3.0), DriveSegment(3.0))
    ]
    drive = (DriveSegment(2.0), DriveSegment(8.0, 1.0), *turns)
    return Scenario(
        "exciting", sum(part.duration_s for part in drive), route=(RouteLeg(ground),), drive=drive
    )


def pulsing(ground: str) -> Scenario:
    """A minute straight on, with starts, stops and changing speeds."""
    pulses = tuple(
        part
        for v in (0.5, 1.0, 1.5)
        for part in (DriveSegment(5.0, v), DriveSegment(9.0, v, 0.0, 0.4 * v, 0.0, 3.0), DriveSegment(3.0))
    )
    drive = (DriveSegment(2.0), *pulses)
    return Scenario("pulsing", sum(part.duration_s for part in drive), route=(RouteLeg(ground),), drive=drive)


def dull() -> Scenario:
    """A minute straight on at one speed."""
    return Scenario(
        "dull", 62.0, route=(RouteLeg(GROUND),), drive=(DriveSegment(2.0), DriveSegment(60.0, 1.0))
    )


@dataclass(frozen=True)
class Fault:
    """Something wrong with the vehicle file: the state that shows it, what that should be, how to make it."""

    state: str
    expected: float
    made: Callable[[Recording], Recording]


def faults() -> tuple[Fault, ...]:
    """One for each state that the table has."""
    rig = load_vehicle(VEHICLE).rig()
    x, y, z = rig.sensors.gnss.antenna_m
    return (
        Fault(
            "radius_scale",
            1.0 / (1.0 + RADIUS_SHARE) - 1.0,
            lambda r: _told(r, wheel_radius_m=rig.wheel_radius_m * (1.0 + RADIUS_SHARE)),
        ),
        Fault("antenna_x_m", -ANTENNA_M, lambda r: _told(r, antenna_m=(x + ANTENNA_M, y, z))),
        Fault("antenna_y_m", -ANTENNA_M, lambda r: _told(r, antenna_m=(x, y + ANTENNA_M, z))),
        Fault("imu_yaw_rad", IMU_YAW_RAD, _imu_turned),
        Fault("wheel_delay_s", WHEEL_S, lambda r: _late(r, "wheels", WHEEL_S)),
        Fault("gnss_delay_s", GNSS_S, lambda r: _late(r, "gnss", GNSS_S)),
    )


def narrow_track(recording: Recording) -> Recording:
    """The recording with a track in its vehicle file that is too narrow."""
    return _told(recording, track_m=load_vehicle(VEHICLE).rig().track_m * (1.0 - TRACK_SHARE))


def effective_yaw_scale(recording: Recording, track_m: float) -> float:
    """True over wheel yaw rate, less one, of the whole drive (least squares on what the twin did)."""
    truth, wheels = recording.truth, recording.wheels
    assert truth is not None
    assert truth.twist_body is not None
    assert wheels is not None
    left, right = wheels.side_speeds_mps(load_vehicle(VEHICLE).wheel.radius_m).T
    told = (right - left) / track_m
    true = np.interp(wheels.t_ns, truth.t_ns, truth.twist_body[:, 5])
    return float(told @ true / (told @ told)) - 1.0


def surge_slip(recording: Recording) -> tuple[float, float]:
    """Slip that an acceleration of one gravity asks for, and the speed v0, m/s, of `factors.SURGE_SPEED_MPS`.

    Least squares of the slip speed of means over `SURGE_STEP_S` on v, v a / g and a / g, above a crawl.
    """
    truth, wheels = recording.truth, recording.wheels
    assert truth is not None
    assert truth.twist_body is not None
    assert wheels is not None
    ends = np.arange(truth.t_ns[0], wheels.t_ns[-1], round(SURGE_STEP_S * 1e9))
    seconds = (ends - ends[0]) * 1e-9
    angle = wheels.angle_rad
    assert angle is not None
    rolled = np.interp(ends, wheels.t_ns, angle.mean(axis=1)) * load_vehicle(VEHICLE).wheel.radius_m
    travelled = cumulative_trapezoid(truth.twist_body[:, 0], (truth.t_ns - truth.t_ns[0]) * 1e-9, initial=0.0)
    moved = np.interp(ends, truth.t_ns, travelled)
    speed, slipped = np.diff(rolled) / SURGE_STEP_S, np.diff(rolled - moved) / SURGE_STEP_S
    pull = np.gradient(speed, seconds[1:]) / GRAVITY_MPS2
    rolling = speed > CRAWL_MPS
    A = np.stack([speed, speed * pull, pull], axis=1)[rolling]
    _, share, extra = np.linalg.lstsq(A, slipped[rolling], rcond=None)[0]
    return float(share), float(extra / share)


def found(result: ReplayResult, state: str) -> tuple[float, float]:
    """Value and sigma of a state at the end of the drive."""
    values = series(result.estimate, state)
    assert values is not None
    return float(values[0][-1]), float(values[1][-1])


def calibrated(recording: Recording) -> ReplayResult:
    """The drive, live, with the states of a calibration."""
    return replay(recording, settings={"calibrate": True})


@functools.lru_cache(maxsize=8)
def drive(ground: str, seed: int) -> Recording:
    """The exciting drive on a ground, with one draw of its noise."""
    return simulate(exciting(ground), vehicle=load_vehicle(VEHICLE), seed=seed)


def sought(ground: str, state: str, seed: int) -> tuple[float, float]:
    """Value and sigma of a state in a drive in which it is wrong."""
    return found(calibrated(_fault(state).made(drive(ground, seed))), state)


def unexcited(state: str) -> tuple[float, float]:
    """The same in a drive that does not show it."""
    straight = simulate(dull(), vehicle=load_vehicle(VEHICLE), seed=0)
    return found(calibrated(_fault(state).made(straight)), state)


def asked_slip(ground: str) -> tuple[float, float]:
    """`surge_slip` of a drive with exact sensors."""
    return surge_slip(simulate(pulsing(ground), vehicle=load_vehicle(VEHICLE), noiseless=True))


def turning(narrow: bool, seed: int) -> tuple[float, float, float]:
    """Yaw scale found, its sigma, and that of the twin; with the true track or one told too narrow."""
    log, track_m = drive(GROUND, seed), load_vehicle(VEHICLE).rig().track_m
    value, sigma = found(replay(narrow_track(log) if narrow else log), "yaw_scale")
    return value, sigma, effective_yaw_scale(log, track_m * (1.0 - TRACK_SHARE) if narrow else track_m)


def unbroken(calibrate: bool, seed: int) -> tuple[float | None, float | None]:
    """Errors of position, m, and heading, rad, where the vehicle file is right."""
    settings = {"calibrate": True} if calibrate else {}
    scores = replay(drive(GROUND, seed), settings=settings).scores
    return scores.ate_m, scores.yaw_rmse_rad


Trial = tuple[str, tuple[Any, ...]]
TRIALS: dict[str, Callable[..., tuple[Any, ...]]] = {
    one.__name__: one for one in (sought, unexcited, asked_slip, turning, unbroken)
}


def trial(what: Trial) -> tuple[Any, ...]:
    """One trial by its name and what it is given."""
    name, given = what
    return TRIALS[name](*given)


def trials(seeds: int) -> list[Trial]:
    """All of them."""
    states = [fault.state for fault in faults()]
    places = [(GROUND, s) for s in states] + [(g, s) for g in GROUNDS[1:] for s in states if s in ELSEWHERE]
    return [
        *(("sought", (*place, seed)) for seed in range(seeds) for place in places),
        *(("unexcited", (state,)) for state in states),
        *(("asked_slip", (ground,)) for ground in GROUNDS),
        *(
            (name, (yes, seed))
            for name in ("turning", "unbroken")
            for yes in (False, True)
            for seed in range(seeds)
        ),
    ]


def report(seeds: int, told: Mapping[Trial, Sequence[float]]) -> Iterator[str]:
    """The tables, line by line, from the answers of all trials."""
    yield f"{seeds} seeds: expected; found; sigma; r.m.s. and largest error over sigma; sigma if dull"
    for fault in faults():
        left, sigma = told["unexcited", (fault.state,)]
        shrunk = f"{sigma / CALIBRATION_SIGMA[fault.state]:.2f} of the prior's (value {left:.4f})"
        yield f"{_sought(fault, GROUND, seeds, told)}; {shrunk}"
    yield "other grounds, likewise"
    for ground in GROUNDS[1:]:
        for fault in faults():
            if fault.state in ELSEWHERE:
                yield f"  {ground}{_sought(fault, ground, seeds, told)}"
    yield "slip that an acceleration of one gravity asks for; v0, m/s (straight on, exact sensors)"
    for ground in GROUNDS:
        yield "  {}: {:.3f}; {:.2f}".format(ground, *told["asked_slip", (ground,)])
    yield "yaw scale: of the twin; found; sigma (as built, then a track told 10 % too narrow)"
    for narrow in (False, True):
        rows = [told["turning", (narrow, seed)] for seed in range(seeds)]
        value, sigma = np.mean([row[:2] for row in rows], axis=0)
        yield f"  {np.mean([row[2] for row in rows]):.3f}; {value:.3f}; {sigma:.3f}"
    yield "vehicle file right: position error m, heading error rad (medians), without and with calibration"
    for calibrate in (False, True):
        ate, yaw = np.median([told["unbroken", (calibrate, seed)] for seed in range(seeds)], axis=0)
        yield f"  {ate:.4f}, {yaw:.4f}"


def _fault(state: str) -> Fault:
    return next(fault for fault in faults() if fault.state == state)


def _sought(fault: Fault, ground: str, seeds: int, told: Mapping[Trial, Sequence[float]]) -> str:
    pairs = np.array([told["sought", (ground, fault.state, seed)] for seed in range(seeds)])
    z = (pairs[:, 0] - fault.expected) / pairs[:, 1]
    return (
        f"  {fault.state}: {fault.expected:.4f}; {pairs[:, 0].mean():.4f}; {pairs[:, 1].mean():.4f}; "
        f"{np.sqrt(np.mean(z**2)):.1f}; {np.abs(z).max():.1f}"
    )


def _told(recording: Recording, **overrides: object) -> Recording:
    return dataclasses.replace(
        recording,
        overrides=dataclasses.replace(recording.overrides, **overrides),  # type: ignore[arg-type]
    )


def _late(recording: Recording, channel: str, seconds: float) -> Recording:
    part = getattr(recording, channel)
    stamped = dataclasses.replace(part, t_ns=part.t_ns + round(seconds * 1e9))
    return dataclasses.replace(recording, **{channel: stamped})


def _imu_turned(recording: Recording) -> Recording:
    imu = recording.imu
    assert imu is not None
    c, s = np.cos(IMU_YAW_RAD), np.sin(IMU_YAW_RAD)
    body_to_imu = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    turned = dataclasses.replace(
        imu, gyro_radps=imu.gyro_radps @ body_to_imu.T, accel_mps2=imu.accel_mps2 @ body_to_imu.T
    )
    return dataclasses.replace(recording, imu=turned)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--out", type=Path, help="folder for parts; the same command continues")
    add_options(parser)
    given = parser.parse_args()
    wanted = trials(given.seeds)
    told = dict(zip(wanted, answers(wanted, trial, TaskWorkers.of(given), given.out), strict=True))
    for line in report(given.seeds, told):
        print(line)


if __name__ == "__main__":
    from tests.studies import calibration_trials

    calibration_trials.main()  # workers know the trials by the module's own name
