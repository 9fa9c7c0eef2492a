"""Plots of the reproduced source study: Figs. 4 to 9, Tab. 4, the batch, its field test (Figs. 11 to 15)."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.reports.plots import style
from terrafusion.twin.study.batch import BatchResult
from terrafusion.twin.study.cases import CaseRun
from terrafusion.twin.study.field_drive import FieldDrive
from terrafusion.twin.study.gnss_noise import NoiseFit, NoisyRun
from terrafusion.twin.study.published import CASES
from terrafusion.twin.study.spread import spread

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


TIME, SPEED, ENERGY = "time, s", "speed, m/s", "energy, J/m"
WHEELS, GNSS = style.SENSOR_COLOURS["wheels"], style.SENSOR_COLOURS["gnss"]
GYRO, RAW = style.SENSOR_COLOURS["gyro"], "#b9d9cf"
COMMAND = "#9a9a9a"
LABELS = {case.terrain: case.label for case in CASES}
MARKERS = "os^Dv"


def plot_mud(run: CaseRun) -> Figure:
    """Fig. 4: command, odometry and truth on mud, and when it is immobilised."""
    fig, ax = style.canvas()
    _speeds(ax, run)
    at = run.summary.immobilised_at_s
    if at is not None:
        ax.axvline(at, color=style.HELD_OUT, linewidth=0.9, linestyle="--", label=f"stops at {at:.0f} s")
    style.format_axes(ax, x=TIME, y=SPEED, title=LABELS["mud"])
    style.legend_above(ax)
    return fig


def plot_sand_speeds(runs: Mapping[str, CaseRun]) -> Figure:
    """Fig. 5: command, odometry and truth on loose and on medium sand."""
    fig, axes = style.canvases(2, (9.0, 5.0))
    for ax, terrain in zip(axes, ("loose_sand", "medium_sand"), strict=True):
        _speeds(ax, runs[terrain])
        style.format_axes(ax, y=SPEED, title=LABELS[terrain])
    return _over_time(fig, axes)


def plot_slip_proxy(even: CaseRun, uneven: Sequence[CaseRun]) -> Figure:
    """Fig. 6: the slip proxy of eq. 2 on mud, where it moves; even ground over runs on uneven ground."""
    fig, ax = style.canvas()
    for k, run in enumerate(uneven):
        label = "uneven ground, each seed" if k == 0 else None
        ax.plot(run.profiles.t_s, 100.0 * run.profiles.slip(), color="#c9b3dd", linewidth=0.8, label=label)
    colour, label = style.TERRAIN_COLOURS["mud"], "even ground"
    ax.plot(even.profiles.t_s, 100.0 * even.profiles.slip(), color=colour, linewidth=1.3, label=label)
    last = max(float(run.profiles.t_s[run.profiles.moving()][-1]) for run in (even, *uneven))
    ax.set_xlim(0.0, 1.1 * last)
    style.format_axes(ax, x=TIME, y="s = 1 - v_odom / v_truth, %", title=LABELS["mud"])
    style.legend_above(ax)
    return fig


def plot_yaw_rates(runs: Mapping[str, CaseRun], terrains: Sequence[str]) -> Figure:
    """Figs. 7 and 8: yaw rate of the gyro as measured and low-passed, and of the body."""
    fig, axes = style.canvases(len(terrains), (9.0, 2.3 * len(terrains) + 0.5))
    top = max(np.nanpercentile(np.abs(runs[terrain].profiles.gyro), 99.5) for terrain in terrains)
    for ax, terrain in zip(axes, terrains, strict=True):
        p = runs[terrain].profiles
        rows = style.thin(len(p.t_s), 4000)
        ax.plot(p.t_s[rows], p.gyro[rows], color=RAW, linewidth=0.4, label="gyro as measured")
        style.line(ax, p.t_s, p.yaw_rate, GYRO, "gyro, low-passed", linewidth=1.0)
        style.line(ax, p.t_s, p.true_yaw_rate, style.TRUTH, "body", linewidth=0.7)
        ax.set_ylim(-top, top)
        style.format_axes(ax, y="yaw rate, rad/s", title=f"{LABELS[terrain]}, uneven ground")
    return _over_time(fig, axes)


def plot_gnss_speeds(runs: Mapping[str, CaseRun], noisy: Mapping[str, NoisyRun], sigma_m: float) -> Figure:
    """Fig. 9: GNSS speed on the three terrains, with the data sheet's RTK and with Gaussian noise."""
    fig, axes = style.canvases(len(CASES), (9.0, 6.6))
    gaussian = f"GNSS, Gaussian noise of {100 * sigma_m:.1f} cm"
    for ax, case in zip(axes, CASES, strict=True):
        p, q = runs[case.terrain].profiles, noisy[case.terrain].noisy(sigma_m)
        for of, colour, width, label in (
            (q, "#d9a6c8", 0.9, gaussian),
            (p, GNSS, 1.0, "GNSS, RTK of the data sheet"),
        ):
            known = np.isfinite(of.gnss)
            ax.plot(of.t_s[known], of.gnss[known], color=colour, linewidth=width, label=label)
        style.line(ax, p.t_s, p.truth, style.TRUTH, "truth", linewidth=0.8)
        style.format_axes(ax, y=SPEED, title=LABELS[case.terrain])
    return _over_time(fig, axes)


