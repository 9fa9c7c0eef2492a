"""The verdict on drives of the twin, without and with faults: false alarms, and errors that pass as good.

Each drive is judged twice: with its truth, and without it, by what the sensors alone show. Whether the
estimate was really wrong (an error of more than 10 m or, for more than 1 % of the time, of five of its
sigmas) is known from the truth in both cases.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections import Counter
from collections.abc import Callable

import numpy as np

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.config.estimator_config import EstimatorOptions
from terrafusion.fusion.metrics.judged_run import DOUBTFUL, FIVE_SIGMA, GOOD, STRAY_SHARE, UNUSABLE
from terrafusion.fusion.metrics.scores import Scores, score
from terrafusion.fusion.metrics.verdict import FAR_M
from terrafusion.fusion.replay import replay
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate

GROUNDS = ("asphalt", "grass", "gravel", "medium_sand", "loose_sand", "mud")
VEHICLES = ("elevate", "husky", "generic")
FIRST_SEED, JUDGED_SEED = 400, 500
"""Rules of the verdict were set on seeds from the first on; those from the second on only judge them."""


def short_drive(seed: int) -> Recording:
    """A stop and six random arcs, 33 to 57 s, on a ground and with a robot by turns."""
    rng = np.random.default_rng(seed)
    legs = [DriveSegment(3.0)]
    for _ in range(6):
        length, speed, turn = rng.uniform([5.0, 0.6, -0.5], [9.0, 1.0, 0.5]).tolist()
        legs.append(DriveSegment(length, speed, turn))
    scenario = Scenario(
        "short", sum(leg.duration_s for leg in legs), drive=tuple(legs),
        route=(RouteLeg(GROUNDS[seed % len(GROUNDS)]),), heading_deg=float(rng.uniform(0.0, 360.0)),
    )  # fmt: skip
    return simulate(scenario, vehicle=VEHICLES[seed // len(GROUNDS) % len(VEHICLES)], seed=seed)


def gyro_scaled(log: Recording, factor: float) -> Recording:
    """The gyro reads `factor` times the rate about z."""
    imu = log.imu
    assert imu is not None
    return dataclasses.replace(
        log, imu=dataclasses.replace(imu, gyro_radps=imu.gyro_radps * [1.0, 1.0, factor])
    )


def wheels_scaled(log: Recording, factor: float) -> Recording:
    """The wheels read `factor` times their speed, as with a radius that is too large."""
    wheels = log.wheels
    assert wheels is not None
    return dataclasses.replace(
        log, wheels=dataclasses.replace(wheels, speed=wheels.speed * factor, angle_rad=None)
    )


def fixes_shifted(
    log: Recording, off_m: float = 50.0, begin_s: float = 20.0, seconds: float = 10.0
) -> Recording:
    """A stretch of the fixes lies `off_m` to the east."""
    gnss = log.gnss
    assert gnss is not None
    t_s = (gnss.t_ns - log.start_ns) * 1e-9
    rows = (t_s >= begin_s) & (t_s < begin_s + seconds)
    return dataclasses.replace(
        log, gnss=dataclasses.replace(gnss, enu_m=gnss.enu_m + rows[:, None] * [off_m, 0.0, 0.0])
    )


def imu_turned(log: Recording, rotation: np.ndarray) -> Recording:
    """The IMU with other axes than it says: v -> rotation v."""
    imu = log.imu
    assert imu is not None
    turned = dataclasses.replace(
        imu, gyro_radps=imu.gyro_radps @ rotation.T, accel_mps2=imu.accel_mps2 @ rotation.T
    )
    return dataclasses.replace(log, imu=turned)


QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
UPSIDE_DOWN = np.diag([1.0, -1.0, -1.0])
FAULTS: dict[str, Callable[[Recording], Recording]] = {
    "none": lambda log: log,
    "gyro x 1.03": lambda log: gyro_scaled(log, 1.03),
    "gyro x 1.3": lambda log: gyro_scaled(log, 1.3),
    "gyro sign": lambda log: gyro_scaled(log, -1.0),
    "radius + 30 %": lambda log: wheels_scaled(log, 1.3),
    "radius - 30 %": lambda log: wheels_scaled(log, 0.7),
    "fixes 50 m off, 10 s": fixes_shifted,
    "IMU turned, 90 deg about z": lambda log: imu_turned(log, QUARTER),
    "IMU upside down": lambda log: imu_turned(log, UPSIDE_DOWN),
}


def is_wrong(scores: Scores) -> bool:
    """Whether an error of more than 10 m, or of five sigmas, occurred."""
    errors = scores.errors
    assert errors is not None
    beyond = 2.0 * errors.nees() > FIVE_SIGMA
    return bool(errors.distance_m().max() > FAR_M or beyond.mean() > STRAY_SHARE)


def judged(log: Recording, with_truth: bool, settings: EstimatorOptions) -> tuple[str, bool, tuple[str, ...]]:
    """Value of the verdict, whether the estimate was wrong, the reasons; a refused log is not to be used."""
    try:
        run = replay(log if with_truth else dataclasses.replace(log, truth=None), settings=settings)
    except TerrafusionError as error:
        return UNUSABLE, False, (str(error),)
    antenna_m = run.vehicle.sensors.gnss.antenna_m
    return run.verdict.value, is_wrong(score(run.estimate, log, antenna_m=antenna_m)), run.verdict.reasons


def main() -> None:
    """Print one line a fault."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=36)
    parser.add_argument("--judged", action="store_true", help="Take the seeds that only judge.")
    parser.add_argument("--faults", nargs="*", default=list(FAULTS))
    parser.add_argument("--reasons", action="store_true", help="Also print why drives are not good.")
    parser.add_argument("--plain", action="store_true", help="Without self-calibration.")
    given = parser.parse_args()
    first = JUDGED_SEED if given.judged else FIRST_SEED
    settings: EstimatorOptions = {"self_calibrate": False} if given.plain else {}
    print(f"{'fault':28s} judged with  good  doubtful  not to be used  wrong  wrong and good")
    for name in given.faults:
        for with_truth in (True, False):
            logs = (FAULTS[name](short_drive(first + i)) for i in range(given.seeds))
            rows = [judged(log, with_truth, settings) for log in logs]
            values = Counter(value for value, _, _ in rows)
            wrong = [value for value, bad, _ in rows if bad]
            counts = f"{values[GOOD]:5d} {values[DOUBTFUL]:9d} {values[UNUSABLE]:15d}"
            means = "truth" if with_truth else "sensors"
            print(f"{name:28s} {means:11s} {counts} {len(wrong):6d} {wrong.count(GOOD):15d}", flush=True)
            if given.reasons:
                for i, (value, bad, reasons) in enumerate(rows):
                    if value != GOOD or bad:
                        print(
                            f"    {first + i} {value} {'wrong' if bad else ''}: {' | '.join(reasons)}",
                            flush=True,
                        )


if __name__ == "__main__":
    main()
