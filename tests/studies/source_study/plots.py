"""Plots of the reproduced source study: Figs. 4 to 9, Tab. 4, and the batch."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from terrafusion.fusion.reports.plots import style
from terrafusion.fusion.reports.plots.sheet import Plot, Sheet
from tests.studies.source_study.batch import BatchResult
from tests.studies.source_study.cases import CaseRun
from tests.studies.source_study.gnss_noise import NoiseFit, NoisyRun
from tests.studies.source_study.published import CASES
from tests.studies.source_study.spread import spread

SPEED, ENERGY = "speed, m/s", "energy, J/m"
WHEELS, GNSS = style.SENSOR_COLOURS["wheels"], style.SENSOR_COLOURS["gnss"]
GYRO, RAW = style.SENSOR_COLOURS["gyro"], "#a08cc0"
COMMAND = style.SENSOR_COLOURS["slip"]
TRUTH = style.TRUTH_ON_ANY
LABELS = {case.terrain: case.label for case in CASES}
DASHES = ("solid", "dashed", "dotted")
HELD = (0.0, 5.0, 60.0)
"""Slopes, deg, and payloads, kg, for which the energy is drawn."""
MOST_GYRO = 4000


def titled(plot: Plot, title: str) -> Plot:
    """The figure with a title."""
    plot.panel.figure.title = title
    plot.panel.figure.title.text_color = style.NEUTRAL
    return plot


def plot_tab4(
    sheet: Sheet, runs: Mapping[str, Sequence[CaseRun]], gaussian: Mapping[str, Sequence[float]]
) -> None:  # fmt: skip
    """Tab. 4: each single run, the mean with its interval, and the study's number; logarithmic."""
    rows: list[tuple[str, Sequence[float], float]] = []
    for case in CASES:
        errors = [run.errors for run in runs[case.terrain]]
        rows += [
            (f"{case.label}: |s|", [e.slip for e in errors], case.slip),
            ("odometry", [e.odometry for e in errors], case.odometry),
            ("IMU", [e.imu for e in errors], case.imu),
            ("GNSS, RTK", [e.gnss for e in errors], case.gnss),
            ("GNSS, Gaussian", list(gaussian[case.terrain]), case.gnss),
        ]
    plot = sheet.add_rows("rows tab4", "mean error, %", [name for name, _, _ in rows], 26, x_axis_type="log")
    plot.panel.figure.xaxis.ticker = [1, 2, 5, 10, 20, 50, 100]
    at = np.arange(len(rows), dtype=float)
    every = np.array([(x, i + 0.18) for i, (_, values, _) in enumerate(rows) for x in values])
    plot.dots(every[:, 0], every[:, 1], "twin: each run", style.NEUTRAL, size=4.0)
    means = [spread(values) for _, values, _ in rows]
    middle = np.array([m.mean for m in means])
    half = np.array([0.0 if np.isnan(m.half_width) else min(m.half_width, 0.99 * m.mean) for m in means])
    plot.intervals(at, middle, middle - half, middle + half, "twin: mean and 95 % interval", style.AFTER)
    published = np.array([value for _, _, value in rows])
    plot.dots(published, at - 0.18, "study", style.BEFORE, "square", 7.0)


def plot_mud(sheet: Sheet, run: CaseRun) -> None:
    """Fig. 4: command, odometry and truth on mud, and when it is immobilised."""
    plot = _speeds(sheet, "mud", run, LABELS["mud"])
    at = run.summary.immobilised_at_s
    if at is not None:
        low, high = 0.0, float(np.nanmax(run.profiles.odometry))
        ends = np.array([low, high])
        plot.line(np.full(2, at), ends, f"stops at {at:.0f} s", style.HELD_OUT, dash="dashed", width=1.0)


def plot_sand_speeds(sheet: Sheet, runs: Mapping[str, CaseRun]) -> list[str]:
    """Fig. 5: command, odometry and truth on loose and on medium sand; the keys of the figures."""
    terrains = ("loose_sand", "medium_sand")
    return [_speeds(sheet, f"speed_{t}", runs[t], LABELS[t]).key for t in terrains]


