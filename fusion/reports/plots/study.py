"""Plots of the reproduced source study: its Figs. 4 to 9 and 11 to 15, the batch, and energy a metre.

Every function draws into the axes it is given, or into new ones, and returns
the figure and the axes. Times are seconds from the start of the run.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.fusion.reports.plots import style
from terrafusion.twin.study.batch import CellResult
from terrafusion.twin.study.cases import CaseRun
from terrafusion.twin.study.gnss_noise import NoiseFit, NoisyRun
from terrafusion.twin.study.published import CASES
from terrafusion.twin.study.spread import spread

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
Axs = NDArray[Any]
TIME = "time, s"
SPEED = "speed, m/s"
WHEELS, GNSS = style.SENSOR_COLOURS["wheels"], style.SENSOR_COLOURS["gnss"]
GYRO, RAW = style.SENSOR_COLOURS["gyro"], "#b9d9cf"
COMMAND = "#9a9a9a"
LABELS = {case.terrain: case.label for case in CASES}
MARKERS = "os^Dv"


def plot_mud(run: CaseRun, *, ax: Axes | None = None) -> tuple[Figure, Axes]:
    """Fig. 4: command, odometry and truth on mud, and when it stops for good."""
    fig, ax = style.canvas(ax)
    p = run.profiles
    _line(ax, p.t_s, p.command, "command", COMMAND, linewidth=1.0)
    _line(ax, p.t_s, p.odometry, "odometry", WHEELS)
    _line(ax, p.t_s, p.truth, "truth", style.TRUTH)
    at = run.summary.immobilised_at_s
    if at is not None:
        ax.axvline(at, color=style.HELD_OUT, linewidth=0.9, linestyle="--", label=f"stops at {at:.0f} s")
    style.dress(ax, x=TIME, y=SPEED, title=LABELS["mud"])
    style.legend_above(ax)
    return fig, ax


def plot_sand_speeds(
    runs: Mapping[str, CaseRun], *, axes: Sequence[Axes] | None = None
) -> tuple[Figure, Axs]:
    """Fig. 5: command, odometry and truth on loose and on medium sand."""
    fig, panels = style.canvases(axes, 2, (9.0, 5.0))
    for ax, terrain in zip(panels, ("loose_sand", "medium_sand"), strict=True):
        p = runs[terrain].profiles
        _line(ax, p.t_s, p.command, "command", COMMAND, linewidth=1.0)
        _line(ax, p.t_s, p.odometry, "odometry", WHEELS)
        _line(ax, p.t_s, p.truth, "truth", style.TRUTH)
        style.dress(ax, y=SPEED, title=LABELS[terrain])
    style.legend_above(panels[0])
    panels[-1].set_xlabel(TIME, fontsize=9)
    return fig, panels


def plot_slip_proxy(
    even: CaseRun, uneven: Sequence[CaseRun], *, ax: Axes | None = None
) -> tuple[Figure, Axes]:
    """Fig. 6: the slip proxy of eq. 2 on mud, where it moves; even ground over runs on uneven ground."""
    fig, ax = style.canvas(ax)
    for number, run in enumerate(uneven):
        label = "uneven ground, each seed" if number == 0 else None
        ax.plot(run.profiles.t_s, 100.0 * run.profiles.slip(), color="#c9b3dd", linewidth=0.8, label=label)
    ax.plot(
        even.profiles.t_s,
        100.0 * even.profiles.slip(),
        color=style.TERRAIN_COLOURS["mud"],
        linewidth=1.3,
        label="even ground",
    )
    last = max(float(run.profiles.t_s[run.profiles.moving()][-1]) for run in (even, *uneven))
    ax.set_xlim(0.0, 1.1 * last)
    style.dress(ax, x=TIME, y="s = 1 - v_odom / v_truth, %", title=LABELS["mud"])
    style.legend_above(ax)
    return fig, ax


def plot_yaw_rates(
    runs: Mapping[str, CaseRun], terrains: Sequence[str], *, axes: Sequence[Axes] | None = None
) -> tuple[Figure, Axs]:
    """Figs. 7 and 8: yaw rate of the gyro as measured and low-passed, and of the body."""
    fig, panels = style.canvases(axes, len(terrains), (9.0, 2.3 * len(terrains) + 0.5))
    top = max(np.nanpercentile(np.abs(runs[terrain].profiles.gyro), 99.5) for terrain in terrains)
    for ax, terrain in zip(panels, terrains, strict=True):
        p = runs[terrain].profiles
        keep = style.thin(len(p.t_s), 4000)
        ax.plot(p.t_s[keep], p.gyro[keep], color=RAW, linewidth=0.4, label="gyro as measured")
        _line(ax, p.t_s, p.yaw_rate, "gyro, low-passed", GYRO, linewidth=1.0)
        _line(ax, p.t_s, p.true_yaw_rate, "body", style.TRUTH, linewidth=0.7)
        ax.set_ylim(-top, top)
        style.dress(ax, y="yaw rate, rad/s", title=f"{LABELS[terrain]}, uneven ground")
    style.legend_above(panels[0])
    panels[-1].set_xlabel(TIME, fontsize=9)
    return fig, panels


def plot_gnss_speeds(
    runs: Mapping[str, CaseRun],
    noisy: Mapping[str, NoisyRun],
    sigma_m: float,
    *,
    axes: Sequence[Axes] | None = None,
) -> tuple[Figure, Axs]:
    """Fig. 9: GNSS speed on the three grounds, with the data sheet's RTK and with Gaussian noise."""
    fig, panels = style.canvases(axes, len(CASES), (9.0, 6.6))
    for ax, case in zip(panels, CASES, strict=True):
        p, q = runs[case.terrain].profiles, noisy[case.terrain].noisy(sigma_m)
        seen = np.isfinite(q.gnss)
        ax.plot(
            q.t_s[seen],
            q.gnss[seen],
            color="#d9a6c8",
            linewidth=0.9,
            label=f"GNSS, Gaussian noise of {100 * sigma_m:.1f} cm",
        )
        seen = np.isfinite(p.gnss)
        ax.plot(p.t_s[seen], p.gnss[seen], color=GNSS, linewidth=1.0, label="GNSS, RTK of the data sheet")
        _line(ax, p.t_s, p.truth, "truth", style.TRUTH, linewidth=0.8)
        style.dress(ax, y=SPEED, title=LABELS[case.terrain])
    style.legend_above(panels[0])
    panels[-1].set_xlabel(TIME, fontsize=9)
    return fig, panels


