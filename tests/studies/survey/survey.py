"""The public sets held against what was told of them: `python -m tests.studies.survey.survey`.

Opens every recording of the catalogue that is on this machine and prints a markdown table of what
`published.FACTS` expects beside what is found, as the files have it and as the catalogue's conventions
make of it. Exit status 1 where something is found that neither was told nor is known to be otherwise.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.catalog.catalog import (
    DATA_VARIABLE,
    CatalogFile,
    data_folders,
    load_catalog,
    sha256_of,
)
from terrafusion.datasets.checks.finding import CheckContext
from terrafusion.datasets.checks.imu import heading
from terrafusion.datasets.checks.measures import Measures, measure
from terrafusion.datasets.checks.motion import yaw_angles
from terrafusion.datasets.checks.path import dead_reckoned
from terrafusion.datasets.core.channels import Channel
from terrafusion.datasets.core.lag import lag_between
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.datasets.readers import open_recordings
from terrafusion.datasets.readers.formats import Request, format_of
from tests.studies.survey.published import FACTS, Fact, Value
from tests.studies.twin_field.wheel_trials import TRIALS_FILE, WheelTrials, read_wheel_trials

Array = NDArray[np.float64]

TURN_S = 0.5
"""Yaw rates are compared as means over this time."""
ENOUGH_TURNS, LEAST_TURN_RADPS = 20, 0.01
WRONG = "WRONG"


@dataclass(frozen=True)
class Drives:
    """One catalogued recording: the drives in its file, and what is measured on them."""

    name: str
    path: Path

    @cached_property
    def logged(self) -> list[Recording]:
        """As the file has them: no convention of the catalogue applied."""
        pinned = sha256_of(self.path) if self.path.is_file() else ""
        return list(format_of(self.path).read(Request(self.path, sha256=pinned)))

    @cached_property
    def opened(self) -> list[Recording]:
        """As a user gets them."""
        return open_recordings(self.path)

    @cached_property
    def measures(self) -> Measures:
        return measure(self.opened)

    @cached_property
    def logged_measures(self) -> Measures:
        return measure(self.logged)

    @cached_property
    def trials(self) -> WheelTrials:
        """Of a file that holds trials of a single wheel."""
        return read_wheel_trials(self.path)


class Estimate(float):
    """A number with its 95 % interval."""

    low: float
    high: float

    def __new__(cls, value: float, low: float, high: float) -> Self:
        number = super().__new__(cls, value)
        number.low, number.high = sorted((low, high))
        return number

    def __str__(self) -> str:
        return f"{float(self):.4g} [{self.low:.4g}, {self.high:.4g}]"


@dataclass(frozen=True)
class Row:
    """A line of the table: a fact, what was found, how many recordings it was found on, and the verdict."""

    fact: Fact
    found: tuple[Value | None, ...]

    def verdict(self) -> str:
        """`agrees`, `as before` (nobody told it, but it was measured here), `otherwise` (as `Fact.instead`
        says), or `WRONG`; recordings where it cannot be measured do not count."""
        known = [value for value in self.found if value is not None]
        if known and all(self.fact.holds(value) for value in known):
            return "agrees" if self.fact.is_told() else "as before"
        if known and self.fact.instead and all(self.fact.instead.holds(value) for value in known):
            return f"otherwise: {self.fact.instead.told}"
        return WRONG

    def cells(self) -> list[str]:
        """Texts of the table's columns."""
        known = [value for value in self.found if value is not None]
        numbers = [value for value in known if not isinstance(value, str)]
        if len(known) == 1 and isinstance(known[0], Estimate):
            found = str(known[0])
        elif numbers:
            low, high = f"{min(numbers):.4g}", f"{max(numbers):.4g}"
            found = low if low == high else f"{low} to {high}"
        else:
            found = ", ".join(sorted({str(value) for value in known})) or "nothing"
        many = len(self.found) > 1
        of = f"{self.fact.of} ({len(known)} of {len(self.found)})" if many else self.fact.of
        return [of, self.fact.quantity, f"{self.fact.said} ({self.fact.interval()})", found, self.verdict()]