def plot_slip_proxy(sheet: Sheet, even: CaseRun, uneven: Sequence[CaseRun]) -> None:
    """Fig. 6: the slip proxy of eq. 2 on mud, where it moves; even ground over runs on uneven ground."""
    plot = titled(sheet.add_time("slip_proxy", "s = 1 - v_odom / v_truth, %", 240), LABELS["mud"])
    for run in uneven:
        slip = 100.0 * run.profiles.slip()
        plot.line(run.profiles.t_s, slip, "uneven ground, each seed", RAW, width=0.8, alpha=0.6)
    plot.line(even.profiles.t_s, 100.0 * even.profiles.slip(), "even ground", style.AFTER)


def plot_yaw_rates(sheet: Sheet, runs: Mapping[str, CaseRun], terrains: Sequence[str]) -> list[str]:
    """Figs. 7 and 8: yaw rate of the gyro as measured and low-passed, and of the body; their keys."""
    top = float(max(np.nanpercentile(np.abs(runs[terrain].profiles.gyro), 99.5) for terrain in terrains))
    keys = [f"yaw_{terrain}" for terrain in terrains]
    for key, terrain in zip(keys, terrains, strict=True):
        p = runs[terrain].profiles
        plot = titled(sheet.add_time(key, "yaw rate, rad/s", limits=(-top, top)), LABELS[terrain])
        plot.line(p.t_s, p.gyro, "gyro as measured", RAW, width=0.5, most=MOST_GYRO, alpha=0.7)
        plot.line(p.t_s, p.yaw_rate, "gyro, low-passed", GYRO, width=1.2)
        plot.line(p.t_s, p.true_yaw_rate, "body", TRUTH, width=1.0)
    return keys


def plot_gnss_speeds(
    sheet: Sheet, runs: Mapping[str, CaseRun], noisy: Mapping[str, NoisyRun], sigma_m: float
) -> list[str]:  # fmt: skip
    """Fig. 9: GNSS speed on the three terrains, with the data sheet's RTK and with Gaussian noise."""
    keys = [f"gnss_{case.terrain}" for case in CASES]
    for key, case in zip(keys, CASES, strict=True):
        plot = titled(sheet.add_time(key, SPEED), LABELS[case.terrain])
        p, q = runs[case.terrain].profiles, noisy[case.terrain].noisy(sigma_m)
        for of, colour, label in (
            (q, style.SENSOR_COLOURS["accel"], f"GNSS, Gaussian noise of {100 * sigma_m:.1f} cm"),
            (p, GNSS, "GNSS, RTK of the data sheet"),
        ):
            known = np.isfinite(of.gnss)
            plot.line(of.t_s[known], of.gnss[known], label, colour, width=1.0)
        plot.line(p.t_s, p.truth, "truth", TRUTH, width=1.0)
    return keys


def plot_noise(sheet: Sheet, fits: Sequence[NoiseFit]) -> None:
    """Size of white position noise that gives the study's GNSS errors, over the rate of the positions."""
    x, y = "rate of the positions, Hz", "sigma of each axis, cm"
    plot = sheet.add("p noise", x, y, x_axis_type="log", y_axis_type="log")
    rates = np.array([fit.rate_hz for fit in fits])
    for case in CASES:
        sigmas = np.array([100.0 * fit.alone_m[case.terrain] for fit in fits])
        colour, label = _colour(case.terrain), f"{case.label} ({case.gnss:g} %)"
        plot.line(rates, sigmas, label, colour)
        plot.dots(rates, sigmas, label, colour, size=6.0)
    plot.line(rates, np.array([100.0 * fit.common_m for fit in fits]), "one for all", TRUTH, dash="dashed")
    plot.line(rates, np.full(len(rates), 2.0), "RTK (2 cm)", GNSS, dash="dotted")