def plot_noise(fits: Sequence[NoiseFit]) -> Figure:
    """Size of white position noise that gives the study's GNSS errors, over the rate of the positions."""
    fig, ax = style.canvas((9.0, 3.2))
    rates = [fit.rate_hz for fit in fits]
    for case, marker in zip(CASES, MARKERS, strict=False):
        sigmas = [100.0 * fit.alone_m[case.terrain] for fit in fits]
        colour, label = style.TERRAIN_COLOURS[case.terrain], f"{case.label} ({case.gnss:g} %)"
        ax.loglog(rates, sigmas, marker=marker, color=colour, label=label)
    common = [100.0 * fit.common_m for fit in fits]
    ax.loglog(rates, common, color=style.TRUTH, linestyle="--", label="one for all")
    ax.axhline(2.0, color=GNSS, linewidth=0.8, linestyle=":", label="RTK (2 cm)")
    style.format_axes(ax, x="rate of the positions, Hz", y="sigma of each axis, cm")
    style.legend_above(ax)
    return fig


def plot_mobility(batch: Sequence[BatchResult]) -> Figure:
    """Net uphill distance over slope, for each terrain, friction (colour) and payload (line)."""
    fig, axes = style.canvases(1, (9.0, 3.2), len(CASES), sharex=False)
    for ax, case in zip(axes, CASES, strict=True):
        mine = [r for r in batch if r.cell.terrain == case.terrain]
        frictions = sorted({r.cell.friction for r in mine})
        for friction, payload in itertools.product(frictions, sorted({r.cell.payload_kg for r in mine})):
            cells = [r for r in mine if (r.cell.friction, r.cell.payload_kg) == (friction, payload)]
            if len(cells) > 1:
                slopes, advance = [r.cell.slope_deg for r in cells], [100.0 * r.advance for r in cells]
                colour = style.AXIS_COLOURS[frictions.index(friction) % 3]
                dash = {0.0: "-", 30.0: "--"}.get(payload, ":")
                label = f"mu {friction:g}" if payload == 0.0 else None
                ax.plot(slopes, advance, color=colour, linestyle=dash, marker="o", markersize=3, label=label)
        ax.axhline(0.0, color=COMMAND, linewidth=0.8)
        style.format_axes(ax, x="slope, deg", y="net distance, %", title=case.terrain.replace("_", " "))
        ax.legend(fontsize=7, frameon=False)
        ax.margins(x=0.05)
    return fig


def plot_energy(batch: Sequence[BatchResult], over_slip: Sequence[BatchResult]) -> Figure:
    """Energy per metre of the mobile runs: over slope, over payload, and over slip at one load and slope."""
    fig, axes = style.canvases(1, (9.0, 3.2), 3, sharex=False)
    mobile = [r for r in batch if r.mobile]
    _mean_energy(axes[0], mobile, "slope_deg", "payload_kg", "slope, deg", "kg")
    _mean_energy(axes[1], mobile, "payload_kg", "slope_deg", "payload, kg", "deg")
    known = [r for r in over_slip if r.mobile]
    energy = [r.energy_per_m_j for r in known]
    for key, label, marker in (("slip_ratio", "usual slip ratio", "o"), ("slip", "the study's proxy", "s")):
        axes[2].plot([getattr(r, key) for r in known], energy, marker=marker, markersize=3, label=label)
    style.format_axes(axes[2], x="mean slip, %", y=ENERGY, title="loose sand, 5 deg")
    axes[2].legend(fontsize=7, frameon=False)
    return fig


