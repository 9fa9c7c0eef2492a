"""The report: self-contained, escaped, fair to both runs; and the plots in it."""

from __future__ import annotations

import dataclasses
import json
import re
import time
from html.parser import HTMLParser

import numpy as np
import pytest

from terrafusion.datasets.core.channels import Fix, Gnss, Terrain
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.tables import number
from terrafusion.fusion.estimate.estimate import WeightChange
from terrafusion.fusion.grounds.memory import MOST_GROUNDS
from terrafusion.fusion.metrics.baselines import Baselines
from terrafusion.fusion.metrics.scores import Outage, score
from terrafusion.fusion.outputs.replay_files import metrics_of
from terrafusion.fusion.reports.plots import replay as plots
from terrafusion.fusion.reports.plots import replay_filter as plots_filter
from terrafusion.fusion.reports.plots import replay_map as plots_map
from terrafusion.fusion.reports.plots import style
from terrafusion.fusion.reports.plots.sheet import Sheet, compact
from terrafusion.fusion.reports.plots.style import colour_of, label_text, thin
from terrafusion.fusion.reports.replay import write_report
from terrafusion.fusion.reports.replay_text import ScoreRow, pick_pair, score_rows, summary_of_many
from tests.fusion.replayed import result_of
from tests.fusion.reports.browser import BROWSER, assert_drawn

CLASSES = ("asphalt", "loose_sand", "mud", "unknown")
COLOURS = {"adaptive": "#0072b2", "fixed": "#d55e00", "a": "#0072b2"}
HOSTILE = '<script>alert("x")</script>&_$\\frac{'
OUTAGES = (Outage(40.0, 30.0),)


def make_run(d, name, recording=None, *, outages=OUTAGES, log="synthetic", **changed):
    recording = recording or d.recording
    estimate = dataclasses.replace(d.estimate, **changed)
    scores = score(estimate, recording, held_out=d.fixes, outages=outages)
    named = dataclasses.replace(recording, name=log)
    mode = name if name in ("adaptive", "fixed") else "robust"
    return result_of(named, estimate, scores, mode=mode, held_out=d.fixes, outages=outages)


class Page(HTMLParser):
    """Tags, links and headings of a page; complains about tags that do not close."""

    VOID = ("meta", "img", "br", "hr", "input")

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.headings: list[str] = []
        self.plots: list[str] = []
        self.links: list[str] = []

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        if values.get("class") == "plot":
            self.plots.append(values["id"].removeprefix("plot-"))
        self.links += [values[k] for k in ("href", "src") if k in values]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == "h2":
            self.headings.append(data)


def parse(path):
    page = Page()
    page.feed(path.read_text(encoding="utf-8"))
    assert page.open == []
    return page


def test_a_comparison_has_all_sections_and_nothing_outside(drive, tmp_path):
    good, bad = drive(drift_mps=0.005), drive(drift_mps=0.03)
    runs = [make_run(good, "adaptive"), make_run(bad, "fixed")]
    path = write_report(tmp_path / "report.html", "Two runs", runs, {"command": "terrafusion demo"})
    page = parse(path)
    assert page.headings == [
        "Drive",
        "Numbers",
        "Errors",
        "Terrain",
        "Sensor weights",
        "Sensors",
        "Assumed",
        "Notes",
        "Provenance",
    ]
    assert page.plots[:3] == ["map", "error_runs", "slip"]
    assert len(page.plots) > 10
    assert page.links == []
    text = path.read_text(encoding="utf-8")
    assert "loose_sand became likelier" in text
    assert "terrafusion demo" in text
    assert "adaptive is better than fixed in" in text
    assert "default-src 'none'" in text  # the browser itself refuses any request
    assert len(text) < 3_000_000
    assert list(tmp_path.iterdir()) == [path]


def test_one_run_needs_no_comparison(drive, tmp_path):
    d = drive(drift_mps=0.01)
    run = make_run(d, "adaptive")
    path = write_report(tmp_path / "r.html", "Replay", [run])
    text = path.read_text(encoding="utf-8")
    assert "error_runs" in parse(path).plots
    assert "against fixed" not in text
    assert "★ best" not in text
    assert "Without GNSS for 30 s from 40 s the position was" in text


