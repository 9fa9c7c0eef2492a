"""Interactive plots: Bokeh figures as parts of a page; those of one drive share a time axis and a cursor.

Bokeh is imported only when something is drawn. The page holds Bokeh's script and the data;
`templates/plots.js` draws the figures, moves the cursor in all of them, and works the legends.
"""

from __future__ import annotations

import importlib
import json
import os
import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from terrafusion.datasets.core.arrays import Array, TimesNs
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.reports.plots import style

if TYPE_CHECKING:
    from bokeh.plotting import figure as Figure  # noqa: N812

EXACT_IN_FLOAT32 = 2.0e4
"""Numbers up to this size are sent in single precision: their steps are below 2 mm there."""
TIME_LABEL_PX = 16
"""Of the label below a figure over time."""
LETTER_PX = 8
"""Height of a figure over time that a letter of its upright label takes: a longer one has two lines."""
AXIS_PX = 80
"""Left of all figures, so that the same time stands at the same place in each."""
NO_VALUE = "#80808040"
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
        start_ns: start of the recording, from which that axis counts.
    """

    def __init__(self, duration_s: float = 1.0, outages: Sequence[Outage] = (), start_ns: int = 0) -> None:
        self.begin_axis(duration_s)
        self.outages, self.start_ns = outages, start_ns
        self.panels: dict[str, Panel] = {}

    def begin_axis(self, duration_s: float) -> None:
        """Begin a time axis with its cursor, for the figures over time that follow."""
        load_bokeh()
        from bokeh.models import Range1d, Span

        end = max(duration_s, 1e-3)
        self.time = Range1d(0.0, end, bounds=(-0.02 * end, 1.02 * end), name="time axis")
        self.cursor = Span(dimension="height", line_color="#808080", visible=False, name="cursor line")

    def seconds(self, t_ns: TimesNs) -> Array:
        """Places (N,) of times (N,) on the time axis."""
        return np.asarray((t_ns - self.start_ns) * 1e-9)

    def add_time(
        self, key: str, label: str, height: int = 190, *, log: bool = False, limits: Any = None
    ) -> Plot:
        """A figure over time, s from the start of the recording, called `key`.

        Args:
            label: of the vertical axis, with its unit.
            log: whether that axis is logarithmic.
            limits: of that axis; by default those of the data.
        """
        shown = {} if limits is None else {"y_range": tuple(map(float, limits))}
        label = textwrap.fill(label, height // LETTER_PX)
        plot = self.add(
            f"over time {key}", "time, s", label, height + TIME_LABEL_PX, "xbox_zoom,xpan,xwheel_zoom,reset",
            x_range=self.time, y_axis_type="log" if log else "linear", active_drag="xbox_zoom", **shown,
        )  # fmt: skip
        plot.panel.figure.add_layout(self.cursor)
        if self.outages:
            edges = np.array([(one.start_s, one.start_s + one.seconds) for one in self.outages])
            at = {"x0": edges[:, 0], "x1": edges[:, 1]}
            plot.glyph(
                "vstrip", at, "no GNSS", style.OUTAGE_ON_ANY, "hatch", fill_alpha=0.06, line_width=0,
                hatch_pattern="right_diagonal_line", hatch_color=style.OUTAGE_ON_ANY, hatch_alpha=0.25,
            )  # fmt: skip
        return plot

    def add_map(self, key: str, x: str, y: str, height: int = 460) -> Plot:
        """A figure of places, m, one metre as long to the east as to the north."""
        return self.add(f"map {key}", x, y, height, "pan,wheel_zoom,box_zoom,reset", match_aspect=True)

    def add(
        self, name: str, x: str | None, y: str, height: int = 320, tools: str = "pan,box_zoom,reset,save",
        **options: Any,
    ) -> Plot:  # fmt: skip
        """A figure of y over x; its key is the last word of `name`, `options` are of Bokeh's `figure`."""
        from bokeh.plotting import figure

        fig = figure(
            height=height, sizing_mode="stretch_width", x_axis_label=x, y_axis_label=y, name=name,
            toolbar_location="right", tools=tools, active_scroll=None, **options,
        )  # fmt: skip
        fig.toolbar.logo = None
        fig.title.text_color = style.NEUTRAL
        fig.min_border_right = 4
        fig.min_border_left = AXIS_PX
        for axis in (fig.xaxis, fig.yaxis):
            axis.axis_label_text_font_style = "normal"
        key = name.split()[-1]
        self.panels[key] = Panel(fig, height)
        return Plot(key, self.panels[key])

    def add_rows(self, name: str, x: str, rows: Sequence[str], row_px: int = 30, **options: Any) -> Plot:
        """A figure with a named row for each of 0, 1, ... from the top down."""
        plot = self.add(name, x, "", 70 + row_px * len(rows), y_range=(len(rows) - 0.5, -0.5), **options)
        name_ticks(plot.panel.figure.yaxis, rows)
        plot.panel.figure.ygrid.visible = False
        return plot

    def parts(self) -> dict[str, Any]:
        """What `write_page` needs to show the figures."""
        return {"panels": self.panels, "plots": self.json(), "library": bokeh_script()}

    def json(self) -> str:
        """The figures for `plots.js`: the same values give the same text, safe inside a script element."""
        from bokeh.document import Document

        document = Document()
        with document.models.freeze():  # or each figure would have all models counted anew
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
        most: int = style.MAX_POINTS, keep: Iterable[int] = (), alpha: float = 1.0,
    ) -> None:  # fmt: skip
        """A line, thinned to `most` points."""
        rows = style.thin(len(x), most, keep=keep)
        form = "line" if dash == "solid" else "dash"
        look: dict[str, Any] = {"line_dash": dash, "line_width": width, "alpha": alpha}
        self.glyph("line", {"x": x[rows], "y": y[rows]}, label, colour, form, **look)

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
        form = marker if marker in ("ring", "triangle", "square") else "dot"
        self.glyph("scatter", {"x": x, "y": y}, label, colour, form, **look)

    def glyph(
        self, kind: str, data: Mapping[str, ArrayLike], label: str, colour: Any, form: str, *,
        name: str | None = None, more: Mapping[str, Any] | None = None,
        tips: Mapping[str, str] | None = None, **look: Any,
    ) -> None:  # fmt: skip
        """Any of Bokeh's glyphs, whose columns are those of `data`; with `colour` None a column `colour`.

        `name` is that of the data, for the script; `more` are columns for the script and for `tips`, what the
        pointer shows: label to "@column".
        """
        from bokeh.models import ColumnDataSource, HoverTool

        columns = {key: compact(values) for key, values in (dict(data) | dict(more or {})).items()}
        drawn = getattr(self.panel.figure, kind)(
            **{key: key for key in data if key != "colour"},
            source=ColumnDataSource(columns, name=name),
            color=colour or "colour",
            name=f"{self.key}/{label}" if label else None,
            **look,
        )
        if tips:
            self.panel.figure.add_tools(HoverTool(renderers=[drawn], tooltips=[*tips.items()], visible=False))
        if label and colour:
            self.note(label, colour, form)

    def intervals(
        self, rows: Array, values: Array, low: Array, high: Array, label: str, colour: str, *,
        hollow: bool = False, text: Sequence[str] | None = None,
    ) -> None:  # fmt: skip
        """Dots with their intervals, at rows of `Sheet.add_rows`; `text` is what the pointer shows."""
        if text is None:
            text = [f"{v:.3g} [{a:.3g}, {b:.3g}]" for v, a, b in zip(values, low, high, strict=True)]
        form, ends = "ring" if hollow else "dot", {"x0": low, "x1": high, "y0": rows, "y1": rows}
        self.glyph("segment", ends, label, colour, form, line_width=2)
        self.glyph(
            "scatter", {"x": values, "y": rows}, label, colour, form, size=8.0,
            fill_alpha=0.0 if hollow else 1.0, more={"text": text}, tips={label: "@text"},
        )  # fmt: skip

    def cells(
        self, x: Array, y: Array, values: Array, palette: Sequence[str], *, log: bool = False,
        limits: tuple[float, float] | None = None, texts: Sequence[str] | None = None,
    ) -> None:  # fmt: skip
        """A heat map of values (rows, columns) over edges x (columns + 1,), y (rows + 1,); NaN is grey.

        The pointer shows `texts`, row by row; by default the value and its place.
        """
        from bokeh.models import ColorBar, LinearColorMapper, LogColorMapper

        known = values[np.isfinite(values)]
        low, high = limits or ((known.min(), known.max()) if len(known) else (0.0, 1.0))
        kind = LogColorMapper if log else LinearColorMapper
        mapper = kind([*palette], low=float(low), high=float(high) + 1e-9, nan_color=NO_VALUE)
        row, column = (index.ravel() for index in np.indices(values.shape))
        at = {"left": x[column], "right": x[column + 1], "bottom": y[row], "top": y[row + 1]}
        value = values.ravel()
        text = texts or [f"{one:.3g}" if np.isfinite(one) else "none" for one in value]
        middle = {"x": 0.5 * (x[column] + x[column + 1]), "y": 0.5 * (y[row] + y[row + 1])}
        fig = self.panel.figure
        places = {fig.xaxis[0].axis_label: "@x{0.###}", fig.yaxis[0].axis_label: "@y{0.###}"}
        places = {} if texts else places
        self.glyph(
            "quad", at, "", {"field": "value", "transform": mapper}, "area",
            line_width=0, more={"value": value, "text": text} | middle,
            tips={"value": "@text"} | {label: tip for label, tip in places.items() if label},
        )  # fmt: skip
        look = {"background_fill_alpha": 0.0, "major_label_text_color": style.NEUTRAL}
        bar = ColorBar(color_mapper=mapper, width=10, padding=2, **look)
        fig.add_layout(bar, "right")

    def note(self, label: str, colour: str, form: str) -> None:
        """An entry of the legend."""
        self.panel.legend.setdefault(label, LegendEntry(label, colour, form))


def name_ticks(axis: Any, names: Sequence[str]) -> None:
    """Names in place of the numbers 0, 1, ... of an axis."""
    axis.ticker = [*range(len(names))]
    axis.major_label_overrides = dict(enumerate(names))


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