def plot_tab4(runs: Mapping[str, Sequence[CaseRun]], gaussian: Mapping[str, Sequence[float]]) -> Figure:
    """Tab. 4: each single run, the mean with its interval, and the study's number; logarithmic."""
    fig, ax = style.canvas((9.0, 3.6))
    place, ticks = 0.0, list[tuple[float, str]]()
    for case in CASES:
        errors = [run.errors for run in runs[case.terrain]]
        columns = {
            "|s|": ([e.slip for e in errors], case.slip),
            "odometry": ([e.odometry for e in errors], case.odometry),
            "IMU": ([e.imu for e in errors], case.imu),
            "GNSS\nRTK": ([e.gnss for e in errors], case.gnss),
            "GNSS\nGaussian": (list(gaussian[case.terrain]), case.gnss),
        }
        first, colour = place, style.TERRAIN_COLOURS[case.terrain]
        for name, (values, published) in columns.items():
            twin, study = ("twin: mean and 95 % interval", "study") if not ticks else (None, None)
            mean = spread(values)
            half = 0.0 if np.isnan(mean.half_width) else min(mean.half_width, 0.99 * mean.mean)
            ax.plot([place] * len(values), values, ".", color=colour, markersize=5, alpha=0.5)
            ax.errorbar(
                place + 0.15, mean.mean, yerr=half, fmt="o", color=style.TRUTH, markersize=4, capsize=3,
                linewidth=1.0, label=twin,
            )  # fmt: skip
            ax.plot(place - 0.2, published, "D", color=style.HELD_OUT, markersize=5, label=study)
            ticks.append((place, name))
            place += 1.0
        top, middle = ax.get_xaxis_transform(), 0.5 * (first + place - 1.0)
        ax.text(middle, 1.03, case.label, transform=top, ha="center", fontsize=9)
        place += 0.8
    ax.set_yscale("log")
    ax.set_xticks([x for x, _ in ticks], [name for _, name in ticks])
    style.format_axes(ax, y="mean error, %")
    ax.tick_params(axis="x", labelsize=7)
    ax.margins(x=0.03)
    ax.legend(fontsize=8, frameon=False, loc="lower left")
    return fig


def _speeds(ax: Axes, run: CaseRun) -> None:
    p = run.profiles
    style.line(ax, p.t_s, p.command, COMMAND, "command", linewidth=1.0)
    style.line(ax, p.t_s, p.odometry, WHEELS, "odometry")
    style.line(ax, p.t_s, p.truth, style.TRUTH, "truth")


def _mean_energy(
    ax: Axes, mobile: Sequence[BatchResult], name: str, other: str, label: str, unit: str
) -> None:
    """Energy per metre over the axis `name`, averaged over friction; a line each value of `other`."""
    for terrain, held in itertools.product(LABELS, (0.0, 5.0, 60.0)):
        runs = [r for r in mobile if r.cell.terrain == terrain and getattr(r.cell, other) == held]
        xs = sorted({getattr(r.cell, name) for r in runs})
        if len(xs) > 1:
            means = [np.mean([r.energy_per_m_j for r in runs if getattr(r.cell, name) == x]) for x in xs]
            colour, dash = style.TERRAIN_COLOURS[terrain], "-" if held == 0.0 else ":"
            text = f"{terrain.replace('_', ' ')}, {held:g} {unit}"
            ax.plot(xs, means, color=colour, marker="o", markersize=3, linestyle=dash, label=text)
    style.format_axes(ax, x=label, y=ENERGY)
    ax.set_ylim(0.0, 1.35 * ax.get_ylim()[1])
    ax.legend(fontsize=7, frameon=False, loc="upper left")


def _over_time(fig: Figure, axes: Sequence[Axes]) -> Figure:
    style.legend_above(axes[0])
    axes[-1].set_xlabel(TIME, fontsize=9)
    return fig


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