def plot_noise(fits: Sequence[NoiseFit], *, ax: Axes | None = None) -> tuple[Figure, Axes]:
    """Size of white position noise that gives the study's GNSS errors, over the rate of the positions."""
    fig, ax = style.canvas(ax, (9.0, 3.2))
    rates = [fit.rate_hz for fit in fits]
    for case, marker in zip(CASES, MARKERS, strict=False):
        ax.loglog(
            rates,
            [100.0 * fit.alone_m[case.terrain] for fit in fits],
            marker=marker,
            color=style.TERRAIN_COLOURS[case.terrain],
            label=f"{case.label} ({case.gnss:g} %)",
        )
    ax.loglog(
        rates, [100.0 * fit.common_m for fit in fits], color=style.TRUTH, linestyle="--", label="one for all"
    )
    ax.axhline(2.0, color=GNSS, linewidth=0.8, linestyle=":", label="RTK (2 cm)")
    style.dress(ax, x="rate of the positions, Hz", y="sigma of each axis, cm")
    style.legend_above(ax)
    return fig, ax


def plot_mobility(batch: Sequence[CellResult], *, axes: Sequence[Axes] | None = None) -> tuple[Figure, Axs]:
    """Way made good over slope, for each terrain, friction (colour) and payload (line)."""
    fig, panels = _side_by_side(axes, len(CASES))
    for ax, case in zip(panels, CASES, strict=True):
        mine = [r for r in batch if r.cell.terrain == case.terrain]
        frictions = sorted({r.cell.friction for r in mine})
        for friction, payload in itertools.product(frictions, sorted({r.cell.payload_kg for r in mine})):
            line = [r for r in mine if (r.cell.friction, r.cell.payload_kg) == (friction, payload)]
            if len(line) < 2:
                continue
            ax.plot(
                [r.cell.slope_deg for r in line],
                [100.0 * r.advance for r in line],
                color=("#0072b2", "#009e73", "#d55e00")[frictions.index(friction) % 3],
                linestyle={0.0: "-", 30.0: "--"}.get(payload, ":"),
                marker="o",
                markersize=3,
                label=f"mu {friction:g}" if payload == 0.0 else None,
            )
        ax.axhline(0.0, color=COMMAND, linewidth=0.8)
        style.dress(ax, x="slope, deg", y="way made good, %", title=case.terrain.replace("_", " "))
        ax.legend(fontsize=7, frameon=False)
        ax.margins(x=0.05)
    return fig, panels


