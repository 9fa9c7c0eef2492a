"""Interactive plots of one drive: Bokeh figures with one time axis and one cursor, as parts of a page.

Bokeh is imported only when something is drawn. The page holds Bokeh's script and the data;
`templates/plots.js` draws the figures, moves the cursor in all of them, and works the legends.
"""

from __future__ import annotations

import importlib
import json
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.reports.plots import style

if TYPE_CHECKING:
    from bokeh.plotting import figure as Figure  # noqa: N812

EXACT_IN_FLOAT32 = 2.0e4
"""Numbers up to this size are sent in single precision: their steps are below 2 mm there."""
_OWN_ID = re.compile(r'"id": "(p\d+)"')
_ID = re.compile(r'"(p\d+)"')
"""Bokeh numbers its models from the start of the process."""


@dataclass(frozen=True)
class LegendEntry:
    """A series of a figure as its legend shows it; `form` is a class of `templates/report.css`."""

    label: str
    colour: str
    form: str


@dataclass
class Panel:
    """One figure: its height, px, and legend by label."""

    figure: Figure
    height: int
    legend: dict[str, LegendEntry] = field(default_factory=dict)


class Sheet:
    """All figures of a page.

    Args:
        duration_s: length of the common time axis.
        outages: stretches without GNSS, shaded in each figure over time.
    """

    def __init__(self, duration_s: float, outages: Sequence[Outage] = ()) -> None:
        load_bokeh()
        from bokeh.models import Range1d, Span

        end = max(duration_s, 1e-3)
        self.time = Range1d(0.0, end, bounds=(-0.02 * end, 1.02 * end), name="time axis")
        self.cursor = Span(dimension="height", line_color="#808080", visible=False, name="cursor line")
        self.outages = outages
        self.panels: dict[str, Panel] = {}

    def add_time(
        self, key: str, label: str, height: int = 190, *, log: bool = False, limits: Any = None
    ) -> Plot:
        """A figure over time, s from the start of the recording, called `key`.

        Args:
            label: of the vertical axis, with its unit.
            log: whether that axis is logarithmic.
            limits: of that axis; by default those of the data.
        """
        from bokeh.plotting import figure

        fig = figure(
            height=height, sizing_mode="stretch_width", x_range=self.time, y_axis_label=label,
            y_axis_type="log" if log else "linear", toolbar_location="right", name=f"over time {key}",
            tools="xbox_zoom,xpan,xwheel_zoom,reset", active_drag="xbox_zoom", active_scroll=None,
            **({} if limits is None else {"y_range": tuple(map(float, limits))}),
        )  # fmt: skip
        fig.add_layout(self.cursor)
        plot = self._added(key, fig, height)
        if self.outages:
            edges = np.array([(one.start_s, one.start_s + one.seconds) for one in self.outages])
            at = {"x0": edges[:, 0], "x1": edges[:, 1]}
            plot.glyph("vstrip", at, "no GNSS", style.OUTAGE_ON_ANY, "area", alpha=0.16, line_width=0)
        return plot

    def add_map(self, key: str, x: str, y: str, height: int = 460) -> Plot:
        """A figure of places, m, one metre as long to the east as to the north."""
        from bokeh.plotting import figure

        fig = figure(
            height=height, sizing_mode="stretch_width", x_axis_label=x, y_axis_label=y, match_aspect=True,
            toolbar_location="right", name=f"map {key}", tools="pan,wheel_zoom,box_zoom,reset",
            active_scroll=None,
        )  # fmt: skip
        return self._added(key, fig, height)

    def _added(self, key: str, fig: Figure, height: int) -> Plot:
        fig.toolbar.logo = None
        fig.min_border_right = 4
        for axis in (fig.xaxis, fig.yaxis):
            axis.axis_label_text_font_style = "normal"
        self.panels[key] = Panel(fig, height)
        return Plot(key, self.panels[key])

    def json(self) -> str:
        """The figures for `plots.js`: the same values give the same text, safe inside a script element."""
        from bokeh.document import Document

        document = Document()
        for panel in self.panels.values():
            document.add_root(panel.figure)
        roots = {panel.figure.id: f"plot-{key}" for key, panel in self.panels.items()}
        docs = {"page": document.to_json(deferred=False)}
        render = [{"docid": "page", "roots": roots, "root_ids": list(roots)}]
        text = json.dumps({"docs": docs, "render": render}, allow_nan=False)
        names = {old: f"m{i}" for i, old in enumerate(dict.fromkeys(_OWN_ID.findall(text)))}
        text = _ID.sub(lambda match: f'"{names.get(match[1], match[1])}"', text)
        return text.replace("<", "\\u003c").replace("\u2028", "\\u2028")


