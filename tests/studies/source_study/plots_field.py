"""Plots of the field test of the source study: Figs. 11 to 15."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.reports.plots import style
from terrafusion.fusion.reports.plots.sheet import Sheet
from tests.studies.source_study.field_drive import FieldDrive

GAP_S = 1.0
"""No line is drawn over a longer time without fixes."""
COLOURS = (style.SENSOR_COLOURS["wheels"], style.SENSOR_COLOURS["gnss"], style.SENSOR_COLOURS["gyro"])
MOST_ACCEL = 4000
GNSS = COLOURS[1]


def plot_acceleration(sheet: Sheet, drive: FieldDrive) -> list[str]:
    """Fig. 11: specific force along the body's axes, as measured; the keys of the figures."""
    return _three(sheet, "accel", drive.imu_t_s, drive.accel_mps2, [f"a_{axis}, m/s²" for axis in "xyz"])


def plot_trace(sheet: Sheet, drive: FieldDrive) -> list[str]:
    """Fig. 12: latitude and longitude of the fixes, and altitude about the origin over time; the keys."""
    latitude, longitude = drive.lat_lon_deg.T
    look: dict[str, Any] = {"match_aspect": True, "aspect_scale": 1.0 / np.cos(np.radians(latitude.mean()))}
    trace = sheet.add("p trace", "longitude, deg", "latitude, deg", 300, **look)
    trace.line(longitude, latitude, "fixes", GNSS, width=0.8)
    trace.panel.figure.xaxis.ticker.desired_num_ticks = 3
    height = sheet.add_time("altitude", "altitude about the origin, m", 300)
    height.line(*_with_gaps(drive.gnss_t_s, drive.altitude_m), "GNSS", GNSS, width=1.0)
    ends = drive.gnss_t_s[[0, -1]]
    height.band(ends, np.zeros(2), np.full(2, 0.5), "the study's ±1 m", style.EXPECTED_ON_ANY)
    return ["trace", "altitude"]


def plot_velocity(sheet: Sheet, drive: FieldDrive) -> list[str]:
    """Fig. 13: the receiver's velocity east, north and up; the keys of the figures."""
    t_s, velocity = _with_gaps(drive.gnss_t_s, drive.velocity_enu_mps)
    return _three(sheet, "velocity", t_s, velocity, ("east, m/s", "north, m/s", "up, m/s"))


def plot_ground_speed(sheet: Sheet, drive: FieldDrive) -> None:
    """Fig. 14: ground speed from the receiver's velocity (eq. 3), its mean, and the true speed."""
    plot = sheet.add_time("ground_speed", "ground speed, m/s", 220)
    plot.line(*_with_gaps(drive.gnss_t_s, drive.ground_mps), "GNSS", GNSS, width=1.2)
    plot.line(drive.imu_t_s, np.abs(drive.truth_mps), "truth", style.TRUTH_ON_ANY, width=1.0)
    mean, ends = float(drive.ground_mps.mean()), drive.gnss_t_s[[0, -1]]
    plot.line(ends, np.full(2, mean), f"mean {mean:.2f} m/s", style.HELD_OUT, dash="dashed", width=1.0)


def plot_imu_speed(sheet: Sheet, drives: Sequence[FieldDrive]) -> None:
    """Fig. 15: speed from the IMU (eq. 4) of each seed, and the true speed of the first."""
    plot = sheet.add_time("imu_speed", "speed, m/s", 220)
    for drive in drives:
        plot.line(drive.imu_t_s, drive.imu_mps, "IMU, each seed", COLOURS[2], width=0.8, alpha=0.6)
    plot.line(drives[0].imu_t_s, drives[0].truth_mps, "truth", style.TRUTH_ON_ANY, width=1.2)


def _three(sheet: Sheet, key: str, t_s: Array, values: Array, labels: Sequence[str]) -> list[str]:
    keys = [f"{key}{i}" for i in range(3)]
    for name, column, colour, label in zip(keys, values.T, COLOURS, labels, strict=True):
        sheet.add_time(name, label, 150).line(t_s, column, "", colour, width=0.7, most=MOST_ACCEL)
    return keys


def _with_gaps(t_s: Array, values: Array) -> tuple[Array, Array]:
    """Times (N,) and values (N,) or (N, k) with a NaN in each gap, which breaks the line."""
    after = np.flatnonzero(np.diff(t_s) > GAP_S) + 1
    return np.insert(t_s, after, np.nan), np.insert(values, after, np.nan, axis=0)
