"""`terrafusion calibrate`: its files, its words, its errors."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vehicle import load_vehicle
from tests.fusion.reports.browser import assert_drawn

NAMES = "soil.resistance.rolling,vehicle.wheel.radius_m,vehicle.body.cg_height_m"


def test_files_and_words(terrafusion, good_log: Path, tmp_path: Path) -> None:
    out = tmp_path / "fit"
    done = terrafusion(
        "calibrate",
        good_log,
        "--parameters",
        NAMES,
        "--prior",
        "vehicle.wheel.radius_m=0.175+-0.01",
        "--out",
        out,
    )
    assert done.status == 0, done.err
    assert "vehicle.body.cg_height_m is not identified by this data" in done.out
    found = json.loads((out / "calibration.json").read_text())
    assert found["schema"] == "terrafusion.calibration/1"
    assert found["outcome"] == "converged"
    radius = found["parameters"]["vehicle.wheel.radius_m"]
    assert radius["value"] == pytest.approx(0.175, abs=4.0 * radius["sigma"])
    assert radius["unit"] == "m"
    assert found["parameters"]["vehicle.body.cg_height_m"]["status"] == "not identified"
    assert len(found["correlation"]) == 3
    robot = load_vehicle(out / "vehicle.yaml")
    assert robot.wheel.radius_m == radius["value"]
    assert robot.measured == ("wheel.radius_m",)
    rolling = found["parameters"]["asphalt.resistance.rolling"]["value"]
    assert load_soil(out / "soil.yaml").resistance.rolling == rolling
    page = (out / "report.html").read_text()
    assert "Twin against log" in page
    assert "<strong>2 of 3 parameters are identified</strong>" in page
    assert "vehicle.body.cg_height_m is not identified by this data" in page
    assert page.count("<figure>") == 2 + len({c["channel"] for c in found["channels"]})
    assert "default-src 'none'" in page  # the browser itself refuses any request
    assert_drawn(out / "report.html")


def test_pieces_of_a_log(terrafusion, good_log: Path, tmp_path: Path) -> None:
    out = tmp_path / "fit"
    names = "vehicle.wheel.radius_m"
    done = terrafusion(
        "calibrate", f"{good_log}@0-8", f"{good_log}@8-16", "--parameters", names, "--out", out
    )
    assert done.status == 0, done.err
    found = json.loads((out / "calibration.json").read_text())
    assert [name.partition("@")[2] for name in found["logs"]] == ["0-8", "8-16"]
    assert 10.0 < found["seconds"] <= 16.0
    radius = found["parameters"]["vehicle.wheel.radius_m"]
    assert 0.0 < radius["sigma"] < 0.005
    assert radius["value"] == pytest.approx(0.175, abs=4.0 * radius["sigma"])
    late = terrafusion("calibrate", f"{good_log}@900-950", "--parameters", names, "--out", out)
    assert late.status == 1
    assert "nothing was recorded from 900 to 950 s" in late.err
    assert late.err.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--parameters", "soil.mass"), ("unknown parameter",)),
        (("--vehicle", "nobody"), ("unknown vehicle",)),
        (("--terrain", "cheese"), ("unknown terrain", "asphalt")),
        (("--input", "thought"), ("unknown input",)),
        (("--window-s", "0.1"), ("out of range",)),
        (("--aspect-deg", "inf"), ("'aspect_deg' is inf, out of range",)),
        (("--payload-kg", "nan"), ("'payload_kg' is nan, out of range",)),
        (("--payload-kg", "-1"), ("'payload_kg' is -1.0, out of range",)),
        (("--terrain", "lava=mud"), ("no log drives on 'lava'", "asphalt")),
        (("--parameters", "vehicle.drive.lag_s", "--input", "wheels"), ("cannot be identified",)),
    ],
)
def test_one_line_errors(terrafusion, good_log: Path, tmp_path: Path, words: tuple[str, ...], told) -> None:
    assert terrafusion("calibrate", good_log, "--out", tmp_path / "fit", *words).refused(*told)
    assert not (tmp_path / "fit").exists()


def test_no_such_log(terrafusion, tmp_path: Path) -> None:
    assert terrafusion("calibrate", tmp_path / "none", "--out", tmp_path / "fit").refused("none")
    assert not (tmp_path / "fit").exists()


@pytest.mark.parametrize(
    "words",
    [
        ("--prior", "x=1"),
        ("--prior", "x=a+-b"),
        ("--slope-deg", "40"),
        ("--terrain", "a=b", "--terrain", "c"),
    ],
)
def test_wrong_usage(terrafusion, good_log: Path, tmp_path: Path, words: tuple[str, ...]) -> None:
    assert terrafusion("calibrate", good_log, "--out", tmp_path / "fit", *words).status == 2


def test_a_twin_that_does_not_fit_is_doubtful(terrafusion, good_log: Path, tmp_path: Path) -> None:
    out = tmp_path / "fit"
    names = "vehicle.body.mass_kg"
    done = terrafusion(
        "calibrate", f"{good_log}@0-12", "--vehicle", "husky", "--parameters", names, "--out", out
    )
    assert done.status == 0, done.err
    assert "times its noise: is it the right vehicle" in done.out
    page = (out / "report.html").read_text()
    assert "times its noise: is it the right vehicle" in page.partition("<strong>1 of 1 parameters")[2]
    assert "doubtful" in page.partition("<strong>1 of 1 parameters")[0].lower()[-600:]
