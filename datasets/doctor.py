"""The input doctor: what is odd about a recording, with the evidence and what to do about it.

Each check is one function from a recording to findings; `CHECKS` lists them.
A clean log has no finding. The doctor only looks: it changes nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.frames import GRAVITY_MPS2
from terrafusion.datasets.recording import Channel, Gnss, Recording, Wheels
from terrafusion.datasets.sensors import Rig

Array = NDArray[np.float64]

CLOCKED = ("command", "wheels", "imu", "gnss", "motor")
"""Channels that should tick evenly; terrain labels come when they come."""

LIMITS = {
    ("command", "_mps"): 100.0,
    ("command", "_radps"): 100.0,
    ("wheels", "_mps"): 100.0,
    ("wheels", "_radps"): 1000.0,
    ("imu", "_radps"): 100.0,
    ("imu", "_mps2"): 2000.0,
    ("gnss", "_m"): 2e7,
    ("gnss", "_mps"): 1e4,
    ("motor", "_a"): 1e5,
    ("motor", "_v"): 1e5,
    ("truth", "_m"): 2e7,
}
"""Magnitudes that nothing on a ground robot reaches, by channel and unit. MEMS gyros end at 70 rad/s
(4000 deg/s), accelerometers at 2000 m/s2 (200 g); projected coordinates at 1e7 m."""

DEGREES_SLOPE = 15.0
"""Gyro rate over the difference of the side speeds, 1/m: the inverse track, 0.3 to 4, unless in deg/s."""
GAP_PERIODS, GAP_S = 5.0, 0.2
JITTER_SHARE = 0.2
MOVING_MPS = 0.1


@dataclass(frozen=True)
class Finding:
    """One oddity: `severity` "error" (results would be wrong) or "warning" (results suffer)."""

    severity: str
    channel: str
    what: str
    evidence: str
    fix: str

    def to_dict(self) -> dict[str, str]:
        """The fields by name, for JSON."""
        return asdict(self)


@dataclass(frozen=True)
class Patient:
    """What a check looks at: the recording, and the robot's geometry where known."""

    recording: Recording
    rig: Rig | None

    def wheel_radius_m(self) -> float | None:
        """Wheel radius of the log, else of the rig; 1 where speeds are in m/s already."""
        wheels = self.recording.wheels
        if wheels is not None and wheels.unit == "mps":
            return 1.0
        return self.recording.overrides.wheel_radius_m or (self.rig.wheel_radius_m if self.rig else None)

    def since_start_s(self, t_ns: np.int64) -> float:
        """Seconds from the start of the recording."""
        return float(t_ns - self.recording.start_ns) * 1e-9


def examine(recording: Recording, rig: Rig | None = None) -> list[Finding]:
    """All findings of all checks, errors first.

    Args:
        recording: the drive.
        rig: geometry of the robot; without it wheel rates (rad/s) are not compared with GNSS speed.
    """
    patient = Patient(recording, rig)
    findings = list(check_magnitude(patient))
    if not findings:  # the others would compute with impossible numbers
        findings = [finding for check in CHECKS for finding in check(patient)]
    return sorted(findings, key=lambda finding: finding.severity != "error")


def check_magnitude(patient: Patient) -> Iterator[Finding]:
    """Numbers that no robot reaches: a wrong unit, or memory read as numbers."""
    recording = patient.recording
    tables = {name: (channel.t_ns, channel.columns()) for name, channel in recording.channels().items()}
    if recording.truth is not None and len(recording.truth):
        position = dict(zip(("x_m", "y_m", "z_m"), recording.truth.position_m.T, strict=True))
        tables["truth"] = recording.truth.t_ns, position
    for name, (t_ns, columns) in tables.items():
        for column, values in columns.items():
            limit = LIMITS.get((name, column[column.rindex("_") :] if "_" in column else ""))
            bad = np.flatnonzero(np.abs(values) > limit) if limit is not None else np.zeros(0, dtype=int)
            if bad.size:
                at_s = patient.since_start_s(t_ns[bad[0]])
                yield Finding(
                    "error",
                    name,
                    f"{column} is {values[bad[0]]:g}, beyond anything possible",
                    f"at t = {at_s:.3f} s; {bad.size} of {len(values)} values beyond {limit:g}",
                    "is the unit right? mend these rows, or leave the cells empty",
                )


