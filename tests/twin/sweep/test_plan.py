"""Sweeps from YAML: what is allowed, which runs they make, what decides their hash."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.twin.model.library import known_names
from terrafusion.twin.scenario.file import load_scenario
from terrafusion.twin.scenario.scenario import DriveSegment
from terrafusion.twin.sweep.load import load_sweep
from terrafusion.twin.sweep.plan import Axis, Sweep, at_speed, top_speed_mps


def written(folder: Path, text: str) -> Sweep:
    file = folder / "own.yaml"
    file.write_text(text)
    return load_sweep(file)


def axes(folder: Path, text: str, more: str = "") -> Sweep:
    return written(folder, f"scenario: straight\n{more}\naxes: {text}\n")


@pytest.mark.parametrize("name", known_names("sweeps"))
def test_built_in_sweeps_load_and_say_how_many_runs_they_make(name: str) -> None:
    sweep = load_sweep(name)
    assert f"{sweep.runs} runs of" in sweep.design()
    assert sweep.description
    first = next(sweep.cases())
    assert first.run == 0


def test_the_cross_product_has_every_combination_once_the_last_axis_fastest(tmp_path: Path) -> None:
    sweep = axes(tmp_path, "{slope_deg: [0, 5], seed: [1, 2], terrain: [mud, asphalt], payload_kg: [0, 10]}")
    cases = list(sweep.cases())
    assert sweep.runs == len(cases) == 16
    assert [c.run for c in cases] == list(range(16))
    assert len({dataclasses.replace(c, run=0) for c in cases}) == 16
    assert [c.seed for c in cases[:4]] == [1, 2, 1, 2]
    assert [c.terrain for c in cases] == ["mud"] * 8 + ["asphalt"] * 8


def test_a_span_has_both_ends_and_tidy_steps(tmp_path: Path) -> None:
    sweep = axes(tmp_path, "{friction: {from: 0.1, to: 0.4, count: 4}}")
    assert [case.friction for case in sweep.cases()] == [0.1, 0.2, 0.3, 0.4]


def test_a_random_sweep_has_one_run_in_each_stratum_and_keeps_its_seed(tmp_path: Path) -> None:
    text = (
        "{friction: {from: 0.2, to: 1.0}, slope_deg: {from: 0, to: 20}, "
        "terrain: [mud, asphalt], seed: {from: 1, to: 3}}"
    )
    sweep = axes(tmp_path, text, "random: 60")
    cases = list(sweep.cases())
    friction = np.array([case.friction for case in cases])
    strata = np.floor((friction - 0.2) / 0.8 * 60)
    assert sorted(strata) == list(range(60))
    assert [sum(case.terrain == name for case in cases) for name in ("mud", "asphalt")] == [30, 30]
    assert [sum(case.seed == seed for case in cases) for seed in (1, 2, 3)] == [20, 20, 20]
    assert cases == list(axes(tmp_path, text, "random: 60").cases())
    assert cases != list(axes(tmp_path, text, "random: 60\nrandom_seed: 1").cases())


@given(st.floats(0.0, 1.0, exclude_max=True), st.integers(1, 7))
@settings(max_examples=50, deadline=None)
def test_a_share_of_an_axis_lies_on_it(share: float, count: int) -> None:
    assert Axis("friction", tuple(range(count))).at(share) in range(count)
    assert 0.2 <= float(Axis("friction", span=(0.2, 1.0)).at(share)) <= 1.0
    assert Axis("seed", span=(3.0, 3.0 + count)).at(share) in range(3, 4 + count)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("scenario: straight", ["'axes'", "friction"]),
        ("axes: {slope_deg: [0]}", ["'scenario' is missing"]),
        ("scenario: nowhere\naxes: {slope_deg: [0]}", ["unknown scenario 'nowhere'", "straight"]),
        ("scenario: straight\nvehicle: bus\naxes: {slope_deg: [0]}", ["unknown vehicle 'bus'", "elevate"]),
        ("scenario: straight\naxis: {slope_deg: [0]}", ["unknown key 'axis'", "axes"]),
        ("scenario: straight\naxes: {slope: [0]}", ["unknown key 'axes.slope'", "slope_deg"]),
        ("scenario: straight\naxes: {slope_deg: []}", ["'axes.slope_deg' is '[]'", "list"]),
        ("scenario: straight\naxes: {slope_deg: 5}", ["'axes.slope_deg' is '5'", "list"]),
        ("scenario: straight\naxes: {slope_deg: [0, 40]}", ["axes.slope_deg[1]", "40", "[0, 25] deg"]),
        ("scenario: straight\naxes: {slope_deg: [0, a]}", ["axes.slope_deg[1]", "'a'", "number"]),
        ("scenario: straight\naxes: {slope_deg: [5, 5]}", ["'axes.slope_deg' has 5.0 twice"]),
        ("scenario: straight\naxes: {friction: [3.0]}", ["axes.friction[0]", "3", "[0.01, 2]"]),
        ("scenario: straight\naxes: {payload_kg: [1000]}", ["axes.payload_kg[0]", "1000", "kg"]),
        ("scenario: straight\naxes: {speed_mps: [9]}", ["axes.speed_mps[0]", "9", "m/s"]),
        ("scenario: straight\naxes: {seed: [1.5]}", ["axes.seed[0]", "1.5", "whole"]),
        ("scenario: straight\naxes: {seed: [-1]}", ["axes.seed[0]", "-1"]),
        ("scenario: straight\naxes: {terrain: lava}", ["axes.terrain", "lava", "list"]),
        ("scenario: straight\naxes: {terrain: [lava]}", ["unknown terrain 'lava'", "mud"]),
        (
            "scenario: straight\naxes: {friction: {from: 1, to: 0.5, count: 3}}",
            ["axes.friction.from", "below"],
        ),
        ("scenario: straight\naxes: {friction: {from: 0.1, to: 0.5}}", ["axes.friction.count", "missing"]),
        (
            "scenario: straight\naxes: {friction: {from: 0.1, to: 0.5, count: 1}}",
            ["count", "1", "[2, 10000]"],
        ),
        (
            "scenario: straight\naxes: {friction: {from: 0.1, to: 0.5, step: 1}}",
            ["axes.friction.step", "count"],
        ),
        ("scenario: straight\naxes: {seed: {from: 0, to: 1, count: 3}}", ["axes.seed", "0.5", "whole"]),
        ("scenario: straight\naxes: {slope_deg: [0]}\nrandom: 0", ["'random'", "0"]),
        ("scenario: straight\naxes: {slope_deg: [0]}\nrandom: 2.5", ["'random' is 2.5", "whole"]),
        ("scenario: straight\naxes: {slope_deg: [0]}\nsensors: 1", ["'sensors' is '1'", "true or false"]),
        ("scenario: spin\naxes: {speed_mps: [1]}", ["axes.speed_mps", "spin", "speed_scale"]),
        ("scenario: straight\naxes: {speed_mps: [1], speed_scale: [1]}", ["exclude each other"]),
    ],
)
def test_a_bad_sweep_is_refused_with_key_value_and_what_is_allowed(
    tmp_path: Path, text: str, words: list[str]
) -> None:
    with pytest.raises(ConfigError) as caught:
        written(tmp_path, text)
    for word in words:
        assert word in str(caught.value)


def test_paths_in_a_sweep_are_relative_to_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "deep"
    folder.mkdir()
    (folder / "drive.yaml").write_text("drive: [{duration_s: 3, v_mps: 1.0}]\n")
    monkeypatch.chdir(tmp_path)
    sweep = written(folder, "scenario: drive.yaml\naxes: {slope_deg: [0, 1]}\n")
    assert sweep.scenario.duration_s == 3.0


def test_the_hash_follows_all_that_decides_the_rows_and_nothing_else(tmp_path: Path) -> None:
    base = axes(tmp_path, "{friction: [0.2, 0.5]}")
    assert base.sha256() == axes(tmp_path, "{friction: [0.2, 0.5]}", "description: renamed").sha256()
    for text, more in (
        ("{friction: [0.2, 0.6]}", ""),
        ("{friction: [0.2, 0.5]}", "sensors: true"),
        ("{friction: [0.2, 0.5]}", "vehicle: husky"),
        ("{friction: [0.2, 0.5]}", "random: 2"),
        ("{friction: [0.2, 0.5], terrain: [mud]}", ""),
    ):
        assert axes(tmp_path, text, more).sha256() != base.sha256()
    longer = dataclasses.replace(base, scenario=dataclasses.replace(base.scenario, duration_s=59.0))
    assert longer.sha256() != base.sha256()


def test_chunks_cover_every_run_once_and_hang_on_the_sweep_alone(tmp_path: Path) -> None:
    for count in (1, 7, 8, 100, 5000):
        sweep = axes(tmp_path, "{friction: {from: 0.1, to: 1.0}}", f"random: {count}")
        assert [run for chunk in sweep.chunks() for run in chunk] == list(range(count))
        assert all(len(chunk) % 8 == 0 for chunk in sweep.chunks()[:-1])


def test_scaled_speeds_scale_the_whole_twist() -> None:
    t_s = np.linspace(0.0, 300.0, 200)
    scenario = load_scenario("paper_profile")
    np.testing.assert_allclose(
        at_speed(scenario, 0.5).commanded(t_s), 0.5 * scenario.commanded(t_s), atol=1e-15
    )
    assert top_speed_mps(scenario) == pytest.approx(scenario.commanded(t_s)[:, 0].max(), abs=1e-3)
    backwards = (DriveSegment(5.0, 0.5, v_amplitude_mps=0.2, period_s=2.0), DriveSegment(5.0, -1.5))
    assert top_speed_mps(dataclasses.replace(scenario, drive=backwards)) == pytest.approx(0.7)
    waypoints = load_scenario("waypoints")
    assert top_speed_mps(at_speed(waypoints, 0.5)) == 0.5 * waypoints.waypoint_speed_mps


def test_a_given_speed_becomes_the_scenarios_fastest(tmp_path: Path) -> None:
    sweep = written(tmp_path, "scenario: paper_profile\naxes: {speed_mps: [0.5, 1.2]}\n")
    tops = [top_speed_mps(at_speed(sweep.scenario, sweep.speed_scale(case))) for case in sweep.cases()]
    assert tops == pytest.approx([0.5, 1.2], abs=1e-12)
