"""Plots of the drive like the study's field test: its Figs. 11 to 15."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.reports.plots import style
from terrafusion.twin.study.field_drive import FieldDrive

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TIME = "time, s"
GAP_S = 1.0
"""No line is drawn over a longer time without fixes."""
COLOURS = (style.SENSOR_COLOURS["wheels"], style.SENSOR_COLOURS["gnss"], style.SENSOR_COLOURS["gyro"])
MOST_POINTS = 6000


def plot_acceleration(drive: FieldDrive) -> Figure:
    """Fig. 11: specific force along the body's axes, as measured."""
    rows = style.thin(len(drive.imu_t_s), MOST_POINTS)
    labels = ("a_x, m/s²", "a_y, m/s²", "a_z, m/s²")
    return _three(drive.imu_t_s[rows], drive.accel_mps2[rows], labels, 0.4)


def plot_trace(drive: FieldDrive) -> Figure:
    """Fig. 12: latitude and longitude of the fixes, and altitude about the origin over time."""
    fig, (trace, height) = style.canvases(1, (9.0, 3.6), 2, sharex=False)
    latitude, longitude = drive.lat_lon_deg.T
    trace.plot(longitude, latitude, ".-", color=COLOURS[1], markersize=2, linewidth=0.6)
    trace.set_aspect(1.0 / float(np.cos(np.radians(latitude.mean()))))
    trace.ticklabel_format(useOffset=False)
    trace.locator_params(nbins=4)
    style.format_axes(trace, x="longitude, deg", y="latitude, deg")
    trace.margins(x=0.05)
    height.plot(*_with_gaps(drive.gnss_t_s, drive.altitude_m), color=COLOURS[1], linewidth=0.9)
    height.axhspan(-1.0, 1.0, color=style.EXPECTED, alpha=0.6, linewidth=0, label="the study's ±1 m")
    style.format_axes(height, x=TIME, y="altitude about the origin, m")
    style.legend_above(height)
    return fig


def plot_velocity(drive: FieldDrive) -> Figure:
    """Fig. 13: the receiver's velocity east, north and up."""
    t_s, velocity = _with_gaps(drive.gnss_t_s, drive.velocity_enu_mps)
    return _three(t_s, velocity, ("east, m/s", "north, m/s", "up, m/s"), 0.9)


def plot_ground_speed(drive: FieldDrive) -> Figure:
    """Fig. 14: ground speed from the receiver's velocity (eq. 3), its mean, and the true speed."""
    fig, ax = style.canvas()
    ax.plot(*_with_gaps(drive.gnss_t_s, drive.ground_mps), color=COLOURS[1], linewidth=1.0, label="GNSS")
    style.line(ax, drive.imu_t_s, np.abs(drive.truth_mps), style.TRUTH, "truth", linewidth=0.7)
    mean = float(drive.ground_mps.mean())
    ax.axhline(mean, color=style.HELD_OUT, linewidth=0.8, linestyle="--", label=f"mean {mean:.2f} m/s")
    style.format_axes(ax, x=TIME, y="ground speed, m/s")
    style.legend_above(ax)
    return fig


def plot_imu_speed(drives: Sequence[FieldDrive]) -> Figure:
    """Fig. 15: speed from the IMU (eq. 4) of each seed, and the true speed of the first."""
    fig, ax = style.canvas()
    for k, drive in enumerate(drives):
        label = "IMU, each seed" if k == 0 else None
        style.line(ax, drive.imu_t_s, drive.imu_mps, COLOURS[2], label, linewidth=0.7, alpha=0.6)
    style.line(ax, drives[0].imu_t_s, drives[0].truth_mps, style.TRUTH, "truth", linewidth=1.0)
    style.format_axes(ax, x=TIME, y="speed, m/s")
    style.legend_above(ax)
    return fig


def _three(t_s: Array, values: Array, labels: Sequence[str], width: float) -> Figure:
    fig, axes = style.canvases(3, (9.0, 4.6))
    for ax, column, colour, label in zip(axes, values.T, COLOURS, labels, strict=True):
        ax.plot(t_s, column, color=colour, linewidth=width)
        style.format_axes(ax, y=label)
    axes[-1].set_xlabel(TIME, fontsize=9)
    return fig


def _with_gaps(t_s: Array, values: Array) -> tuple[Array, Array]:
    """Times (N,) and values (N,) or (N, k) with a NaN in each gap, which breaks the line."""
    after = np.flatnonzero(np.diff(t_s) > GAP_S) + 1
    return np.insert(t_s, after, np.nan), np.insert(values, after, np.nan, axis=0)