def check_jitter(patient: Patient) -> Iterator[Finding]:
    """Intervals that scatter: a clock of arrival rather than of measurement."""
    for name, channel in _clocked(patient.recording):
        dt = np.diff(channel.t_ns) * 1e-9
        if len(dt) < 20:
            continue
        period = float(np.median(dt))
        share = float((np.abs(dt - period) > 0.5 * period).mean())
        if share > JITTER_SHARE:
            yield Finding(
                "warning",
                name,
                "uneven sampling",
                f"{share:.0%} of the intervals are more than half off the median of {period * 1e3:.3g} ms",
                "use the sensor's own time stamps",
            )


def check_gaps(patient: Patient) -> Iterator[Finding]:
    """Stretches without samples."""
    for name, channel in _clocked(patient.recording):
        dt = np.diff(channel.t_ns) * 1e-9
        if not len(dt):
            continue
        gaps = np.flatnonzero((dt > GAP_PERIODS * np.median(dt)) & (dt > GAP_S))
        if gaps.size:
            worst = int(gaps[np.argmax(dt[gaps])])
            yield Finding(
                "warning",
                name,
                f"{gaps.size} gap{'s' if gaps.size > 1 else ''}",
                f"longest {dt[worst]:.2f} s from t = {patient.since_start_s(channel.t_ns[worst]):.2f} s, "
                f"{dt[gaps].sum():.2f} s in all",
                "expect larger uncertainty there; look for dropped messages",
            )


def check_duplicates(patient: Patient) -> Iterator[Finding]:
    """Samples that share their time."""
    for name, channel in patient.recording.channels().items():
        repeated = np.flatnonzero(np.diff(channel.t_ns) == 0)
        if repeated.size:
            yield Finding(
                "warning",
                name,
                f"{repeated.size} repeated times",
                f"first at t = {patient.since_start_s(channel.t_ns[repeated[0]]):.3f} s",
                "remove the double samples",
            )


def check_held(patient: Patient) -> Iterator[Finding]:
    """Values repeated between true samples: the rate of the log is not the rate of the sensor."""
    recording = patient.recording
    signals: dict[str, tuple[Channel, Array]] = {}
    if recording.imu is not None:
        signals["imu"] = recording.imu, np.hstack([recording.imu.gyro_radps, recording.imu.accel_mps2])
    if recording.wheels is not None:
        signals["wheels"] = recording.wheels, recording.wheels.speed
    if recording.gnss is not None:
        signals["gnss"] = recording.gnss, recording.gnss.enu_m
    for name, (channel, values) in signals.items():
        share, run = _held_share(channel.t_ns, values)
        if share > 0.5:
            yield Finding(
                "warning",
                name,
                "values are held",
                f"{share:.0%} of the samples repeat the one before while the signal changes; "
                f"a new value comes every {run:.1f} samples",
                "keep the first sample of each run, or log at the sensor's rate",
            )


def _held_share(t_ns: NDArray[np.int64], values: Array) -> tuple[float, float]:
    """Share of repeats among samples inside a change, and the mean run length there."""
    values = np.nan_to_num(values[:, ~np.isnan(values).all(axis=0)])
    if len(values) < 50 or not values.size:
        return 0.0, 1.0
    period = max(float(np.median(np.diff(t_ns))) * 1e-9, 1e-4)
    reach = int(np.clip(round(0.5 / period), 3, 500))
    spread = np.percentile(values, 95, axis=0) - np.percentile(values, 5, axis=0)
    across = np.abs(values[2 * reach :] - values[: -2 * reach])
    changing = np.any(across > 0.1 * np.where(spread > 0, spread, np.inf), axis=1)
    same = np.all(values[reach:-reach] == values[reach - 1 : -reach - 1], axis=1)
    if changing.sum() < 20:
        return 0.0, 1.0
    share = float(same[changing].mean())
    return share, 1.0 / max(1.0 - share, 1e-3)


