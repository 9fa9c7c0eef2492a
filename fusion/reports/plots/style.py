"""Colours and helpers that all plots share. matplotlib is imported only when something is drawn.

The colours start from Okabe and Ito (2008, "Color Universal Design"), which readers with the common kinds of
colour blindness can tell apart; terrains that are alike in hue differ in lightness.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure


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
    "gnss_velocity": "#3d8fc0",
    "wheels": "#d55e00",
    "side_slip": "#8c510a",
    "gyro": "#009e73",
    "accel": "#cc79a7",
    "imu": "#009e73",
    "slip": "#b07a00",
}
MODE_COLOURS = {
    "adaptive": "#0072b2",
    "fixed": "#d55e00",
    "innovation": "#009e73",
    "robust": "#cc79a7",
    "oracle": "#7f7f7f",
}
AXIS_COLOURS = ("#0072b2", "#d55e00", "#009e73")
"""Of x, y and z."""
TRUTH, HELD_OUT, NEUTRAL = "#1a1a1a", "#cc3311", "#7f7f7f"
TRUTH_ON_ANY, EXPECTED_ON_ANY, OUTAGE_ON_ANY = "#808080", "#808080", "#e69f00"
"""The same where the background may be light or dark."""
BEFORE, AFTER = "#d55e00", "#0072b2"
EXPECTED = "#dddddd"
LINE_LUMINANCE = (0.13, 0.29)
"""Relative luminance (WCAG 2.1) of lines that stand out on a light and on a dark page."""
SPARE_COLOURS = ("#332288", "#88ccee", "#44aa99", "#999933", "#aa4499", "#661100", "#6699cc")

TIME = "time from the start, s"
MAX_POINTS = 1200
"""Longer lines are thinned to this many points before they are drawn."""


def colour_of(name: str, table: dict[str, str]) -> str:
    """The colour of a name; one that is not in the table always gets the same spare colour."""
    return table.get(name) or SPARE_COLOURS[zlib.crc32(name.encode()) % len(SPARE_COLOURS)]


def terrain_colour(name: object) -> str:
    """The colour of a terrain class."""
    return colour_of(str(name), TERRAIN_COLOURS)


def line_colour(colour: str) -> str:
    """The colour, as light or dark as a line needs: a contrast of 3 to a light and to a dark page."""
    rgb = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    light = float(linear @ [0.2126, 0.7152, 0.0722])
    low, high = LINE_LUMINANCE
    if light > high:
        linear *= high / light
    elif light < low:
        linear += (low - light) / (1.0 - light) * (1.0 - linear)
    rgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)
    return "#" + "".join(f"{round(255.0 * x):02x}" for x in rgb)


def canvas(size: tuple[float, float] = (9.0, 3.0)) -> tuple[Figure, Axes]:
    """A new figure of `size`, inches, and its axes; pyplot's list of figures is not touched."""
    fig, axes = canvases(1, size)
    return fig, axes[0]


def canvases(
    rows: int, size: tuple[float, float], columns: int = 1, *, sharex: bool = True
) -> tuple[Figure, list[Axes]]:
    """A new figure of `size`, inches, and its axes row by row."""
    from matplotlib.figure import Figure

    fig = Figure(figsize=size, layout="constrained")
    return fig, list(fig.subplots(rows, columns, sharex=sharex, squeeze=False).flat)


def format_axes(ax: Axes, *, x: str = "", y: str = "", title: str = "") -> None:
    """Axis labels, a light grid and no box."""
    ax.set_xlabel(x, fontsize=9)
    ax.set_ylabel(y, fontsize=9)
    if title:
        ax.set_title(label_text(title), fontsize=10, loc="left")
    ax.tick_params(labelsize=8)
    ax.grid(True, color="#e0e0e0", linewidth=0.6)
    ax.set_axisbelow(True)
    ax.margins(x=0.01)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)


def legend_above(ax: Axes, *, columns: int = 8, handles: Sequence[Any] | None = None) -> None:
    """The legend in rows above the plot, where it hides no data."""
    handles = ax.get_legend_handles_labels()[0] if handles is None else handles
    if handles:
        ax.legend(
            handles=handles, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=min(columns, len(handles)),
            frameon=False, fontsize=8, handlelength=1.4, columnspacing=1.2, borderaxespad=0.1,
        )  # fmt: skip


def line(ax: Axes, t_s: Array, values: Array, colour: str, label: str | None = None, **options: Any) -> None:
    """A line, thinned to `MAX_POINTS`."""
    rows = thin(len(t_s))
    ax.plot(t_s[rows], values[rows], color=colour, label=label, **({"linewidth": 1.2} | options))


def plain_log_ticks(axis: Axis) -> None:
    """Ticks of a logarithmic axis as 200 instead of 2 x 10^2."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def label_text(text: object, limit: int = 60) -> str:
    """Text from a log for a label: one short line, no mathematics, and not hidden from the legend."""
    words = " ".join(str(text).split()).lstrip("_") or "unnamed"
    words = words if len(words) <= limit else words[: limit - 1] + "…"
    return words.replace("$", r"\$")


def thin(n: int, most: int = MAX_POINTS, keep: Iterable[int] = ()) -> NDArray[np.int64]:
    """At most about `most` evenly spaced row numbers of `n`, the ends and `keep` among them."""
    rows = np.arange(n) if n <= most else np.unique(np.linspace(0, n - 1, most).round().astype(np.int64))
    extra = np.asarray(list(keep), dtype=np.int64)
    return np.union1d(rows, extra) if len(extra) else rows


def seconds(t_ns: NDArray[np.int64], start_ns: int) -> Array:
    """Seconds (N,) from `start_ns`."""
    return np.asarray((t_ns - start_ns) * 1e-9)


def robust_limits(values: Array, *, include: Sequence[float] = ()) -> tuple[float, float]:
    """Limits that show all but the most extreme 0.5 % at each end."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return -1.0, 1.0
    low, high = np.percentile(finite, [0.5, 99.5])
    low, high = min([low, *include]), max([high, *include])
    room = 0.08 * (high - low) or 0.1 * max(abs(high), 1e-6)
    return float(low - room), float(high + room)


def runs_of(labels: NDArray[Any]) -> list[tuple[int, int]]:
    """First and one-past-last row of each run of equal labels."""
    if not len(labels):
        return []
    cuts = np.flatnonzero(labels[1:] != labels[:-1]) + 1
    return list(zip([0, *cuts.tolist()], [*cuts.tolist(), len(labels)], strict=True))