def survey(names: str = "*") -> Iterator[Row]:
    """The facts on recordings whose name matches, that are on this machine, each with what is found.

    Raises:
        TerrafusionError: a recording cannot be read.
    """
    drives = [Drives(name, path) for name, path in on_this_machine() if fnmatchcase(name, names)]
    for fact in FACTS:
        found = [QUANTITIES[fact.quantity](one) for one in drives if fnmatchcase(one.name, fact.of)]
        if found:
            yield Row(fact, tuple(found))


def on_this_machine() -> list[tuple[str, Path]]:
    """Name and first file of what is surveyed and is in `TERRAFUSION_DATA` or downloaded."""
    found = ((name, _local(entries)) for name, entries in surveyed().items())
    return [(name, path) for name, path in found if path is not None]


def surveyed() -> dict[str, list[CatalogFile]]:
    """Files by name of the catalogued recordings, and of the trials of a single wheel."""
    catalog = load_catalog()
    return catalog.recordings() | {TRIALS_FILE: [file for file in catalog.files if file.file == TRIALS_FILE]}


def markdown(rows: Sequence[Row]) -> str:
    """The rows as a table."""
    head = ["recording", "quantity", "told", "found", "verdict"]
    lines = [head, ["---"] * len(head), *(row.cells() for row in rows)]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def _local(entries: Sequence[CatalogFile]) -> Path | None:
    places = (folder / entry.file for entry in entries for folder in data_folders())
    return next((place for place in places if place.is_file()), None)


# --- quantities: from the drives of one recording to a number, a word, or None where it cannot be told


def _rate(channel: str) -> Callable[[Drives], float | None]:
    def rate(drives: Drives) -> float | None:
        rates = [_rows_a_second(getattr(r, channel)) for r in drives.logged]
        known = [rate for rate in rates if rate is not None]
        return float(np.median(known)) if known else None

    return rate


def _rows_a_second(channel: Channel | Trajectory | None) -> float | None:
    if channel is None or len(channel) < 2:
        return None
    return (len(channel) - 1) / (float(channel.t_ns[-1] - channel.t_ns[0]) * 1e-9)


def _updates(channel: str) -> Callable[[Drives], float | None]:
    """True updates a second that are left once the conventions have dropped what is held."""

    def updates(drives: Drives) -> float | None:
        rates = [_rows_a_second(getattr(r, channel)) for r in drives.opened]
        known = [rate for rate in rates if rate is not None]
        return float(np.median(known)) if known else None

    return updates


def _path(channel: str) -> Callable[[Drives], float | None]:
    return lambda drives: drives.measures.path_m.get(channel)


def _ratio(channel: str) -> Callable[[Drives], float | None]:
    """Length of the path by another channel over that by the wheels."""

    def ratio(drives: Drives) -> float | None:
        paths = drives.measures.path_m
        return paths[channel] / paths["wheels"] if {channel, "wheels"} <= set(paths) else None

    return ratio


def _lag(quantity: str, early: str, late: str) -> Callable[[Drives], Estimate | None]:
    """Seconds by which `late` tells, in the log, after `early` does."""

    def lag(drives: Drives) -> Estimate | None:
        for pair in drives.logged_measures.lags:
            if pair.quantity == quantity and {pair.earlier, pair.later} == {early, late}:
                sign = 1.0 if pair.later == late else -1.0
                return Estimate(sign * pair.seconds, sign * pair.low_s, sign * pair.high_s)
        return None

    return lag


def _accelerometer_behind(drives: Drives) -> Estimate | None:
    """Seconds by which, in the log, the IMU's x feels a change of speed after the wheels tell it."""
    wheels, imu = drives.logged[0].wheels, drives.logged[0].imu
    if wheels is None or imu is None or len(wheels) < ENOUGH_TURNS:
        return None
    t_wheels, t_imu = ((channel.t_ns - imu.t_ns[0]) * 1e-9 for channel in (wheels, imu))
    gain = np.gradient(wheels.side_speeds_mps(1.0).mean(axis=1), t_wheels)
    lag = lag_between(t_wheels, gain, t_imu, imu.accel_mps2[:, 0], reach_s=0.5)
    return Estimate(lag.seconds, lag.low_s, lag.high_s) if lag is not None else None