def check_gravity(patient: Patient) -> Iterator[Finding]:
    """Specific force must average to +g on z: anything else is a wrong mounting, sign or unit."""
    imu = patient.recording.imu
    if imu is None or not imu.has_accel() or len(imu) < 10:
        return
    mean = np.nanmean(imu.accel_mps2, axis=0)
    size = float(np.linalg.norm(mean))
    evidence = f"mean specific force ({mean[0]:.2f}, {mean[1]:.2f}, {mean[2]:.2f}) m/s2"
    if 0.8 < size < 1.2:
        yield Finding("error", "imu", "acceleration looks like g, not m/s2", evidence, "multiply by 9.80665")
    elif not 0.85 * GRAVITY_MPS2 < size < 1.15 * GRAVITY_MPS2:
        yield Finding(
            "error",
            "imu",
            f"mean specific force is {size:.2f} m/s2, not 9.8",
            evidence,
            "give raw accelerometer data in m/s2, gravity included",
        )
    elif mean[2] < np.cos(np.radians(30.0)) * size:
        axis = int(np.argmax(np.abs(mean)))
        where = f"{'+' if mean[axis] > 0 else '-'}{'xyz'[axis]}"
        yield Finding(
            "error",
            "imu",
            f"gravity stands on {where}, not on +z",
            evidence,
            "give the vehicle (its IMU mounting), or rotate the IMU to x forward, y left, z up",
        )


def check_wheel_signs(patient: Patient) -> Iterator[Finding]:
    """Left and right must mostly turn the same way."""
    wheels = patient.recording.wheels
    if wheels is None or not wheels.has_sides():
        return
    sides = wheels.side_speeds_mps(1.0)
    sides = sides[np.isfinite(sides).all(axis=1)]
    moving = (np.abs(sides) > 0.05 * np.abs(sides).max(initial=0.0)).all(axis=1) & sides.any(axis=1)
    opposite = (np.sign(sides[:, 0]) != np.sign(sides[:, 1])) & moving
    if moving.sum() < 50 or opposite.sum() < 0.9 * moving.sum():
        return
    mean = np.abs(sides[moving]).mean()
    if np.abs(sides[moving].sum(axis=1)).mean() < 0.5 * mean:
        yield Finding(
            "warning",
            "wheels",
            "left and right turn against each other nearly always",
            f"in {opposite.sum() / moving.sum():.0%} of the samples that move",
            "if the robot did not only spin on the spot, change the sign of one side",
        )


def check_yaw_sign(patient: Patient) -> Iterator[Finding]:
    """The gyro's yaw rate must rise and fall with that of the wheels."""
    wheels, imu = patient.recording.wheels, patient.recording.imu
    if wheels is None or imu is None or not wheels.has_sides() or len(imu) < 20:
        return
    rate = imu.gyro_radps[:, 2]
    if np.isnan(rate).all():
        return
    sides = wheels.side_speeds_mps(patient.wheel_radius_m() or 0.15)
    turn = sides[:, 1] - sides[:, 0]
    origin = max(int(wheels.t_ns[0]), int(imu.t_ns[0]))
    common_s = (min(int(wheels.t_ns[-1]), int(imu.t_ns[-1])) - origin) * 1e-9
    grid: Array = np.arange(0.0, common_s, 0.5)
    if len(grid) < 20:
        return
    by_wheels = _mean_between(grid, (wheels.t_ns - origin).astype(float) * 1e-9, turn)
    by_gyro = _mean_between(grid, (imu.t_ns - origin).astype(float) * 1e-9, rate)
    if by_wheels.std() < 0.02 or by_gyro.std() < 0.02:
        return
    r = float(np.corrcoef(by_wheels, by_gyro)[0, 1])
    evidence = f"correlation {r:.2f} of the half-second means"
    slope = abs(r) * float(by_gyro.std() / by_wheels.std())
    if slope > DEGREES_SLOPE and abs(r) > 0.5:
        yield Finding(
            "error",
            "imu",
            "gyro z is far larger than the wheels' yaw rate: it looks like deg/s",
            f"{slope:.0f} rad/s for each m/s between the sides; {evidence}",
            "multiply by pi / 180, and check the wheel radius",
        )
    elif r < -0.5:
        yield Finding(
            "error",
            "imu",
            "gyro z turns against the wheels",
            evidence,
            "change the sign of the gyro (z up, left turn positive), or swap left and right wheels",
        )
    elif r < 0.3 and by_wheels.std() > 0.05 and by_gyro.std() > 0.05:
        yield Finding(
            "warning",
            "imu",
            "gyro z does not follow the wheels",
            evidence,
            "check the IMU's axes and the two clocks; on slippery ground it may be real",
        )