def test_baselines_stand_beside_the_errors(drive, tmp_path):
    beside = Baselines(dead_reckoning_m=1.25, gnss_m=3.75)
    run = dataclasses.replace(make_run(drive(), "adaptive"), baselines=beside)
    text = write_report(tmp_path / "r.html", "Replay", [run]).read_text(encoding="utf-8")
    assert all(f'<td class="n">{value}</td>' in text for value in ("1.25", "3.75"))


def test_what_comes_from_a_log_is_escaped(drive, tmp_path):
    d = drive(seconds=20.0)
    classes = (HOSTILE, "$$", "_hidden", "unknown")
    changes = (WeightChange(int(d.estimate.trajectory.t_ns[50]), HOSTILE, 0.1, 0.4, HOSTILE, HOSTILE),)
    recording = dataclasses.replace(
        d.recording,
        name=HOSTILE,
        description=HOSTILE,
        terrain=Terrain(d.recording.truth.t_ns[:1], np.array([HOSTILE], dtype=object), source=HOSTILE),
    )
    run = make_run(d, HOSTILE, recording, log=HOSTILE, classes=classes, changes=changes, notes=(HOSTILE,))
    path = write_report(tmp_path / "r.html", HOSTILE, [run], {HOSTILE: HOSTILE})
    parse(path)
    text = path.read_text(encoding="utf-8")
    assert "<script>alert" not in text
    assert text.count("<script") == 3  # the data, Bokeh, and what links the figures


def test_a_drive_that_cannot_be_scored_still_has_a_report(drive, tmp_path):
    d = drive(seconds=20.0)
    recording = Recording(name="bare", start_ns=d.recording.start_ns)
    bare = dataclasses.replace(d, recording=recording, fixes=d.fixes.select(slice(0, 0)))
    run = make_run(bare, "fixed", innovations=(), changes=(), notes=())
    path = write_report(tmp_path / "r.html", "Bare", [run])
    text = path.read_text(encoding="utf-8")
    assert "could not be scored" in text
    assert "No weight changed" in text
    parse(path)


def test_the_same_runs_give_the_same_page(drive, tmp_path):
    d = drive(seconds=20.0)
    run = make_run(d, "adaptive")
    pages = [write_report(tmp_path / f"{i}.html", "t", [run]).read_bytes() for i in range(2)]
    assert pages[0] == pages[1]


def test_losses_are_worded_like_wins(drive):
    good, bad = make_run(drive(drift_mps=0.005), "fixed"), make_run(drive(drift_mps=0.03), "adaptive")
    metrics = [metrics_of(good), metrics_of(bad)]
    ours, theirs = pick_pair(metrics)
    assert (ours, theirs) == (1, 0)
    row = score_rows(metrics)[0]
    assert row.verdict(1, 0) == ("6.0 times", "worse")
    assert row.verdict(0, 1) == ("83 % lower", "better")
    assert row.best() == 0
    sentences = " ".join(summary_of_many(["fixed", "adaptive"], metrics, ours, theirs))
    assert "6.0 times with adaptive" in sentences
    assert re.search(r"adaptive is better than fixed in 0 and worse in \d+", sentences)


def test_rows_judge_by_their_goal():
    nees = ScoreRow("NEES", (0.5, 1.2), goal="one")
    assert nees.best() == 1
    assert nees.verdict(0, 1) == ("farther from 1", "worse")
    assert ScoreRow("draw", (1.0001, 1.0002), goal="low").best() is None
    assert ScoreRow("half", (1.0, None), goal="low").best() is None
    assert ScoreRow("count", (1, 2)).verdict(0, 1) == ("", "")


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "–"), (0.0, "0"), (3, "3"), (12345, "12\u202f345"), (0.001234, "0.00123"), (99.96, "100.0"),
     (1.0, "1.00"), (1e-9, "1.00e-09")],
)  # fmt: skip
def test_numbers_read_well(value, text):
    assert number(value) == text


def test_figures_share_their_time_axis_and_cursor(drive):
    d = drive(seconds=30.0)
    sheet = Sheet(30.0, start_ns=d.recording.start_ns)
    errors = score(d.estimate, d.recording, held_out=None, outages=()).errors
    estimates = {"adaptive": d.estimate, "fixed": d.estimate}
    plots_map.plot_map(sheet, estimates, "adaptive", d.recording, COLOURS, errors={"adaptive": errors})
    plots.plot_slip(sheet, estimates, "adaptive", COLOURS)
    plots.plot_weights(sheet, d.estimate, marked=d.estimate.changes)
    timed = [p.figure for key, p in sheet.panels.items() if key != "map"]
    assert all(fig.x_range is sheet.time and sheet.cursor in fig.center for fig in timed)
    sources = {r.data_source.name: r.data_source for r in sheet.panels["map"].figure.renderers}
    assert {"run adaptive", "run fixed", "cursor marks"} <= set(sources)
    run = sources["run adaptive"].data
    assert np.isfinite(run["error"]).any()
    assert len(run["t"]) == len(run["x"]) == len(run["slip"])


