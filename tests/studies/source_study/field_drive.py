"""A drive like the study's field test: the robot on sand, a stand-alone receiver, partial canopy.

The study's robot carried an MTi-680 logged at 100 Hz; its path, ground and
commands are not stated. Here it wanders over loose and medium sand at speeds
chosen for a mean near 0.9 m/s; the receiver gives stand-alone fixes and loses
them under trees. What the figures share with the study is their kind, not
their course.
"""

import math
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.frames import enu_to_geodetic
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.analysis.speeds import CUTOFF_HZ, imu_speed, low_pass
from terrafusion.twin.simulate import simulate
from tests.studies.source_study.published import VEHICLE

SCENARIO = "field_sand"
HIGH_HZ = 2.0  # above this the robot's own speed profile holds nothing: what is faster is vibration and shock


@dataclass(frozen=True, eq=False)
class FieldDrive:
    """What Figs. 11 to 15 of the study show, from a run of the twin.

    Attributes:
        imu_t_s, accel_mps2: (N,) s and (N, 3) m/s2, specific force as measured.
        imu_mps: (N,) speed from it (eq. 4).
        truth_mps: (N,) true forward speed at `imu_t_s`.
        gnss_t_s, lat_lon_deg, altitude_m: (K,) s, (K, 2) deg, (K,) m above the datum.
        velocity_enu_mps, ground_mps: (K, 3) m/s of the receiver, (K,) from its horizontal part (eq. 3).
    """

    imu_t_s: Array
    accel_mps2: Array
    imu_mps: Array
    truth_mps: Array
    gnss_t_s: Array
    lat_lon_deg: Array
    altitude_m: Array
    velocity_enu_mps: Array
    ground_mps: Array


def drive_field(seed: int) -> FieldDrive:
    """One run of the scenario `field_sand`, as the receiver and the IMU report it."""
    return field_drive_of(simulate(SCENARIO, vehicle=VEHICLE, seed=seed))


def field_drive_of(recording: Recording) -> FieldDrive:
    """The recording's IMU and GNSS as the study shows them.

    Raises:
        ValueError: the recording lacks IMU, GNSS with velocities, truth with its twist, or a datum.
    """
    imu, gnss, truth, datum = recording.imu, recording.gnss, recording.truth, recording.datum
    if not (imu and gnss and truth and datum) or truth.twist_body is None or gnss.velocity_enu_mps is None:
        raise ValueError(
            "the field figures need IMU, GNSS with velocities, truth with its twist, and a datum"
        )
    start = recording.start_ns
    imu_t_s, gnss_t_s = (np.asarray((t_ns - start) * 1e-9) for t_ns in (imu.t_ns, gnss.t_ns))
    geodetic = enu_to_geodetic(gnss.enu_m, datum)
    velocity = gnss.velocity_enu_mps
    return FieldDrive(
        imu_t_s=imu_t_s,
        accel_mps2=imu.accel_mps2,
        imu_mps=low_pass(imu_t_s, imu_speed(imu, start), CUTOFF_HZ),
        truth_mps=np.interp(imu_t_s, (truth.t_ns - start) * 1e-9, truth.twist_body[:, 0]),
        gnss_t_s=gnss_t_s,
        lat_lon_deg=geodetic[:, :2],
        altitude_m=geodetic[:, 2] - float(datum[2]),
        velocity_enu_mps=velocity,
        ground_mps=np.hypot(velocity[:, 0], velocity[:, 1]),
    )


def field_measures(drive: FieldDrive) -> dict[str, float]:
    """The drive in numbers.

    `fast_share`: percent of the forward acceleration's variance above `HIGH_HZ`.
    `peak`: its largest deviation from the mean over its root mean square.
    `excess_kurtosis`: 0 for Gaussian vibration, positive where there are shocks.
    `drops`: falls of ground speed by a third within 2 s and back, a minute.
    `imu_phase`: correlation of the IMU's and the true speed's changes over 5 s.
    `imu_drift`: mean absolute error of IMU speed at the end, last 30 s, m/s.
    """
    forward = drive.accel_mps2[:, 0] - drive.accel_mps2[:, 0].mean()
    fast = forward - low_pass(drive.imu_t_s, forward, HIGH_HZ)
    step = round(5.0 / float(np.median(np.diff(drive.imu_t_s))))
    changes = [s[step:] - s[:-step] for s in (drive.imu_mps, drive.truth_mps)]
    late = drive.imu_t_s > drive.imu_t_s[-1] - 30.0
    return {
        "fast_share": 100.0 * float(fast.var() / forward.var()),
        "peak": float(np.abs(forward).max() / forward.std()),
        "excess_kurtosis": float(np.mean(fast**4) / np.mean(fast**2) ** 2 - 3.0),
        "mean_mps": float(drive.ground_mps.mean()),
        "max_mps": float(drive.ground_mps.max()),
        "drops": 60.0 * _drops(drive.gnss_t_s, drive.ground_mps) / float(drive.gnss_t_s[-1]),
        "altitude_m": float(np.percentile(np.abs(drive.altitude_m - drive.altitude_m[0]), 95)),
        "up_mps": float(drive.velocity_enu_mps[:, 2].std()),
        "imu_phase": _correlation(changes[0], changes[1]),
        "imu_drift_mps": float(np.abs(drive.imu_mps - drive.truth_mps)[late].mean()),
    }


def _correlation(a: Array, b: Array) -> float:
    """Pearson's correlation of two series (N,)."""
    return float(np.mean((a - a.mean()) * (b - b.mean())) / (a.std() * b.std()))


def _drops(t_s: Array, speed: Array) -> int:
    """How often a speed above 0.5 m/s falls by a third within 2 s and is back within another 2 s."""
    count, last = 0, -math.inf
    for i, now in enumerate(t_s.tolist()):
        before = speed[(t_s >= now - 2.0) & (t_s < now)]
        after = speed[(t_s > now) & (t_s <= now + 2.0)]
        if now - last > 2.0 and before.size and after.size:
            peak = min(float(before.max()), float(after.max()))
            if peak > 0.5 and speed[i] < peak * 2.0 / 3.0:
                count, last = count + 1, now
    return count
