"""Plots of the drive like the study's field test: its Figs. 11 to 15."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.fusion.reports.plots import style
from terrafusion.twin.study.field_drive import FieldDrive

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
TIME = "time, s"
GAP_S = 1.0
"""No line is drawn over a longer time without fixes."""
COLOURS = (style.SENSOR_COLOURS["wheels"], style.SENSOR_COLOURS["gnss"], style.SENSOR_COLOURS["gyro"])
MOST_POINTS = 6000


def plot_acceleration(
    drive: FieldDrive, *, axes: Sequence[Axes] | None = None
) -> tuple[Figure, NDArray[Any]]:
    """Fig. 11: specific force along the body's axes, as measured."""
    fig, panels = style.canvases(axes, 3, (9.0, 4.6))
    keep = style.thin(len(drive.imu_t_s), MOST_POINTS)
    for ax, axis, colour, name in zip(panels, range(3), COLOURS, ("x", "y", "z"), strict=True):
        ax.plot(drive.imu_t_s[keep], drive.accel_mps2[keep, axis], color=colour, linewidth=0.4)
        style.dress(ax, y=f"a_{name}, m/s²")
    panels[-1].set_xlabel(TIME, fontsize=9)
    return fig, panels


def plot_trace(drive: FieldDrive, *, axes: Sequence[Axes] | None = None) -> tuple[Figure, NDArray[Any]]:
    """Fig. 12: latitude and longitude of the fixes, and altitude about the origin over time."""
    if axes is None:
        from matplotlib.figure import Figure

        axes = list(Figure(figsize=(9.0, 3.6), layout="constrained").subplots(1, 2))
    trace, height = axes
    latitude, longitude = drive.lat_lon_deg.T
    trace.plot(longitude, latitude, ".-", color=COLOURS[1], markersize=2, linewidth=0.6)
    trace.set_aspect(1.0 / float(np.cos(np.radians(latitude.mean()))))
    trace.ticklabel_format(useOffset=False)
    trace.locator_params(nbins=4)
    style.dress(trace, x="longitude, deg", y="latitude, deg")
    trace.margins(x=0.05)
    height.plot(*_with_gaps(drive.gnss_t_s, drive.altitude_m), color=COLOURS[1], linewidth=0.9)
    height.axhspan(-1.0, 1.0, color="#dddddd", alpha=0.6, linewidth=0, label="the study's ±1 m")
    style.dress(height, x=TIME, y="altitude about the origin, m")
    style.legend_above(height)
    found = np.empty(2, dtype=object)
    found[:] = [trace, height]
    return trace.get_figure(root=True), found  # type: ignore[return-value]


def plot_velocity(drive: FieldDrive, *, axes: Sequence[Axes] | None = None) -> tuple[Figure, NDArray[Any]]:
    """Fig. 13: the receiver's velocity east, north and up."""
    fig, panels = style.canvases(axes, 3, (9.0, 4.6))
    for ax, axis, colour, name in zip(panels, range(3), COLOURS, ("east", "north", "up"), strict=True):
        ax.plot(*_with_gaps(drive.gnss_t_s, drive.velocity_enu_mps[:, axis]), color=colour, linewidth=0.9)
        style.dress(ax, y=f"{name}, m/s")
    panels[-1].set_xlabel(TIME, fontsize=9)
    return fig, panels


def plot_ground_speed(drive: FieldDrive, *, ax: Axes | None = None) -> tuple[Figure, Axes]:
    """Fig. 14: ground speed from the receiver's velocity (eq. 3), its mean, and the true speed."""
    fig, ax = style.canvas(ax)
    keep = style.thin(len(drive.imu_t_s))
    ax.plot(*_with_gaps(drive.gnss_t_s, drive.ground_mps), color=COLOURS[1], linewidth=1.0, label="GNSS")
    ax.plot(
        drive.imu_t_s[keep], np.abs(drive.truth_mps[keep]), color=style.TRUTH, linewidth=0.7, label="truth"
    )
    mean = float(drive.ground_mps.mean())
    ax.axhline(mean, color=style.HELD_OUT, linewidth=0.8, linestyle="--", label=f"mean {mean:.2f} m/s")
    style.dress(ax, x=TIME, y="ground speed, m/s")
    style.legend_above(ax)
    return fig, ax


def plot_imu_speed(drives: Sequence[FieldDrive], *, ax: Axes | None = None) -> tuple[Figure, Axes]:
    """Fig. 15: speed from the IMU (eq. 4) of each seed, and the true speed of the first."""
    fig, ax = style.canvas(ax)
    for number, drive in enumerate(drives):
        keep = style.thin(len(drive.imu_t_s))
        label = "IMU, each seed" if number == 0 else None
        ax.plot(
            drive.imu_t_s[keep], drive.imu_mps[keep], color=COLOURS[2], linewidth=0.7, alpha=0.6, label=label
        )
    keep = style.thin(len(drives[0].imu_t_s))
    ax.plot(
        drives[0].imu_t_s[keep], drives[0].truth_mps[keep], color=style.TRUTH, linewidth=1.0, label="truth"
    )
    style.dress(ax, x=TIME, y="speed, m/s")
    style.legend_above(ax)
    return fig, ax


def _with_gaps(t_s: Array, values: Array) -> tuple[Array, Array]:
    """Times and values (N,) with a NaN in each gap, which breaks the line."""
    after = np.flatnonzero(np.diff(t_s) > GAP_S) + 1
    return np.insert(t_s, after, np.nan), np.insert(values, after, np.nan)