def test_lines_stand_out_on_a_light_and_on_a_dark_page():
    """A contrast of 3 (WCAG 2.1, graphical objects) against both backgrounds of `report.css`."""

    def luminance(colour):
        parts = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
        linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    lines = [*style.MODE_COLOURS.values(), *style.AXIS_COLOURS, style.HELD_OUT, style.TRUTH_ON_ANY]
    lines += [style.line_colour(colour) for colour in style.TERRAIN_COLOURS.values()]
    lines += [
        style.SENSOR_COLOURS[name] for name in ("gnss", "gnss_velocity", "wheels", "slip", "gyro", "accel")
    ]
    for colour in lines:
        for page in ("#ffffff", "#14171b"):
            low, high = sorted((luminance(colour), luminance(page)))
            assert (high + 0.05) / (low + 0.05) >= 2.95, (colour, page)


@pytest.mark.skipif(BROWSER is None, reason="no headless browser")
def test_a_browser_draws_the_page_without_a_complaint(drive, tmp_path):
    d = drive(seconds=20.0)
    run = make_run(d, "adaptive")
    assert_drawn(write_report(tmp_path / "r.html", "t", [run]))


def test_plots_bear_gaps_nan_and_single_keyframes(drive):
    d = drive(seconds=10.0)
    holed = dataclasses.replace(d.estimate, slip=np.full(len(d.estimate.slip), np.nan))
    rows = slice(0, 1)
    one = dataclasses.replace(
        d.estimate,
        trajectory=d.estimate.trajectory.select(rows),
        velocity_mps=d.estimate.velocity_mps[rows],
        gyro_bias_radps=d.estimate.gyro_bias_radps[rows],
        accel_bias_mps2=d.estimate.accel_bias_mps2[rows],
        slip=d.estimate.slip[rows],
        slip_sigma=d.estimate.slip_sigma[rows],
        terrain=d.estimate.terrain[rows],
        weights={name: values[rows] for name, values in d.estimate.weights.items()},
        status=d.estimate.status[rows],
    )
    none = Gnss(
        d.fixes.t_ns, np.full((len(d.fixes), 3), np.nan), d.fixes.sigma_enu_m,
        np.full(len(d.fixes), Fix.NONE, dtype=np.uint8),
    )  # fmt: skip
    recording = dataclasses.replace(d.recording, gnss=none)
    for estimate in (holed, one):
        sheet = Sheet(10.0, OUTAGES, recording.start_ns)
        runs = {"a": estimate}
        plots.plot_slip(sheet, runs, "a", COLOURS)
        plots.plot_terrain(sheet, estimate, recording)
        plots.plot_weights(sheet, estimate)
        plots_filter.plot_biases(sheet, estimate)
        plots_filter.plot_innovations(sheet, estimate)
        plots.plot_speeds(sheet, estimate, recording, 0.175)
        plots_map.plot_map(sheet, runs, "a", recording, COLOURS, errors={}, held_out=none)
        page = json.loads(sheet.json())  # JSON itself knows no NaN
        assert len(page["render"][0]["roots"]) == len(sheet.panels)


def test_a_ground_that_nothing_tells_colours_nothing(drive):
    d = drive(seconds=20.0)
    known = np.zeros_like(d.estimate.terrain)
    known[:, CLASSES.index("unknown")] = 1.0
    blank = dataclasses.replace(d.estimate, terrain=known)
    found = np.where(np.arange(len(known)) < 40, "ground 1", "").astype(object)
    entries = []
    for estimate in (d.estimate, blank, dataclasses.replace(blank, found_ground=found)):
        sheet = Sheet(20.0, start_ns=d.recording.start_ns)
        plots.plot_slip(sheet, {"a": estimate}, "a", COLOURS)
        plots_map.plot_map(sheet, {"a": estimate}, "a", d.recording, COLOURS, errors={})
        entries.append({label for panel in sheet.panels.values() for label in panel.legend})
    assert "on loose_sand" in entries[0]
    assert not {"unknown", "on unknown"} & entries[1]
    assert {"ground 1", "on ground 1", "unknown"} <= entries[2]


