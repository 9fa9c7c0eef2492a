"""Colours and helpers that all plots share.

The colours start from Okabe and Ito (2008, "Color Universal Design"), which readers with the common kinds of
colour blindness can tell apart; terrains that are alike in hue differ in lightness.
"""

import re
import zlib
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.estimate.estimate import Estimate
from terrafusion.fusion.terrain.classifier import UNKNOWN

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
TRUTH_ON_ANY, EXPECTED_ON_ANY, OUTAGE_ON_ANY = "#808080", "#808080", "#808080"
"""The same where the background may be light or dark."""
BEFORE, AFTER = "#d55e00", "#0072b2"
LINE_LUMINANCE = (0.13, 0.29)
"""Relative luminance (WCAG 2.1) of lines that stand out on a light and on a dark page."""
SPARE_COLOURS = (
    "#332288", "#88ccee", "#44aa99", "#999933", "#aa4499", "#661100", "#6699cc", "#117733", "#ddcc77",
    "#cc6677", "#ee7733", "#225555",
)  # fmt: skip
"""One for each of the `memory.MOST_GROUNDS` that a robot finds."""

MAX_POINTS = 1200
"""Longer lines are thinned to this many points before they are drawn."""


def colour_of(name: str, table: dict[str, str]) -> str:
    """The colour of a name; one that is not in the table always gets the same spare colour."""
    return table.get(name) or SPARE_COLOURS[zlib.crc32(name.encode()) % len(SPARE_COLOURS)]


def terrain_colour(name: object) -> str:
    """The colour of a terrain class, or of a ground that the robot found: "ground 1", "ground 2", ..."""
    found = re.fullmatch(r"ground (\d+)", str(name))
    if found:
        return SPARE_COLOURS[(int(found[1]) - 1) % len(SPARE_COLOURS)]
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


def label_text(text: object, limit: int = 60) -> str:
    """Text from a log for a label: one short line."""
    words = " ".join(str(text).split()) or "unnamed"
    return words if len(words) <= limit else words[: limit - 1] + "…"


def grounds_known(estimate: Estimate) -> bool:
    """Whether the ground of any keyframe has a name."""
    return bool(estimate.classes) and bool((estimate.ground() != UNKNOWN).any())


def thin(n: int, most: int = MAX_POINTS, keep: Iterable[int] = ()) -> NDArray[np.int64]:
    """At most about `most` evenly spaced row numbers of `n`, the ends and `keep` among them."""
    rows = np.arange(n) if n <= most else np.unique(np.linspace(0, n - 1, most).round().astype(np.int64))
    extra = np.asarray(list(keep), dtype=np.int64)
    return np.union1d(rows, extra) if len(extra) else rows


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
