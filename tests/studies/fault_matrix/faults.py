"""Faults of sensors, clocks and links, put into a recording from a third of it on, or into all of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.channels import Channel, Gnss, Imu, Wheels
from terrafusion.datasets.core.messages import Message
from terrafusion.datasets.core.recording import Recording

Fault = Callable[[Recording, np.random.Generator], Recording]


def _imu(log: Recording) -> Imu:
    assert log.imu is not None
    return log.imu


def _wheels(log: Recording) -> Wheels:
    assert log.wheels is not None
    return log.wheels


def _gnss(log: Recording) -> Gnss:
    assert log.gnss is not None
    return log.gnss


def _with(log: Recording, channel: Channel) -> Recording:
    return dataclasses.replace(log, **{channel.name: channel})


def _third(log: Recording, t_ns: Array) -> Array:
    """Rows of the last two thirds."""
    return np.asarray(t_ns > log.start_ns + (log.end_ns() - log.start_ns) // 3)


def _some(log: Recording, rng: np.random.Generator) -> Channel:
    return log.channels()[str(rng.choice(["wheels", "imu", "gnss"]))]


def _rotated(log: Recording, R: Array) -> Recording:
    imu = _imu(log)
    return _with(
        log, dataclasses.replace(imu, gyro_radps=imu.gyro_radps @ R.T, accel_mps2=imu.accel_mps2 @ R.T)
    )


# --- one fault a function --------------------------------------------------------------------------------


def outage(log: Recording, rng: np.random.Generator) -> Recording:
    """No fix for 5 s to a third of the log."""
    gnss, length_ns = _gnss(log), log.end_ns() - log.start_ns
    begin = log.start_ns + int(rng.uniform(0.3, 0.6) * length_ns)
    end = begin + int(rng.uniform(5e9, length_ns / 3))
    return _with(log, gnss.select((gnss.t_ns < begin) | (gnss.t_ns > end)))


def noise(log: Recording, rng: np.random.Generator) -> Recording:
    """Fixes with 2 m more noise than they report, and an IMU with noise of 0.1 rad/s and 2 m/s2."""
    imu, gnss = _imu(log), _gnss(log)
    log = _with(log, dataclasses.replace(gnss, enu_m=gnss.enu_m + rng.normal(0.0, 2.0, gnss.enu_m.shape)))
    gyro, accel = (rng.normal(0.0, s, imu.gyro_radps.shape) for s in (0.1, 2.0))
    return _with(
        log, dataclasses.replace(imu, gyro_radps=imu.gyro_radps + gyro, accel_mps2=imu.accel_mps2 + accel)
    )


def lag(log: Recording, rng: np.random.Generator) -> Recording:
    """One channel is stamped 0.1 to 1 s late."""
    channel = _some(log, rng)
    return _with(log, dataclasses.replace(channel, t_ns=channel.t_ns + int(rng.uniform(1e8, 1e9))))


def dropout(log: Recording, rng: np.random.Generator) -> Recording:
    """Half of one channel is lost, sample by sample or in stretches of a second."""
    channel = _some(log, rng)
    seconds = ((channel.t_ns - log.start_ns) // 10**9).astype(int)
    lost = rng.random(seconds.max() + 1)[seconds] if rng.random() < 0.5 else rng.random(len(channel))
    lost[: len(channel) // 5] = 1.0
    return _with(log, channel.select(lost > 0.5))


def clock_jump(log: Recording, rng: np.random.Generator) -> Recording:
    """The stamps of one channel jump ahead by 0.3 to 4 s, once."""
    channel = _some(log, rng)
    ahead = int(rng.uniform(3e8, 4e9)) * _third(log, channel.t_ns)
    return _with(log, dataclasses.replace(channel, t_ns=channel.t_ns + ahead))


def future(log: Recording, rng: np.random.Generator) -> Recording:
    """Twenty samples of the first half arrive with a stamp 1.2 to 15 s ahead."""
    ahead_ns, until_ns = int(rng.uniform(1.2e9, 15e9)), (log.start_ns + log.end_ns()) // 2
    hit = set(rng.choice(2000, 20).tolist())
    return _arriving(
        log,
        lambda messages: (
            m._replace(t_ns=m.t_ns + ahead_ns) if i in hit and m.t_ns < until_ns else m
            for i, m in enumerate(messages)
        ),
    )


def duplicates(log: Recording, rng: np.random.Generator) -> Recording:
    """A third of all messages come twice."""
    twice = rng.random(1000) < 0.3
    return _arriving(
        log, lambda messages: (m for i, m in enumerate(messages) for _ in range(1 + twice[i % 1000]))
    )


def shuffling(log: Recording, rng: np.random.Generator) -> Recording:
    """Messages arrive out of order, by up to 0.2 s."""
    seed = int(rng.integers(2**31))

    def late(messages: Iterator[Message]) -> Iterator[Message]:
        all_of = list(messages)
        delays = np.random.default_rng(seed).uniform(0.0, 2e8, len(all_of))
        order = np.argsort(np.array([m.t_ns for m in all_of]) + delays, kind="stable")
        return (all_of[i] for i in order)

    return _arriving(log, late)


def stuck(log: Recording, rng: np.random.Generator) -> Recording:
    """Gyro, accelerometer or wheels repeat a value from a third of the log on."""
    kind = rng.choice(["gyro_radps", "accel_mps2", "wheels"])
    if kind == "wheels":
        wheels = _wheels(log)
        rows = _third(log, wheels.t_ns)
        speed = np.where(rows[:, None], wheels.speed[int(np.argmax(rows))], wheels.speed)
        return _with(log, dataclasses.replace(wheels, speed=speed, angle_rad=None))
    imu = _imu(log)
    rows, values = _third(log, imu.t_ns), getattr(imu, kind)
    return _with(
        log, dataclasses.replace(imu, **{kind: np.where(rows[:, None], values[int(np.argmax(rows))], values)})
    )


def saturated(log: Recording, rng: np.random.Generator) -> Recording:
    """The gyro ends at half of its largest rate, or the accelerometer at 9 m/s2."""
    imu = _imu(log)
    if rng.random() < 0.5:
        most = 0.5 * float(np.nanmax(np.abs(imu.gyro_radps[:, 2])))
        return _with(log, dataclasses.replace(imu, gyro_radps=np.clip(imu.gyro_radps, -most, most)))
    return _with(log, dataclasses.replace(imu, accel_mps2=np.clip(imu.accel_mps2, -9.0, 9.0)))


def swapped(log: Recording, rng: np.random.Generator) -> Recording:
    """x and y of the IMU, left and right wheels, or east and north."""
    kind = rng.integers(3)
    if kind == 0:
        return _rotated(log, np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    if kind == 1:
        wheels, other = _wheels(log), {1: [0], 2: [1, 0], 4: [1, 0, 3, 2]}
        order = other[len(wheels.names)]
        angle = None if wheels.angle_rad is None else wheels.angle_rad[:, order]
        return _with(log, dataclasses.replace(wheels, speed=wheels.speed[:, order], angle_rad=angle))
    gnss = _gnss(log)
    v = gnss.velocity_enu_mps
    return _with(
        log,
        dataclasses.replace(
            gnss, enu_m=gnss.enu_m[:, [1, 0, 2]], velocity_enu_mps=None if v is None else v[:, [1, 0, 2]]
        ),
    )


def turned(log: Recording, rng: np.random.Generator) -> Recording:
    """The IMU is mounted upside down, or a quarter turn about z."""
    down = np.diag([1.0, -1.0, -1.0])
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return _rotated(log, down if rng.random() < 0.5 else quarter)


def wrong_unit(log: Recording, rng: np.random.Generator) -> Recording:
    """Gyro in deg/s, accelerometer in g, wheels in rev/min, or fixes in feet."""
    kind, imu, wheels, gnss = rng.integers(4), _imu(log), _wheels(log), _gnss(log)
    if kind == 0:
        return _with(log, dataclasses.replace(imu, gyro_radps=np.degrees(imu.gyro_radps)))
    if kind == 1:
        return _with(log, dataclasses.replace(imu, accel_mps2=imu.accel_mps2 / 9.80665))
    if kind == 2:
        speed = wheels.speed * 60.0 / (2.0 * np.pi)
        return _with(log, dataclasses.replace(wheels, speed=speed, angle_rad=None))
    return _with(log, dataclasses.replace(gnss, enu_m=gnss.enu_m / 0.3048))


def frozen(log: Recording, rng: np.random.Generator) -> Recording:
    """The receiver repeats a fix from a third of the log on, for 10 s or to the end."""
    gnss = _gnss(log)
    rows = _third(log, gnss.t_ns)
    first = int(np.argmax(rows))
    if rng.random() < 0.5:
        rows &= gnss.t_ns < gnss.t_ns[first] + 10 * 10**9
    enu = np.where(rows[:, None], gnss.enu_m[first], gnss.enu_m)
    v = gnss.velocity_enu_mps
    held = None if v is None else np.where(rows[:, None], v[first], v)
    return _with(log, dataclasses.replace(gnss, enu_m=enu, velocity_enu_mps=held))


def rate(log: Recording, rng: np.random.Generator) -> Recording:
    """One channel comes at a tenth of its rate, all the time or from a third of the log on."""
    channel = _some(log, rng)
    keep = np.arange(len(channel)) % 10 == 0
    if rng.random() < 0.5:
        keep |= ~_third(log, channel.t_ns)
    return _with(log, channel.select(keep))


def missing(log: Recording, rng: np.random.Generator) -> Recording:
    """An axis of the IMU, a wheel, or the height of the fixes is missing."""
    kind, imu, gnss = rng.integers(3), _imu(log), _gnss(log)
    if kind == 0:
        axis, which = int(rng.integers(3)), str(rng.choice(["gyro_radps", "accel_mps2"]))
        values = getattr(imu, which).copy()
        values[:, axis] = np.nan
        return _with(log, dataclasses.replace(imu, **{which: values}))
    if kind == 1:
        wheels = _wheels(log)
        speed = np.where(np.arange(wheels.speed.shape[1]) == 0, 0.0, wheels.speed)
        return _with(log, dataclasses.replace(wheels, speed=speed, angle_rad=None))
    enu = gnss.enu_m.copy()
    enu[:, 2] = np.nan
    return _with(log, dataclasses.replace(gnss, enu_m=enu))


FAULTS: dict[str, Fault] = {
    one.__name__: one
    for one in (
        outage, noise, lag, dropout, clock_jump, future, duplicates, shuffling, stuck, saturated, swapped,
        turned, wrong_unit, frozen, rate, missing,
    )
}  # fmt: skip


# --- order of arrival ------------------------------------------------------------------------------------

Rearranged = Callable[[Iterator[Message]], Iterator[Message]]


@dataclass(frozen=True, eq=False, repr=False)
class ArrivingRecording(Recording):
    """A recording whose messages arrive otherwise than in order of time."""

    arrival: tuple[Rearranged, ...] = field(default=())

    def messages(self) -> Iterator[Message]:
        """The messages as they arrive."""
        messages = super().messages()
        for rearranged in self.arrival:
            messages = rearranged(messages)
        return messages


def _arriving(log: Recording, how: Rearranged) -> Recording:
    fields = {spec.name: getattr(log, spec.name) for spec in dataclasses.fields(Recording)}
    return ArrivingRecording(**fields, arrival=(*getattr(log, "arrival", ()), how))