def _turn_r(one: str, other: str, *, logged: bool = False) -> Callable[[Drives], float | None]:
    """Correlation of two channels' yaw rates over all drives of a recording."""

    def correlation(drives: Drives) -> float | None:
        a, b = _rates_in_common(drives.logged if logged else drives.opened, one, other)
        if len(a) < ENOUGH_TURNS or min(a.std(), b.std()) < LEAST_TURN_RADPS:
            return None
        return float(np.corrcoef(a, b)[0, 1])

    return correlation


def _rates_in_common(recordings: Sequence[Recording], one: str, other: str) -> tuple[Array, Array]:
    pairs = []
    for recording in recordings:
        known = yaw_angles(CheckContext(recording, None))
        if one in known and other in known:
            a, b = known[one], known[other]
            grid = np.arange(max(a.t_s[0], b.t_s[0]), min(a.t_s[-1], b.t_s[-1]), TURN_S)
            if len(grid) > 1:
                pairs.append((a.rates(grid), b.rates(grid)))
    if not pairs:
        return np.zeros(0), np.zeros(0)
    return np.concatenate([a for a, _ in pairs]), np.concatenate([b for _, b in pairs])


def _gravity_axis(drives: Drives) -> str | None:
    gravity = drives.logged_measures.gravity
    return gravity.axis if gravity else None


def _gravity_size(drives: Drives) -> float | None:
    gravity = drives.measures.gravity
    return gravity.mean_mps2[2] if gravity else None


def _off_forward(drives: Drives) -> float | None:
    """Degrees by which the IMU's x lies left of forward, told by changes of speed and by the turns."""
    found = heading(CheckContext(drives.opened[0], None))
    return float(np.degrees(found.angle)) if found is not None and found.angle is not None else None


def _effective_track(drives: Drives) -> float | None:
    return drives.measures.yaw.effective_track_m if drives.measures.yaw else None


def _sigma(which: str) -> Callable[[Drives], float | None]:
    def sigma(drives: Drives) -> float | None:
        known = drives.measures.sigma_m
        return float(getattr(known, which)) if known else None

    return sigma


def _side_speed(side: int) -> Callable[[Drives], float | None]:
    """Mean speed of a side in the log's own sign and unit."""

    def speed(drives: Drives) -> float | None:
        wheels = drives.logged[0].wheels
        return float(np.nanmean(wheels.side_speeds_mps(1.0)[:, side])) if wheels is not None else None

    return speed


def _reckoned_rms(*, gyro: bool) -> Callable[[Drives], float | None]:
    """Rms distance (m) of the fixes from the path by wheels and gyro, or wheels alone, laid onto them."""

    def rms(drives: Drives) -> float | None:
        recording = drives.opened[0]
        gnss, track = recording.gnss, recording.overrides.track_m
        known = yaw_angles(CheckContext(recording, None))
        if gnss is None or track is None or "wheels" not in known:
            return None
        if not gyro and recording.imu is not None:
            wheels = known["wheels"]
            rate = np.gradient(wheels.value / track, wheels.t_s)
            turned = recording.imu.gyro_radps.copy()
            turned[:, 2] = np.interp((recording.imu.t_ns - recording.start_ns) * 1e-9, wheels.t_s, rate)
            recording = _with_gyro(recording, turned)
        antenna = complex(*recording.overrides.antenna_m[:2]) if recording.overrides.antenna_m else 0j
        reckoned = dead_reckoned(CheckContext(recording, None), antenna)
        if reckoned is None:
            return None
        t, _, path = reckoned
        p = np.interp((gnss.t_ns - recording.start_ns) * 1e-9, t, path)
        g = gnss.enu_m[:, 0] + 1j * gnss.enu_m[:, 1]
        p, g = p - p.mean(), g - g.mean()
        turn = np.vdot(p, g)
        return float(np.sqrt(np.mean(np.abs(g - p * turn / abs(turn)) ** 2)))

    return rms