@dataclass(frozen=True)
class Plot:
    """A figure to draw in. A series with a label has an entry in the legend."""

    key: str
    panel: Panel

    def line(
        self, x: Array, y: Array, label: str, colour: str, *, dash: str = "solid", width: float = 1.6,
        most: int = style.MAX_POINTS, name: str | None = None, keep: Iterable[int] = (), alpha: float = 1.0,
    ) -> None:  # fmt: skip
        """A line, thinned to `most` points; `name` is that of its data, for the script."""
        rows = style.thin(len(x), most, keep=keep)
        form = "line" if dash == "solid" else "dash"
        look: dict[str, Any] = {"line_dash": dash, "line_width": width, "alpha": alpha}
        self.glyph("line", {"x": x[rows], "y": y[rows]}, label, colour, form, name=name, **look)

    def band(self, x: Array, y: Array, sigma: Array, label: str, colour: str, alpha: float = 0.25) -> None:
        """`y` within two `sigma`."""
        rows = style.thin(len(x))
        low, high = ((y + k * sigma)[rows] for k in (-2.0, 2.0))
        known = np.isfinite(low) & np.isfinite(high)
        data = {"x": x[rows][known], "y1": low[known], "y2": high[known]}
        self.glyph("varea", data, label, colour, "area", alpha=alpha)

    def dots(
        self, x: Array, y: Array, label: str, colour: str, marker: str = "circle", size: float = 4.0
    ) -> None:
        """Points: "circle" filled, "ring", "x", "triangle" or "square"."""
        ring = marker == "ring"
        look: dict[str, Any] = {
            "fill_alpha": 0.0 if ring else 0.8,
            "size": size,
            "marker": "circle" if ring else marker,
        }
        self.glyph("scatter", {"x": x, "y": y}, label, colour, "ring" if ring else "dot", **look)

    def glyph(
        self, kind: str, data: Mapping[str, ArrayLike], label: str, colour: str | None, form: str, *,
        name: str | None = None, more: Mapping[str, ArrayLike] | None = None, **look: Any,
    ) -> None:  # fmt: skip
        """Any of Bokeh's glyphs, whose columns are those of `data`; with `colour` None a column `colour`.

        Args:
            name: of the data, for the script; `more` are columns that only the script reads.
        """
        from bokeh.models import ColumnDataSource

        columns = {key: compact(values) for key, values in (dict(data) | dict(more or {})).items()}
        getattr(self.panel.figure, kind)(
            **{key: key for key in data if key != "colour"},
            source=ColumnDataSource(columns, name=name),
            color=colour or "colour",
            name=f"{self.key}/{label}" if label else None,
            **look,
        )
        if label and colour:
            self.note(label, colour, form)

    def note(self, label: str, colour: str, form: str) -> None:
        """An entry of the legend."""
        self.panel.legend.setdefault(label, LegendEntry(label, colour, form))


def compact(values: ArrayLike) -> Any:
    """Numbers in single precision where that is exact enough for a screen."""
    array = np.asarray(values)
    if array.dtype.kind != "f":
        return array.tolist() if array.dtype.kind in "OU" else array
    finite = np.abs(array[np.isfinite(array)])
    return array.astype(np.float32) if finite.max(initial=0.0) < EXACT_IN_FLOAT32 else array


def load_bokeh() -> None:
    """Import Bokeh, which as it loads looks for settings in the home folder, where there may be none."""
    try:
        Path.home()
    except RuntimeError:  # a container without an entry for the user
        os.environ["HOME"] = os.devnull
        try:
            importlib.import_module("bokeh.settings")
        finally:
            del os.environ["HOME"]


@cache
def bokeh_script() -> str:
    """Bokeh's own script, for the page."""
    load_bokeh()
    from bokeh.resources import Resources

    return "\n".join(Resources(mode="inline", components=["bokeh"], minified=True, log_level="error").js_raw)