def plot_mobility(sheet: Sheet, batch: Sequence[BatchResult]) -> list[str]:
    """Net uphill distance over slope, for each terrain, friction (colour) and payload (line); their keys."""
    keys = [f"mobility_{case.terrain}" for case in CASES]
    for key, case in zip(keys, CASES, strict=True):
        plot = titled(sheet.add(f"p {key}", "slope, deg", "net distance, %", 280), _named(case.terrain))
        mine = [r for r in batch if r.cell.terrain == case.terrain]
        frictions = sorted({r.cell.friction for r in mine})
        payloads = sorted({r.cell.payload_kg for r in mine})
        for friction, payload in itertools.product(frictions, payloads):
            cells = [r for r in mine if (r.cell.friction, r.cell.payload_kg) == (friction, payload)]
            if len(cells) > 1:
                slopes = np.array([r.cell.slope_deg for r in cells])
                advance = np.array([100.0 * r.advance for r in cells])
                colour = style.AXIS_COLOURS[frictions.index(friction) % 3]
                dash, label = DASHES[payloads.index(payload) % 3], f"friction {friction:g}"
                plot.line(slopes, advance, label, colour, dash=dash)
                plot.dots(slopes, advance, label, colour, size=5.0)
    return keys


def plot_energy(
    sheet: Sheet, batch: Sequence[BatchResult], over_slip: Sequence[BatchResult]
) -> list[str]:  # fmt: skip
    """Energy per metre of the mobile runs over slope, payload, and slip at one load and slope; the keys."""
    mobile = [r for r in batch if r.mobile]
    _mean_energy(sheet.add("p energy_slope", "slope, deg", ENERGY, 300), mobile, "slope_deg", "payload_kg")
    plot = sheet.add("p energy_payload", "payload, kg", ENERGY, 300)
    _mean_energy(plot, mobile, "payload_kg", "slope_deg")
    plot = titled(sheet.add("p energy_slip", "mean slip, %", ENERGY, 300), "loose sand, 5 deg")
    known = [r for r in over_slip if r.mobile]
    energy = np.array([r.energy_per_m_j for r in known])
    for key, label, colour in (
        ("slip_ratio", "usual slip ratio", style.AFTER),
        ("slip", "the study's proxy", style.BEFORE),
    ):
        slip = np.array([getattr(r, key) for r in known])
        plot.line(slip, energy, label, colour)
        plot.dots(slip, energy, label, colour, size=5.0)
    return ["energy_slope", "energy_payload", "energy_slip"]


def _mean_energy(plot: Plot, mobile: Sequence[BatchResult], name: str, other: str) -> None:
    """Energy per metre over the axis `name`, averaged over friction; a line each value of `other`."""
    unit = "kg" if other == "payload_kg" else "deg"
    for terrain, held in itertools.product(LABELS, HELD):
        runs = [r for r in mobile if r.cell.terrain == terrain and getattr(r.cell, other) == held]
        xs = sorted({getattr(r.cell, name) for r in runs})
        if len(xs) > 1:
            means = [np.mean([r.energy_per_m_j for r in runs if getattr(r.cell, name) == x]) for x in xs]
            dash = "solid" if held == 0.0 else "dotted"
            label, colour = f"{_named(terrain)}, {held:g} {unit}", _colour(terrain)
            plot.line(np.array(xs), np.array(means), label, colour, dash=dash)
            plot.dots(np.array(xs), np.array(means), label, colour, size=5.0)


def _speeds(sheet: Sheet, key: str, run: CaseRun, title: str) -> Plot:
    p = run.profiles
    plot = titled(sheet.add_time(key, SPEED, 220), title)
    plot.line(p.t_s, p.command, "command", COMMAND, width=1.2)
    plot.line(p.t_s, p.odometry, "odometry", WHEELS)
    plot.line(p.t_s, p.truth, "truth", TRUTH)
    return plot


def _named(terrain: str) -> str:
    return terrain.replace("_", " ")


def _colour(terrain: str) -> str:
    return style.line_colour(style.terrain_colour(terrain))
