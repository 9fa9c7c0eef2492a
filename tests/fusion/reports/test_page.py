"""The frame of all reports: values are escaped, missing ones are errors, the style sheet is inside."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jinja2 import UndefinedError

from terrafusion.fusion.reports.calibration import _short
from terrafusion.fusion.reports.page import Tile, VerdictBox, write_page
from terrafusion.fusion.reports.plots.sheet import Sheet

HOSTILE = "<script>alert('x')</script>"


def sweep_page(path: Path, **values: Any) -> Path:
    given = {
        "lead": HOSTILE,
        "verdicts": [VerdictBox("good", HOSTILE, [HOSTILE])],
        "tiles": [Tile(HOSTILE, HOSTILE, HOSTILE)],
        "statistics": [],
    } | values
    provenance = {HOSTILE: HOSTILE}
    return write_page(path, "sweep.html.j2", HOSTILE, provenance=provenance, failures=[HOSTILE], **given)


def test_every_value_is_escaped_and_the_style_sheet_is_not(tmp_path: Path) -> None:
    text = sweep_page(tmp_path / "r.html", groups=[]).read_text(encoding="utf-8")
    assert "<script" not in text
    assert text.count("&lt;script&gt;") == 11
    assert 'font: 16px/1.55 system-ui, "Segoe UI"' in text


def test_a_missing_value_is_an_error_and_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(UndefinedError, match="groups"):
        sweep_page(tmp_path / "r.html")
    assert list(tmp_path.iterdir()) == []


def test_parameters_of_several_grounds_keep_the_name_of_their_ground() -> None:
    names = ["vehicle.wheel.radius_m", "mud.shear.friction_cap", "snow.shear.friction_cap"]
    assert _short(names) == ["wheel.radius_m", *names[1:]]
    assert _short(names[:2]) == ["wheel.radius_m", "shear.friction_cap"]


def test_a_label_that_is_longer_than_its_axis_has_two_lines() -> None:
    figure = Sheet().add_time("a", "accelerometer bias, m/s²", 180).panel.figure
    assert figure.yaxis[0].axis_label == "accelerometer bias,\nm/s²"


def test_a_hollow_mark_is_hollow_in_the_legend() -> None:
    plot = Sheet().add_rows("rows a", "x", ["a"])
    one = np.zeros(1)
    plot.intervals(one, one, one, one, "open", "#0072b2", hollow=True)
    assert plot.panel.legend["open"].form == "ring"
