"""Numbers that nothing on a ground robot reaches."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.checks.finding import CheckContext, Finding, Repair
from terrafusion.datasets.core.recording import Recording

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
TimesNs = NDArray[np.int64]

MOST_ROWS = 0.2
"""Where a larger share of the rows is impossible, the unit is wrong rather than some rows."""

LONGEST_DAYS = 30.0
"""No drive lasts longer; grids over such a time would not fit into memory either."""
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


def check_magnitude(context: CheckContext) -> Iterator[Finding]:
    """Numbers that no robot reaches: a wrong unit, or memory read as numbers."""
    yield from _check_duration(context)
    for name, (t_ns, bad) in _beyond(context.recording).items():
        if not bad:
            continue
        rows = np.logical_or.reduce([over for _, over, _ in bad])
        values, over, column = bad[0]
        first, limit = int(np.flatnonzero(over)[0]), LIMITS[name, _unit(column)]
        few = rows.sum() < MOST_ROWS * len(rows)
        yield Finding(
            "impossible-value",
            "error",
            name,
            f"{column} is {values[first]:g}, beyond anything possible",
            f"at t = {context.since_start_s(t_ns[first]):.3f} s; {int(over.sum())} of {len(over)} values "
            f"beyond {limit:g}" + (f", {int(rows.sum())} rows in all" if len(bad) > 1 else ""),
            "leave these rows out" if few else "is the unit right? too many rows are wrong to leave them out",
            _without_rows(name) if few else None,
        )


def _check_duration(context: CheckContext) -> Iterator[Finding]:
    """A channel that lasts longer than any drive has a leap in its times, or another unit of them."""
    clocks = {name: channel.t_ns for name, channel in context.recording.channels().items()}
    if context.recording.truth is not None and len(context.recording.truth):
        clocks["truth"] = context.recording.truth.t_ns
    for name, t_ns in clocks.items():
        days = (float(t_ns[-1]) - float(t_ns[0])) * 1e-9 / 86400.0
        if days > LONGEST_DAYS:
            row = int(np.argmax(np.diff(t_ns)))
            leap_s = (float(t_ns[row + 1]) - float(t_ns[row])) * 1e-9
            yield Finding(
                "impossible-time",
                "error",
                name,
                f"its times span {days:.0f} days",
                f"longest interval {leap_s:.3g} s after t = {context.since_start_s(t_ns[row]):.3f} s",
                "is the unit of time right? split the log where the clock leaps",
            )


def _beyond(recording: Recording) -> dict[str, tuple[TimesNs, list[tuple[Array, Mask, str]]]]:
    """Times by channel, and its columns with values beyond the limits: values, where, name."""
    tables: dict[str, tuple[TimesNs, dict[str, NDArray[Any]]]] = {
        name: (channel.t_ns, channel.columns()) for name, channel in recording.channels().items()
    }
    if recording.truth is not None and len(recording.truth):
        position = dict(zip(("x_m", "y_m", "z_m"), recording.truth.position_m.T, strict=True))
        tables["truth"] = recording.truth.t_ns, position
    found = {}
    for name, (t_ns, columns) in tables.items():
        limited = [(v, LIMITS[name, _unit(c)], c) for c, v in columns.items() if (name, _unit(c)) in LIMITS]
        over = [(values, np.abs(values) > limit, column) for values, limit, column in limited]
        found[name] = t_ns, [one for one in over if one[1].any()]
    return found


def _unit(column: str) -> str:
    return column[column.rindex("_") :] if "_" in column else ""


def _without_rows(name: str) -> Repair:
    def repair(recording: Recording) -> Recording:
        t_ns, bad = _beyond(recording)[name]
        wrong = np.zeros(len(t_ns), dtype=bool)
        for _, over, _ in bad:
            wrong |= over
        return dataclasses.replace(recording, **{name: getattr(recording, name).select(~wrong)})

    return repair
