"""Colours and habits that all plots share. matplotlib is imported only when something is drawn.

The colours start from Okabe and Ito (2008, "Color Universal Design"), which
readers with the common kinds of colour blindness can tell apart; grounds that
look alike in colour differ in lightness.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

TERRAIN_COLOURS = {
    "asphalt": "#4d4d4d",
    "gravel": "#a9a9a9",
    "grass": "#009e73",
    "medium_sand": "#e69f00",
    "loose_sand": "#f0d442",
    "ploughed_soil": "#8c510a",
    "mud": "#5e2a84",
    "snow": "#56b4e9",
    "unknown": "#e6a6c7",
}
SENSOR_COLOURS = {
    "gnss": "#0072b2",
    "gnss_velocity": "#56b4e9",
    "wheels": "#d55e00",
    "side_slip": "#8c510a",
    "gyro": "#009e73",
    "accel": "#cc79a7",
    "imu": "#009e73",
    "slip": "#e69f00",
}
MODE_COLOURS = {
    "adaptive": "#0072b2",
    "fixed": "#d55e00",
    "innovation": "#009e73",
    "robust": "#cc79a7",
    "oracle": "#7f7f7f",
}
TRUTH = "#1a1a1a"
HELD_OUT = "#cc3311"
OUTAGE = "#ffe0b3"
SPARE_COLOURS = ("#332288", "#88ccee", "#44aa99", "#999933", "#aa4499", "#661100", "#6699cc")

MAX_POINTS = 1200
"""Longer lines are thinned to this many points before they are drawn."""


def colour_of(name: str, table: dict[str, str]) -> str:
    """The fixed colour of a name; names outside the table get one of the spare colours, always the same."""
    return table.get(name) or SPARE_COLOURS[zlib.crc32(name.encode()) % len(SPARE_COLOURS)]


def canvas(ax: Axes | None, size: tuple[float, float] = (9.0, 3.0)) -> tuple[Figure, Axes]:
    """`ax` and its figure, or new ones; no global figure is made."""
    if ax is None:
        from matplotlib.figure import Figure

        ax = Figure(figsize=size, layout="constrained").subplots()
    return ax.get_figure(root=True), ax  # type: ignore[return-value]


def canvases(
    axes: Sequence[Axes] | None, rows: int, size: tuple[float, float]
) -> tuple[Figure, NDArray[Any]]:
    """Like `canvas`, for `rows` plots above each other on one time axis."""
    if axes is None:
        from matplotlib.figure import Figure

        grid = Figure(figsize=size, layout="constrained").subplots(rows, 1, sharex=True, squeeze=False)
        axes = list(grid[:, 0])
    found = np.empty(rows, dtype=object)
    found[:] = list(axes)
    return found[0].get_figure(root=True), found


def dress(ax: Axes, *, x: str = "", y: str = "", title: str = "") -> None:
    """Axis labels, a light grid and no box."""
    ax.set_xlabel(x, fontsize=9)
    ax.set_ylabel(y, fontsize=9)
    if title:
        ax.set_title(plain(title), fontsize=10, loc="left")
    ax.tick_params(labelsize=8)
    ax.grid(True, color="#e0e0e0", linewidth=0.6)
    ax.set_axisbelow(True)
    ax.margins(x=0.01)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)


def legend_above(ax: Axes, *, columns: int = 8, **options: Any) -> None:
    """The legend in rows above the plot, where it hides no data."""
    handles = options.pop("handles", None)
    if handles is None:
        handles, _ = ax.get_legend_handles_labels()
    if handles:
        ax.legend(
            handles=handles,
            loc="lower right",
            bbox_to_anchor=(1.0, 1.0),
            ncols=min(columns, len(handles)),
            frameon=False,
            fontsize=8,
            handlelength=1.4,
            columnspacing=1.2,
            borderaxespad=0.1,
            **options,
        )


def plain(text: object, limit: int = 60) -> str:
    """Text from a log for a label: one short line, no mathematics, and not hidden from the legend."""
    line = " ".join(str(text).split()).lstrip("_") or "unnamed"
    line = line if len(line) <= limit else line[: limit - 1] + "…"
    return line.replace("$", r"\$")


def thin(n: int, most: int = MAX_POINTS, keep: Iterable[int] = ()) -> NDArray[np.int64]:
    """At most about `most` evenly spaced row numbers of `n`, the ends and `keep` among them."""
    rows = np.arange(n) if n <= most else np.unique(np.linspace(0, n - 1, most).round().astype(np.int64))
    extra = np.asarray(list(keep), dtype=np.int64)
    return np.union1d(rows, extra) if len(extra) else rows


def seconds(t_ns: NDArray[np.int64], start_ns: int) -> Array:
    """Seconds (N,) from `start_ns`."""
    return np.asarray((t_ns - start_ns) * 1e-9)


def robust_limits(values: Array, *, include: Sequence[float] = (), pad: float = 0.08) -> tuple[float, float]:
    """Limits that show all but the wildest 0.5 % at each end."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return -1.0, 1.0
    low, high = np.percentile(finite, [0.5, 99.5])
    low, high = min([low, *include]), max([high, *include])
    room = pad * (high - low) or 0.1 * max(abs(high), 1e-6)
    return float(low - room), float(high + room)


def runs_of(labels: NDArray[Any]) -> list[tuple[int, int]]:
    """First and one-past-last row of each stretch of equal labels."""
    if not len(labels):
        return []
    cuts = np.flatnonzero(labels[1:] != labels[:-1]) + 1
    return list(zip([0, *cuts.tolist()], [*cuts.tolist(), len(labels)], strict=True))