def _mean_between(grid_s: Array, t_s: Array, values: Array) -> Array:
    """Means of a signal over the intervals of the grid, (len(grid) - 1,)."""
    known = np.isfinite(values)
    t_s, values = t_s[known], values[known]
    area = np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(t_s))])
    return np.diff(np.interp(grid_s, t_s, area)) / np.diff(grid_s)


def check_sigma(patient: Patient) -> Iterator[Finding]:
    """A sigma of a fix must be a positive number."""
    gnss = patient.recording.gnss
    if gnss is None:
        return
    sigma = gnss.sigma_enu_m[:, :2]
    if np.isfinite(gnss.enu_m[:, 2]).any():
        sigma = gnss.sigma_enu_m
    bad = ~np.all(sigma > 0.0, axis=1)
    if bad.any():
        first = int(np.flatnonzero(bad)[0])
        missing_only = not (sigma <= 0.0).any()  # such fixes are left out, the others would mislead
        at_s, said = patient.since_start_s(gnss.t_ns[first]), gnss.sigma_enu_m[first].tolist()
        yield Finding(
            "warning" if missing_only else "error",
            "gnss",
            f"{int(bad.sum())} of {len(bad)} fixes have a sigma that is zero, negative or missing",
            f"first at t = {at_s:.2f} s: {said} m",
            "give the receiver's accuracy; such fixes cannot be weighted",
        )


def check_jumps(patient: Patient) -> Iterator[Finding]:
    """Steps between fixes that no drive explains."""
    gnss = patient.recording.gnss
    if gnss is None or len(gnss) < 10:
        return
    dt = np.diff(gnss.t_ns) * 1e-9
    step = np.diff(gnss.enu_m[:, :2], axis=0)
    near = (dt > 0) & (dt <= GAP_PERIODS * np.median(dt)) & np.isfinite(step).all(axis=1)
    speed = np.where(near[:, None], step, 0.0) / np.where(dt > 0, dt, 1.0)[:, None]
    smooth = np.stack([_running_median(speed[:, k], 9) for k in range(2)], axis=1)
    off = np.hypot(*((speed - smooth) * dt[:, None]).T) * near
    limit = max(1.0, 8.0 * float(np.median(off[near]))) if near.any() else np.inf
    jumps = np.flatnonzero(off > limit)
    if jumps.size:
        worst = int(jumps[np.argmax(off[jumps])])
        yield Finding(
            "warning",
            "gnss",
            f"{jumps.size} jump{'s' if jumps.size > 1 else ''} of position",
            f"largest {off[worst]:.2f} m at t = {patient.since_start_s(gnss.t_ns[worst + 1]):.2f} s",
            "multipath or a changed fix; the estimator's gate should reject them",
        )


