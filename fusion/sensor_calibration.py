"""A robot's sensor numbers from its logs: each is replayed as live, from what the ones before it gave."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import DataError, errors_of
from terrafusion.datasets.core.printable import counted
from terrafusion.datasets.core.recording import Overrides, Recording
from terrafusion.datasets.core.robot import KnownNumber, SensorNumbers
from terrafusion.datasets.core.tables import text_html
from terrafusion.fusion.calibration.fit import information_gained
from terrafusion.fusion.calibration.mounting import Angle
from terrafusion.fusion.calibration.numbers import (
    ANTENNA_X,
    ANTENNA_Y,
    COURSE_LAG,
    GNSS_DELAY,
    GYRO_BIAS,
    SLIP_PER_GRADE,
    TURN_SCALE,
    WHEEL_DELAY,
    WHEEL_SCALE,
    Knowledge,
    for_the_next_run,
)
from terrafusion.fusion.calibration.online import SelfCalibration
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.config.sensor_config import SensorConfig, sensor_config_of, yaw_factor
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.estimator.feed import feed, with_usable_samples
from terrafusion.fusion.estimator.imu_level import LEVEL
from terrafusion.fusion.estimator.imu_mounting import ImuMounting
from terrafusion.twin.model.choose import choose_vehicle, named_vehicle
from terrafusion.twin.model.library import is_named
from terrafusion.twin.model.vehicle import VehicleParams, load_vehicle, reported_geometry

OBSERVED_NATS = 0.7
"""Least information by which a number counts as observed: its sigma is halved."""
ROWS = {
    "antenna_x_m": ANTENNA_X,
    "antenna_y_m": ANTENNA_Y,
    "gyro_scale": TURN_SCALE,
    "gyro_bias_radps": GYRO_BIAS,
    "yaw_factor": TURN_SCALE,
    "wheel_scale": WHEEL_SCALE,
    "gnss_delay_s": GNSS_DELAY,
    "wheel_delay_s": WHEEL_DELAY,
    "course_lag_s": COURSE_LAG,
    "slip_per_grade": SLIP_PER_GRADE,
}
OF_GYRO, OF_WHEELS = ("gyro_scale", "gyro_bias_radps"), ("yaw_factor",)
"""Numbers that exist where the yaw rate comes from the gyro, and from the wheels."""


@dataclass(frozen=True)
class LearnedNumber:
    """A number after the logs: `value`, 1 `sigma`, its values `before`, and the information gained, nats."""

    value: float
    sigma: float
    value_before: float
    sigma_before: float
    gained_nats: float

    @property
    def level(self) -> bool:
        """Whether it is a tilt of zero, and was."""
        return self.value == self.value_before == 0.0

    @property
    def observed(self) -> bool:
        """Whether the logs determine it."""
        return self.gained_nats >= OBSERVED_NATS


@dataclass(frozen=True, eq=False, repr=False)
class SensorCalibration:
    """What logs of one robot show of its sensors.

    Attributes:
        vehicle: as it was known before, with the geometry `overrides` that the logs report.
        extends: its name or file.
        logs: names of the logs used.
        numbers: by their names in `ROWS`, and the IMU's angles; the antenna as its place in the body frame.
        notes: what was left out or assumed.
    """

    vehicle: VehicleParams
    extends: str
    overrides: Overrides
    logs: tuple[str, ...]
    numbers: dict[str, LearnedNumber]
    notes: tuple[str, ...]

    def unobserved(self) -> list[str]:
        """Numbers that the logs do not determine."""
        return [name for name, number in self.numbers.items() if not number.observed]

    def known(self) -> SensorNumbers:
        """The numbers and how they are known: those that were not observed as before.

        A level IMU needs no entry.
        """
        level = {name for name in LEVEL if name in self.numbers and self.numbers[name].level}
        names = [name for name in self.numbers if not name.startswith("antenna") and name not in level]
        known = {name: self._known(name) for name in names}
        return dataclasses.replace(self.vehicle.robot, antenna_m=self._antenna(), **known)

    def _known(self, name: str) -> KnownNumber:
        number, before = self.numbers[name], getattr(self.vehicle.robot, name)
        gained = round(number.gained_nats, 2)
        if number.observed:
            value, sigma = _digits(number.value, 6), _digits(number.sigma, 3)
            return KnownNumber(value, "calibrated", sigma, self._logs(before), gained)
        return before or KnownNumber(_digits(number.value_before, 6), "assumed", gained_nats=gained)

    def _antenna(self) -> KnownNumber:
        before = self.vehicle.robot.antenna_m
        x, y = self.numbers["antenna_x_m"], self.numbers["antenna_y_m"]
        gained, nominal = round(max(x.gained_nats, y.gained_nats), 2), self.vehicle.sensors.gnss.antenna_m
        if not (x.observed or y.observed):
            if before is not None and before.known != "assumed":
                return before
            return KnownNumber(nominal, "assumed", gained_nats=gained)
        place = (_digits(x.value, 6), _digits(y.value, 6), nominal[2])
        sigma = (_digits(x.sigma, 3), _digits(y.sigma, 3))
        return KnownNumber(place, "calibrated", sigma, self._logs(before), gained)

    def _logs(self, before: KnownNumber | None) -> tuple[str, ...]:
        return tuple(dict.fromkeys([*(before.logs if before is not None else ()), *self.logs]))

    def summary(self) -> list[str]:
        """The numbers as a table, and what was not observable."""
        lines = [
            f"Sensors of '{self.vehicle.name}' from {', '.join(self.logs)}",
            f"{'':16s} {'value':>9s} {'1 sigma':>8s} {'before':>9s} {'1 sigma':>8s} {'gained':>7s} nats",
        ]
        for name, n in self.numbers.items():
            status = "observed" if n.observed else "not observable"
            lines.append(
                f"{name:16s} {n.value:9.4f} {n.sigma:8.4f} {n.value_before:9.4f} {n.sigma_before:8.4f} "
                f"{n.gained_nats:7.2f} {status}"
            )
        missing = ", ".join(self.unobserved())
        lines.append(f"not observable in these logs: {missing}" if missing else "all numbers were observed")
        return [*lines, *(f"note: {note}" for note in self.notes)]

    def __repr__(self) -> str:
        observed = [
            f"  {name} {n.value:.4g} +- {n.sigma:.2g}" for name, n in self.numbers.items() if n.observed
        ]
        title = f"Sensors of '{self.vehicle.name}' from {counted(len(self.logs), 'log')}"
        return "\n".join([title, *observed[:10], f"  {len(self.numbers) - len(observed)} not observable"])

    def _repr_html_(self) -> str:
        return text_html("\n".join(self.summary()))


def calibrate_sensors(
    recordings: Sequence[Recording],
    vehicle: str | Path | VehicleParams | None = None,
    *,
    progress: Callable[[float], None] | None = None,
) -> SensorCalibration:
    """Learn a robot's sensor numbers from its logs, in the order given.

    Args:
        recordings: of one robot; those without fixes are left out.
        vehicle: name, YAML file or vehicle; by default what the logs say.
        progress: called with the share done, 0 to 1.

    Raises:
        DataError: no log with fixes, logs of several robots, or one that cannot be replayed.
        ConfigError: an unknown vehicle, or a file with errors.
    """
    overrides = _one_robot(recordings, vehicle)
    params, notes = choose_vehicle(dataclasses.replace(recordings[0], overrides=overrides), vehicle)
    ready = [(log, _learner(log, params)) for log in recordings]
    left_out = [log.name for log, learner in ready if learner is None]
    notes += tuple(f"{name}: left out, it has no fixes or no source of yaw" for name in left_out)
    notes += tuple(
        f"{log.name}: the vehicle's numbers are from a log of this name already; if it is the same, it "
        "counts twice and sigma is too small: give other drives"
        for log in recordings
        if any(isinstance(one, KnownNumber) and log.name in one.logs for one in vars(params.robot).values())
    )
    learners = [(log, learner) for log, learner in ready if learner is not None]
    yaw = _one_source_of_yaw(learners)
    earlier: _Learner | None = None
    before, first = learners[0][1].known, learners[0][1].mounting
    mounted_before = {"imu_yaw_rad": first.known, **dict(zip(LEVEL, first.level.known, strict=True))}
    for i, (log, learner) in enumerate(learners):
        with errors_of(log.name):
            share = None if progress is None else _part_of(progress, i, len(learners))
            learner.run(earlier, share)
            # What was learned with a wrong angle of the IMU is learned again with the right one.
            earlier = learner.again(earlier, params) if learner.turned else learner
    last = earlier or learners[-1][1]
    logs = tuple(log.name for log, _ in learners)
    named = vehicle or named_vehicle(recordings[0]) or "generic"
    extends = named.name if isinstance(named, VehicleParams) else str(named)
    numbers = _numbers(before, last.known, params, yaw)
    if last.mounting.learns:
        known = (*last.mounting.level.known, last.mounting.known)
        for name, angle in zip((*LEVEL, "imu_yaw_rad"), known, strict=True):
            numbers[name] = _mounting(mounted_before[name], angle)
    return SensorCalibration(params, extends, overrides, logs, numbers, notes)


def _one_robot(recordings: Sequence[Recording], vehicle: object) -> Overrides:
    """The geometry that the logs report; refuses none, and those of several robots."""
    if not recordings:
        raise DataError("no log is given", remedy="give one or more of one robot")
    names = {recording.vehicle for recording in recordings}
    if vehicle is None and len(names) > 1 and not _one_vehicle(names):
        raise DataError(
            f"the logs name several vehicles: {', '.join(sorted(str(name) for name in names))}",
            file=recordings[-1].name,
            remedy="give logs of one, or say which with --vehicle",
        )
    return reported_geometry(recordings)


def _one_vehicle(names: set[str | None]) -> bool:
    """Whether names and files, such as the copies in log folders, stand for the same numbers."""
    first, *others = [load_vehicle(name) if name and is_named("vehicles", name) else name for name in names]
    return all(other == first for other in others)


@dataclass(frozen=True, eq=False)
class _Learner:
    """An estimator for a log, and what it gets of it."""

    estimator: Estimator
    given: Recording
    calibration: SelfCalibration

    @property
    def known(self) -> Knowledge:
        return self.calibration.known

    @property
    def yaw(self) -> str:
        return self.estimator.config.inputs.yaw

    @property
    def mounting(self) -> ImuMounting:
        return self.estimator.learned.mounting

    @property
    def turned(self) -> bool:
        """Whether the IMU proved turned or tilted."""
        return self.mounting.corrects or any(self.mounting.level.corrects)

    def run(
        self,
        earlier: "_Learner | None",
        progress: Callable[[float], None] | None,
        mounted: ImuMounting | None = None,
    ) -> None:
        """Learn from the log, beginning with what the learner of an earlier one knows, with the angles of the
        IMU by that or by `mounted`.
        """
        if earlier is not None:
            known = for_the_next_run(earlier.known, self.calibration.prior, self.yaw)
            self.estimator.learned.start_from(known)
            self.mounting.start_as(earlier.mounting)
        if mounted is not None:
            self.mounting.start_as(mounted)
        feed(self.estimator, self.given, progress)

    def again(self, earlier: "_Learner | None", params: VehicleParams) -> "_Learner":
        """A learner that takes the same log with the angles of the IMU that this one found."""
        again = _started(self.given, self.estimator.config.inputs, params)
        assert again is not None
        again.run(earlier, None, self.mounting)
        again.mounting.start_as(self.mounting)  # the log shows it once
        return again


def _learner(log: Recording, params: VehicleParams) -> _Learner | None:
    """None where there is nothing to learn from."""
    with errors_of(log.name):
        if log.gnss is None or not len(log.gnss):
            return None
        inputs = sensor_config_of(log, log.gnss)
        return _started(with_usable_samples(log, inputs, log.gnss), inputs, params)


def _started(given: Recording, inputs: SensorConfig, params: VehicleParams) -> _Learner | None:
    estimator = Estimator(EstimatorConfig(params.rig(), params.name, inputs=inputs))
    calibration = estimator.learned.calibration
    return None if calibration is None else _Learner(estimator, given, calibration)


def _one_source_of_yaw(learners: Sequence[tuple[Recording, _Learner]]) -> str:
    """The source of yaw of all logs; refuses several, and no log at all."""
    if not learners:
        raise DataError(
            "none of the logs has fixes and a source of yaw",
            channel="gnss",
            remedy="give a drive with GNSS, wheels and, where there is one, the gyro",
        )
    first, learner = learners[0]
    for log, other in learners:
        if other.yaw != learner.yaw:
            raise DataError(
                f"its yaw rate comes from the {other.yaw}, in {first.name} from the {learner.yaw}",
                file=log.name,
                remedy="calibrate them apart",
            )
    return learner.yaw


def _part_of(progress: Callable[[float], None], i: int, count: int) -> Callable[[float], None]:
    return lambda share: progress((i + share) / count)


def _numbers(
    before: Knowledge, after: Knowledge, params: VehicleParams, yaw: str
) -> dict[str, LearnedNumber]:
    gained = information_gained(before, after)
    left_out = {"gyro": OF_WHEELS, "wheels": OF_GYRO}.get(yaw, OF_GYRO + OF_WHEELS)
    antenna, factor = params.sensors.gnss.antenna_m, yaw_factor(params.rig())
    found = {}
    for name, row in ROWS.items():
        offset = {"antenna_x_m": antenna[0], "antenna_y_m": antenna[1]}.get(name, 0.0)
        scale = 1.0
        if name == "yaw_factor":
            offset, scale = factor, factor
        columns: list[Array] = [after.mean, after.stated_sigma(before), before.mean, before.sigma]
        mean, sigma, mean_before, sigma_before = (float(column[row]) for column in columns)
        if name not in left_out:
            found[name] = LearnedNumber(
                offset + scale * mean,
                scale * sigma,
                offset + scale * mean_before,
                scale * sigma_before,
                float(gained[row]),
            )
    return found


def _mounting(before: Angle, after: Angle) -> LearnedNumber:
    gained = math.log(before.sigma_rad / after.sigma_rad)
    return LearnedNumber(after.rad, after.sigma_rad, before.rad, before.sigma_rad, gained)


def _digits(value: float, digits: int) -> float:
    return float(np.format_float_positional(value, digits, unique=False, fractional=False))
