"""The samples of a recording that an estimator is given, in the order in which they would come live."""

import dataclasses
import itertools
import time
from collections.abc import Callable, Sequence

import numpy as np

from terrafusion.datasets.core.channels import Gnss, Imu, Wheels
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.heap import older_objects_unsearched
from terrafusion.datasets.core.messages import ImuSample, MagnetometerSample, Message
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.config.sensor_config import SensorConfig, complete_samples
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.inputs.streams import BEFORE_PAUSE_NS
from terrafusion.fusion.metrics.scores import Outage

HELD_OUT_EVERY = 5
"""Without truth every fifth fix is held out from the estimator and scored against."""
LEAST_OVERLAP_S = 2.0


def split_fixes(recording: Recording, outages: Sequence[Outage]) -> tuple[Gnss | None, Gnss | None]:
    """Fixes for the estimator, and fixes held out from it.

    All fixes inside an outage are held out; without a truth channel every fifth of the others too.

    Raises:
        DataError: an outage starts after the end of the log.
    """
    for outage in outages:
        if outage.start_s >= recording.duration_s():
            raise DataError(
                f"the outage starts at {outage.start_s:g} s, after the end of the log",
                remedy=f"the log lasts {recording.duration_s():.1f} s",
            )
    gnss = recording.gnss
    if gnss is None or not len(gnss):
        return None, None
    held = np.zeros(len(gnss), dtype=bool)
    if recording.truth is None or not len(recording.truth):
        times = np.unique(gnss.t_ns, return_inverse=True)[1]  # a fix that is there twice is held out twice
        held = times % HELD_OUT_EVERY == HELD_OUT_EVERY - 1
    for outage in outages:
        held |= outage.covers(gnss.t_ns, recording.start_ns)
    return gnss.select(~held), (gnss.select(held) if held.any() else None)


def with_usable_samples(
    recording: Recording, inputs: SensorConfig, gnss: Gnss | None, magnetometer: bool = False
) -> Recording:
    """The recording as the estimator gets it: complete IMU and wheel samples, and the fixes `gnss`.

    Raises:
        DataError: wheels or, where `inputs` has one, the IMU are missing, or overlap for less than 2 s.
    """
    wheels = _complete_wheels(wheels_of(recording))
    imu: Imu | None = None
    if inputs.imu == "none":
        if (wheels.t_ns[-1] - wheels.t_ns[0]) * 1e-9 < LEAST_OVERLAP_S:
            raise too_short()
    else:
        assert recording.imu is not None
        imu = recording.imu.select(complete_samples(recording.imu, inputs.imu))
        overlap = (min(imu.t_ns[-1], wheels.t_ns[-1]) - max(imu.t_ns[0], wheels.t_ns[0])) * 1e-9
        if overlap < LEAST_OVERLAP_S:
            raise DataError(
                f"IMU and wheels overlap for {overlap:.1f} s only",
                remedy="check their clocks; at least 2 s are needed",
            )
    return dataclasses.replace(
        recording,
        imu=imu,
        wheels=wheels,
        gnss=gnss,
        motor=None,
        magnetometer=recording.magnetometer if magnetometer else None,
    )


def wheels_of(recording: Recording) -> Wheels:
    """The wheels of a log.

    Raises:
        DataError: it has none; with what the reader says of them and of a remedy.
    """
    if recording.wheels is not None and len(recording.wheels):
        return recording.wheels
    notes = [note.removeprefix("wheels: ") for note in recording.notes if note.startswith("wheels: ")]
    remedy = "; ".join(notes) or "add wheels.csv to a log folder, or columns of wheels to a table"
    raise DataError("the log has no wheel speeds", channel="wheels", remedy=remedy)


def _complete_wheels(wheels: Wheels) -> Wheels:
    wheels = wheels.select(np.isfinite(wheels.speed.sum(axis=1)))
    if not len(wheels):
        raise DataError("no sample has all its values", channel="wheels")
    if wheels.angle_rad is not None and not np.isfinite(wheels.angle_rad).all():
        wheels = dataclasses.replace(wheels, angle_rad=None)
    return wheels


@older_objects_unsearched()
def feed(
    estimator: Estimator, recording: Recording, progress: Callable[[float], None] | None = None
) -> np.ndarray:
    """Give an estimator all samples in time order; returns the computing time of each keyframe, ms.

    Keyframes are made as IMU samples come, or, without an IMU or long after the last one of an IMU with which
    the estimator has started, as wheel samples do: what comes after the last of them is left out. `progress`
    gets the share done, 0 to 1.
    """
    wheels = wheels_of(recording)
    clock = recording.imu if recording.imu is not None else wheels
    first_ns, last_ns, end_ns = int(clock.t_ns[0]), int(clock.t_ns[-1]), int(wheels.t_ns[-1])

    def counts(message: Message) -> bool:
        goes_on = end_ns - last_ns > BEFORE_PAUSE_NS and estimator.latest() is not None
        return message.t_ns <= (end_ns if goes_on else last_ns)

    latencies: list[float] = []
    newest = estimator.latest()
    for message in itertools.takewhile(counts, recording.messages()):
        begun = time.perf_counter()
        if isinstance(message, ImuSample):  # complete, as `with_usable_samples` leaves them
            estimator.add_imu(*message)
        elif isinstance(message, MagnetometerSample):
            estimator.add_magnetic_field(*message)
        else:
            estimator.add(message)
        if estimator.latest() is not newest:
            newest = estimator.latest()
            latencies.append((time.perf_counter() - begun) * 1e3)
            if progress is not None and len(latencies) % 50 == 0:
                progress((message.t_ns - first_ns) / max(last_ns - first_ns, end_ns - first_ns, 1))
    estimator.finish()
    if progress is not None:
        progress(1.0)
    return np.array(latencies)


def too_short() -> DataError:
    """The error of a log that is too short to start from."""
    return DataError("the log is too short to start from", remedy="give at least two seconds")


def never_started(given: Recording, wheel_radius_m: float) -> DataError:
    """The error of a log, as the estimator got it, from which it did not start."""
    gnss, wheels = given.gnss, given.wheels
    if gnss is None or wheels is None or not len(gnss):
        return too_short()
    span_m = float(np.hypot(*np.ptp(gnss.enu_m[:, :2], axis=0)))
    speed_mps = wheels.side_speeds_mps(wheel_radius_m).mean(axis=1)
    path_m = float(np.abs(speed_mps[1:]) @ np.diff(wheels.t_ns)) * 1e-9
    return DataError(
        "the robot never moved far enough for GNSS to show its heading: "
        f"the fixes lie within {span_m:.3g} m, the wheels ran {path_m:.3g} m",
        channel="gnss",
        remedy="where these differ, check units and times of both; else replay a longer drive, or leave the "
        "GNSS channel out for a local path",
    )