def _with_gyro(recording: Recording, gyro_radps: Array) -> Recording:
    assert recording.imu is not None
    return dataclasses.replace(recording, imu=dataclasses.replace(recording.imu, gyro_radps=gyro_radps))


def _rows_held(drives: Drives) -> float | None:
    """Rows between changes of the left wheels' speed in the log."""
    runs = [
        np.diff(np.flatnonzero(np.diff(r.wheels.speed[:, 0]))) for r in drives.logged if r.wheels is not None
    ]
    held = np.concatenate([np.zeros(0), *runs])
    return float(np.median(held)) if held.size else None


def _imu_ends_late(drives: Drives) -> float | None:
    """Seconds from the last row of the wheels to that of the IMU."""
    wheels, imu = drives.logged[0].wheels, drives.logged[0].imu
    return None if wheels is None or imu is None else float(imu.t_ns[-1] - wheels.t_ns[-1]) * 1e-9


def _wheels_of(drives: Drives) -> str | None:
    wheels = drives.logged[0].wheels
    return f"{' '.join(wheels.names)} {wheels.unit}" if wheels is not None else None


def _terrain(drives: Drives) -> str:
    return drives.opened[0].terrain_name or "none"


CHANNELS = ("command", "wheels", "imu", "gnss", "motor", "truth")
QUANTITIES: dict[str, Callable[[Drives], Value | None]] = {
    "drives": lambda drives: len(drives.opened),
    "duration, s": lambda drives: drives.opened[0].duration_s(),
    "channels": lambda drives: " ".join(c for c in CHANNELS if getattr(drives.opened[0], c) is not None),
    "terrain": _terrain,
    "wheels of": _wheels_of,
    "rows a wheel speed is held": _rows_held,
    "imu ends after wheels, s": _imu_ends_late,
    "wheel radius, m": lambda drives: drives.opened[0].overrides.wheel_radius_m,
    **{f"{c} rows a second": _rate(c) for c in CHANNELS},
    **{f"{c} updates a second": _updates(c) for c in CHANNELS},
    **{f"path by {c}, m": _path(c) for c in ("wheels", "gnss", "truth")},
    **{f"path by {c} over path by wheels": _ratio(c) for c in ("gnss", "truth")},
    "gravity in the log on": _gravity_axis,
    "gravity on body z, m/s2": _gravity_size,
    "imu x left of forward, deg": _off_forward,
    "gyro with wheels, r": _turn_r("gyro", "wheels"),
    "gyro with truth, r": _turn_r("gyro", "truth"),
    "gyro with wheels in the log, r": _turn_r("gyro", "wheels", logged=True),
    "gyro with truth in the log, r": _turn_r("gyro", "truth", logged=True),
    "track in yaw, m": _effective_track,
    "left in the log": _side_speed(0),
    "right in the log": _side_speed(1),
    "truth behind gyro, s": _lag("yaw rate", "imu", "truth"),
    "gyro behind wheels, s": _lag("yaw rate", "wheels", "imu"),
    "wheels behind truth, s": _lag("speed", "truth", "wheels"),
    "accelerometer behind wheels, s": _accelerometer_behind,
    "least sigma, m": _sigma("min"),
    "largest sigma, m": _sigma("max"),
    "reckoned by gyro beside fixes, m rms": _reckoned_rms(gyro=True),
    "reckoned by wheels beside fixes, m rms": _reckoned_rms(gyro=False),
    "trials": lambda drives: len(drives.trials),
    "least slip": lambda drives: float(drives.trials.slip.min()),
    "largest slip": lambda drives: float(drives.trials.slip.max()),
    "braked trials": lambda drives: int((drives.trials.slip < 0.0).sum()),
    "largest side-slip, deg": lambda drives: float(np.degrees(drives.trials.side_slip_rad.max())),
}


def main() -> int:
    """Print the table; 1 where a fact is wrong, or where there is no recording."""
    rows = list(survey(*sys.argv[1:2]))
    if not rows:
        print(f"error: no such recording here; set {DATA_VARIABLE}, or download it", file=sys.stderr)
        return 1
    print(markdown(rows), end="")
    return int(any(row.verdict() == WRONG for row in rows))


if __name__ == "__main__":
    sys.exit(main())