def test_grounds_and_outages_look_different(drive):
    names = [*style.TERRAIN_COLOURS, *(f"ground {k}" for k in range(1, MOST_GROUNDS + 1))]
    assert len({style.terrain_colour(name) for name in names}) == len(names)
    d = drive(seconds=60.0)
    sheet = Sheet(60.0, OUTAGES, d.recording.start_ns)
    plots.plot_slip(sheet, {"a": d.estimate}, "a", COLOURS)
    assert [k for k, e in sheet.panels["slip"].legend.items() if e.form == "hatch"] == ["no GNSS"]


def test_the_legend_of_the_map_shows_start_and_end_as_the_map_does(drive):
    d = drive(seconds=20.0)
    sheet = Sheet(20.0, start_ns=d.recording.start_ns)
    plots_map.plot_map(sheet, {"a": d.estimate}, "a", d.recording, COLOURS, errors={})
    (legend,) = (panel.legend for panel in sheet.panels.values())
    assert (legend["start"].form, legend["end"].form) == ("triangle", "square")


def test_single_precision_is_used_only_where_it_is_exact_enough():
    assert compact(np.array([1.0, np.nan])).dtype == np.float32
    assert compact(np.array([5.4e6, 5.4e6 + 0.01])).dtype == np.float64


def test_important_changes_are_the_largest_apart_and_in_order():
    def change(t_s, sensor, after):
        return WeightChange(int(t_s * 1e9), sensor, 1.0, after, "", "")

    changes = [
        change(1, "wheels", 2.0),
        change(1.5, "wheels", 4.0),
        change(9, "gyro", 0.1),
        change(5, "gyro", 1.1),
    ]
    chosen = plots.important_changes(changes, most=2)
    assert [(c.sensor, c.after) for c in chosen] == [("wheels", 4.0), ("gyro", 0.1)]
    assert plots.important_changes([], most=2) == []


def test_style_helpers():
    assert colour_of("mud", {"mud": "#123456"}) == "#123456"
    assert colour_of("ice", {}) == colour_of("ice", {})
    assert label_text(" a\nb") == "a b"
    rows = thin(100_000, 100, keep=[77])
    assert rows[0] == 0
    assert rows[-1] == 99_999
    assert 77 in rows
    assert len(rows) <= 101


def test_a_report_on_a_long_drive_is_quick(drive, tmp_path):
    """About one second of computing; the bound leaves room for a busy machine."""
    d = drive(seconds=400.0, truth_hz=100, noise_m=0.05)
    runs = [make_run(d, "adaptive"), make_run(d, "fixed")]
    begun = time.process_time()
    path = write_report(tmp_path / "r.html", "Long", runs)
    assert time.process_time() - begun < 10.0
    assert path.stat().st_size < 3_000_000


def test_a_local_path_is_shown_with_the_reference_moved_onto_it(drive):
    """A path turned by 50 deg and moved lies on its reference again; one of GNSS is left where it is."""
    d = drive(seconds=40.0)
    turn = np.array([[np.cos(0.9), -np.sin(0.9)], [np.sin(0.9), np.cos(0.9)]])
    path = d.estimate.trajectory
    moved = path.position_m.copy()
    moved[:, :2] = moved[:, :2] @ turn.T + [30.0, -20.0]
    local = dataclasses.replace(
        d.estimate,
        trajectory=dataclasses.replace(path, position_m=moved),
        status=np.full(len(path), "no_gnss", dtype=object),
    )
    errors = score(d.estimate, d.recording, held_out=None, outages=()).errors
    for estimate, position in ((local, moved), (d.estimate, path.position_m)):
        sheet = Sheet(40.0, start_ns=d.recording.start_ns)
        given = {"adaptive": errors}
        plots_map.plot_map(sheet, {"adaptive": estimate}, "adaptive", d.recording, COLOURS, errors=given)
        names = ("map/reference, moved to the start", "map/truth")
        (line,) = (r for r in sheet.panels["map"].figure.renderers if r.name in names)
        xy = np.column_stack([line.data_source.data["x"], line.data_source.data["y"]])
        nearest = np.linalg.norm(xy[:, None] - position[None, :, :2], axis=2).min(axis=1)
        assert nearest.max() < 0.06  # keyframes are 0.1 m apart