def plot_energy(
    batch: Sequence[CellResult], over_slip: Sequence[CellResult], *, axes: Sequence[Axes] | None = None
) -> tuple[Figure, Axs]:
    """Energy a metre of the mobile runs: over slope, over payload, and over slip at one load and slope."""
    fig, panels = _side_by_side(axes, 3)
    mobile = [r for r in batch if r.mobile]
    for ax, (name, other, label) in zip(
        panels,
        (("slope_deg", "payload_kg", "slope, deg"), ("payload_kg", "slope_deg", "payload, kg")),
        strict=False,
    ):
        for terrain, held in itertools.product(LABELS, (0.0, 5.0, 60.0)):
            line = [r for r in mobile if r.cell.terrain == terrain and getattr(r.cell, other) == held]
            xs = sorted({getattr(r.cell, name) for r in line})
            if len(xs) < 2:
                continue
            means = [np.mean([r.energy_per_m_j for r in line if getattr(r.cell, name) == x]) for x in xs]
            unit = "kg" if other == "payload_kg" else "deg"
            ax.plot(
                xs,
                means,
                color=style.TERRAIN_COLOURS[terrain],
                marker="o",
                markersize=3,
                linestyle="-" if held == 0.0 else ":",
                label=f"{terrain.replace('_', ' ')}, {held:g} {unit}",
            )
        style.dress(ax, x=label, y="energy, J/m")
        ax.set_ylim(0.0, 1.35 * ax.get_ylim()[1])
        ax.legend(fontsize=7, frameon=False, loc="upper left")
    known = [r for r in over_slip if r.mobile]
    for key, label, marker in (("slip_ratio", "usual slip ratio", "o"), ("slip", "the study's proxy", "s")):
        panels[2].plot(
            [getattr(r, key) for r in known],
            [r.energy_per_m_j for r in known],
            marker=marker,
            markersize=3,
            label=label,
        )
    style.dress(panels[2], x="mean slip, %", y="energy, J/m", title="loose sand, 5 deg")
    panels[2].legend(fontsize=7, frameon=False)
    return fig, panels


def plot_tab4(
    runs: Mapping[str, Sequence[CaseRun]], gaussian: Mapping[str, Sequence[float]], *, ax: Axes | None = None
) -> tuple[Figure, Axes]:
    """Tab. 4: each single run, the mean with its interval, and the study's number; logarithmic."""
    fig, ax = style.canvas(ax, (9.0, 3.6))
    place, ticks = 0.0, list[tuple[float, str]]()
    for case in CASES:
        columns = {
            "|s|": ([run.errors.slip for run in runs[case.terrain]], case.slip),
            "odometry": ([run.errors.odometry for run in runs[case.terrain]], case.odometry),
            "IMU": ([run.errors.imu for run in runs[case.terrain]], case.imu),
            "GNSS\nRTK": ([run.errors.gnss for run in runs[case.terrain]], case.gnss),
            "GNSS\nGaussian": (list(gaussian[case.terrain]), case.gnss),
        }
        first = place
        for name, (values, published) in columns.items():
            colour, first_of_all = style.TERRAIN_COLOURS[case.terrain], not ticks
            ax.plot([place] * len(values), values, ".", color=colour, markersize=5, alpha=0.5)
            found = spread(values)
            ax.errorbar(
                place + 0.15,
                found.mean,
                yerr=0.0 if np.isnan(found.half_width) else min(found.half_width, 0.99 * found.mean),
                fmt="o",
                color=style.TRUTH,
                markersize=4,
                capsize=3,
                linewidth=1.0,
                label="twin: mean and 95 % interval" if first_of_all else None,
            )
            ax.plot(
                place - 0.2,
                published,
                "D",
                color=style.HELD_OUT,
                markersize=5,
                label="study" if first_of_all else None,
            )
            ticks.append((place, name))
            place += 1.0
        ax.text(
            0.5 * (first + place - 1.0),
            1.03,
            case.label,
            transform=ax.get_xaxis_transform(),
            ha="center",
            fontsize=9,
        )
        place += 0.8
    ax.set_yscale("log")
    ax.set_xticks([x for x, _ in ticks], [name for _, name in ticks])
    style.dress(ax, y="mean error, %")
    ax.tick_params(axis="x", labelsize=7)
    ax.margins(x=0.03)
    ax.legend(fontsize=8, frameon=False, loc="lower left")
    return fig, ax


def _side_by_side(axes: Sequence[Axes] | None, columns: int) -> tuple[Figure, Axs]:
    """Like `style.canvases`, beside each other."""
    if axes is None:
        from matplotlib.figure import Figure

        axes = list(Figure(figsize=(9.0, 3.2), layout="constrained").subplots(1, columns))
    found = np.empty(columns, dtype=object)
    found[:] = list(axes)
    return found[0].get_figure(root=True), found


def _line(ax: Axes, t_s: Array, values: Array, label: str, colour: str, **options: Any) -> None:
    keep = style.thin(len(t_s))
    ax.plot(t_s[keep], values[keep], color=colour, label=label, **({"linewidth": 1.2} | options))
