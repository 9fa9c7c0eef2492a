"""Values and durations that no ground robot reaches: a wrong unit, or corrupt data."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.checks.finding import CheckContext, Finding, without_rows
from terrafusion.datasets.core.arrays import TimesNs
from terrafusion.datasets.core.recording import Recording

MOST_ROWS = 0.2
"""Where a larger share of the rows is impossible, the unit is wrong rather than some rows."""

LONGEST_DAYS = 30.0
"""No run lasts longer; grids over such a time would not fit into memory either."""
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
    """Values beyond `LIMITS` and durations beyond `LONGEST_DAYS`."""
    tables = _tables(context.recording)
    for name, (t_ns, _) in tables.items():
        yield from _check_duration(context, name, t_ns)
    for name, (t_ns, columns) in tables.items():
        limits = {column: LIMITS.get((name, _unit(column)), np.inf) for column in columns}
        limited = {column: values for column, values in columns.items() if np.isfinite(limits[column])}
        beyond = {column: np.abs(values) > limits[column] for column, values in limited.items()}
        beyond = {column: mask for column, mask in beyond.items() if mask.any()}
        if not beyond:
            continue
        column, mask = next(iter(beyond.items()))
        rows = np.logical_or.reduce(list(beyond.values()))
        first = int(np.argmax(mask))
        few = rows.sum() < MOST_ROWS * len(rows)
        yield Finding(
            "impossible-value", "error", name,
            f"{column} is {columns[column][first]:g}, beyond anything possible",
            f"at t = {context.since_start_s(t_ns[first]):.3f} s; {int(mask.sum())} of {len(mask)} values "
            f"beyond {limits[column]:g}" + (f", {int(rows.sum())} rows in all" if len(beyond) > 1 else ""),
            "leave these rows out" if few else "is the unit right? too many rows are wrong to leave them out",
            without_rows(name, rows) if few else None,
        )  # fmt: skip


def _check_duration(context: CheckContext, name: str, t_ns: TimesNs) -> Iterator[Finding]:
    days = (float(t_ns[-1]) - float(t_ns[0])) * 1e-9 / 86400.0
    if days > LONGEST_DAYS:
        row = int(np.argmax(np.diff(t_ns)))
        leap_s = (float(t_ns[row + 1]) - float(t_ns[row])) * 1e-9
        yield Finding(
            "impossible-time", "error", name,
            f"its times span {days:.0f} days",
            f"longest interval {leap_s:.3g} s after t = {context.since_start_s(t_ns[row]):.3f} s",
            "is the unit of time right? split the log where the clock jumps",
        )  # fmt: skip


def _tables(recording: Recording) -> dict[str, tuple[TimesNs, dict[str, NDArray[Any]]]]:
    """Times and columns by channel, with the positions of the truth."""
    tables: dict[str, tuple[TimesNs, dict[str, NDArray[Any]]]] = {
        name: (channel.t_ns, channel.columns()) for name, channel in recording.channels().items()
    }
    if recording.truth is not None and len(recording.truth):
        position = dict(zip(("x_m", "y_m", "z_m"), recording.truth.position_m.T, strict=True))
        tables["truth"] = recording.truth.t_ns, position
    return tables


def _unit(column: str) -> str:
    return column[column.rindex("_") :] if "_" in column else ""