def _running_median(values: Array, width: int) -> Array:
    padded = np.pad(values, width // 2, mode="edge")
    return np.asarray(np.median(np.lib.stride_tricks.sliding_window_view(padded, width), axis=1))


def check_speed_scale(patient: Patient) -> Iterator[Finding]:
    """Wheel speed against GNSS speed on straight stretches."""
    wheels, gnss, radius = patient.recording.wheels, patient.recording.gnss, patient.wheel_radius_m()
    if wheels is None or gnss is None or radius is None or len(gnss) < 20 or len(wheels) < 20:
        return
    ratios = _speed_ratios(wheels, gnss, radius)
    if len(ratios) < 5:
        return
    ratio = float(np.median(ratios))
    if abs(ratio - 1.0) > 0.2:
        yield Finding(
            "warning",
            "wheels",
            f"GNSS speed is {ratio:.2f} times the wheel speed",
            f"median of {len(ratios)} straight stretches, quartiles "
            f"{np.percentile(ratios, 25):.2f} to {np.percentile(ratios, 75):.2f}",
            "check wheel radius and unit; if they are right, the wheels slip",
        )


def _speed_ratios(wheels: Wheels, gnss: Gnss, radius: float, window_s: float = 10.0) -> Array:
    """GNSS chord over wheel distance for windows that are straight by the GNSS itself."""
    sides = wheels.side_speeds_mps(radius)
    known = np.isfinite(sides).all(axis=1)
    origin = gnss.t_ns[0]
    t_wheel = (wheels.t_ns[known] - origin) * 1e-9
    v = sides[known].mean(axis=1)
    if len(t_wheel) < 2:
        return np.zeros(0)
    distance = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(t_wheel))])
    fixed = np.isfinite(gnss.enu_m[:, :2]).all(axis=1)
    t, enu = (gnss.t_ns[fixed] - origin) * 1e-9, gnss.enu_m[fixed, :2]
    if len(t) < 2:
        return np.zeros(0)
    starts = np.arange(max(t[0], t_wheel[0]), min(t[-1], t_wheel[-1]) - window_s, window_s / 2)
    noise = float(np.nanmedian(gnss.sigma_enu_m[:, :2]))
    ratios = []
    for start in starts:
        ends = np.array([start, start + window_s / 2, start + window_s])
        a, b, c = np.stack([np.interp(ends, t, enu[:, k]) for k in range(2)], axis=1)
        rolled = float(np.diff(np.interp(ends[[0, 2]], t_wheel, distance))[0])
        chord, halves = np.linalg.norm(c - a), np.linalg.norm(b - a) + np.linalg.norm(c - b)
        if abs(rolled) > max(2.0, 3.0 * min(noise, 2.0)) and chord > 0.97 * halves:
            ratios.append(chord / abs(rolled))
    return np.array(ratios)


def check_spans(patient: Patient) -> Iterator[Finding]:
    """Channels must share a stretch of time."""
    channels = dict(_clocked(patient.recording))
    if len(channels) < 2:
        return
    last_start = max(channels, key=lambda name: channels[name].t_ns[0])
    first_end = min(channels, key=lambda name: channels[name].t_ns[-1])
    if channels[last_start].t_ns[0] > channels[first_end].t_ns[-1]:
        yield Finding(
            "error",
            last_start,
            f"begins after {first_end} has ended",
            f"{patient.since_start_s(channels[last_start].t_ns[0]):.2f} s against "
            f"{patient.since_start_s(channels[first_end].t_ns[-1]):.2f} s",
            "bring the channels onto one clock",
        )


def _clocked(recording: Recording) -> list[tuple[str, Channel]]:
    return [(name, channel) for name, channel in recording.channels().items() if name in CLOCKED]


CHECKS: tuple[Callable[[Patient], Iterator[Finding]], ...] = (
    check_spans,
    check_jitter,
    check_gaps,
    check_duplicates,
    check_held,
    check_gravity,
    check_wheel_signs,
    check_yaw_sign,
    check_sigma,
    check_jumps,
    check_speed_scale,
)
