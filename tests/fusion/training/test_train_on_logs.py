"""A terrain model of one robot from its labelled logs, and what the estimator makes of it."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import terrafusion as tf
from terrafusion.datasets.core.errors import ConfigError, DataError, TerrafusionError
from terrafusion.datasets.writers.log_folder import write_log_folder
from terrafusion.fusion.benchmark.outage_plan import until
from terrafusion.fusion.cli import main, terrain
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.terrain.classifier import TerrainModel, load_terrain_model
from terrafusion.fusion.terrain.detector import TerrainDetector
from terrafusion.fusion.terrain.features import Window
from terrafusion.fusion.training import logged_runs
from terrafusion.fusion.training.detector_scores import changes_in
from terrafusion.fusion.training.logged_runs import LoggedRun
from terrafusion.fusion.training.train_detector import write_model
from terrafusion.fusion.training.train_on_logs import (
    assign_folds,
    check_runs,
    cross_validated,
    pieces,
    scores_on,
    train_on,
)
from terrafusion.twin.model.vehicle import as_vehicle

SHAKES = {"gravel": 1.0, "lawn": 0.35, "pavement": 0.12}


def made_run(grounds: Sequence[str], seed: int, windows: int = 60) -> LoggedRun:
    """So many windows on each ground in turn, which shakes as much as it does; without fixes."""
    rng, made, labels = np.random.default_rng(seed), list[Window](), list[str]()
    for ground in grounds:
        for _ in range(windows):
            speed, shake = rng.uniform(0.4, 0.9), SHAKES[ground] * rng.uniform(0.9, 1.1)
            samples = shake * np.sqrt(speed) * rng.normal(size=(100, 6))
            made.append(
                Window(
                    dt_s=0.5, imu_t_s=np.arange(100) / 100.0, gyro_radps=0.2 * samples[:, :3],
                    accel_mps2=samples[:, 3:], wheel_speed_mps=speed, wheel_speed_rate_mps2=0.0,
                    speed_mps=speed, yaw_rate_wheels_radps=None, yaw_rate_gyro_radps=0.0,
                )
            )  # fmt: skip
        labels += [ground] * windows
    return LoggedRun(f"{'-'.join(grounds)}/{seed}", "husky", changes_in(made, np.array(labels)))


@pytest.fixture(scope="module")
def runs() -> list[LoggedRun]:
    return [made_run([ground], 10 * i + n) for i, ground in enumerate(SHAKES) for n in range(6)]


@pytest.fixture(scope="module")
def model(runs: list[LoggedRun]) -> TerrainModel:
    return train_on([run for run in runs if not run.name.endswith("5")], {"day/log": "00"}, "a test")


def test_held_out_runs_are_told_apart(model: TerrainModel, runs: list[LoggedRun]) -> None:
    assert tuple(model.classes) == tuple(sorted(SHAKES))
    assert model.vehicles == ("husky",)
    assert scores_on(model, [run for run in runs if run.name.endswith("5")]).macro_f1 > 0.95
    scores, spliced = cross_validated(runs)
    assert scores.windows == sum(len(run.route.windows) for run in runs)
    assert scores.macro_f1 > 0.95
    assert math.isnan(scores.switches_in_time), "each run is on one ground"
    assert spliced is not None
    assert spliced.switches_in_time > 0.9
    fewer = train_on([run for run in runs if not run.name.startswith("lawn")], {})
    with pytest.raises(DataError, match="does not know lawn"):
        scores_on(fewer, runs)


def test_slip_that_the_logs_do_not_show_tells_nothing(model: TerrainModel) -> None:
    """It is seen where there are fixes, and then favours no ground."""
    slip = [(float(m.mean[0, 5]), float(m.covariance[0, 5, 5])) for m in model.classes.values()]
    assert slip == [pytest.approx(slip[0])] * len(slip)
    assert slip[0][1] > 0.5


def test_a_run_whose_ground_looks_like_another_leaves_doubt(runs: list[LoggedRun]) -> None:
    """One lawn in three shakes like pavement: no posterior is surer than that."""
    deceiving = [
        dataclasses.replace(run, route=changes_in(run.route.windows, np.full(len(run.route.labels), "lawn")))
        for run in (made_run(["pavement"], 70 + n) for n in range(3))
    ]
    assert train_on(runs, {}).doubt <= 0.02
    doubting = train_on([*runs, *deceiving], {})
    assert doubting.doubt >= 0.05
    detector = TerrainDetector(doubting, (*doubting.classes, "unknown"))
    for window in made_run(["gravel"], 90).route.windows:
        sure = float(detector.update(window).max())
    assert sure <= 1.0 - 0.75 * doubting.doubt


def test_the_vehicle_tells_how_the_logs_are_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its topics, the mounting of its IMU and the sigmas of its receiver."""
    rigs, read = list[object](), list[int]()

    def opened(log: str, *, rig: object = None) -> list[tf.Recording]:
        rigs.append(rig)
        return []

    monkeypatch.setattr(logged_runs, "open_recordings", opened)
    with pytest.raises(DataError, match="does not move"):
        logged_runs.open_runs(["monday", "tuesday"], "husky", lambda: read.append(1))
    assert rigs == [as_vehicle("husky").rig()] * 2
    assert len(read) == 2


def test_a_run_over_several_grounds_counts_for_each() -> None:
    run = made_run(["lawn", "gravel"], 3, windows=5)
    assert [(len(windows), ground) for windows, ground in pieces(run)] == [(5, "lawn"), (5, "gravel")]


def test_the_runs_of_each_ground_are_spread_over_the_folds(runs: list[LoggedRun]) -> None:
    fold_of = assign_folds(runs, 3)
    for ground in SHAKES:
        assert sorted(f for run, f in zip(runs, fold_of, strict=True) if ground in run.grounds()) == [
            0, 0, 1, 1, 2, 2,
        ]  # fmt: skip


def test_too_few_runs_or_grounds_are_refused_by_name(runs: list[LoggedRun]) -> None:
    with pytest.raises(DataError, match="ground 'pavement' has 1 run, 2 are needed"):
        check_runs(runs[:13])
    with pytest.raises(DataError, match="at least two grounds"):
        train_on(runs[:6], {})


@pytest.mark.parametrize(
    "drives",
    [
        [("gravel lawn", 120), ("gravel", 180), ("gravel lawn", 90)],
        [("gravel lawn", 120), ("gravel pavement", 119), ("gravel lawn", 118), ("gravel pavement", 117)],
    ],
)
def test_runs_over_several_grounds_are_halved_so_that_both_know_each(drives: list[tuple[str, int]]) -> None:
    runs = [made_run(words.split(), n, windows) for n, (words, windows) in enumerate(drives)]
    halves = [set[str](), set[str]()]
    for run, half in zip(runs, assign_folds(runs, 2), strict=True):
        halves[half] |= run.grounds()
    assert halves[0] == halves[1]
    assert tuple(train_on(runs, {}).classes) == tuple(sorted(halves[0]))


def test_runs_that_cannot_be_halved_are_refused() -> None:
    drives = (("gravel pavement", 65), ("gravel lawn", 64), ("gravel", 100), ("gravel lawn pavement", 33))
    with pytest.raises(DataError, match="no two halves of the runs both have lawn"):
        train_on([made_run(words.split(), 0, windows) for words, windows in drives], {})
    short = [
        made_run([ground], n, windows) for n in (120, 8) for ground, windows in (("gravel", n), ("lawn", n))
    ]
    with pytest.raises(DataError, match="half of the runs lack two grounds"):
        train_on(short, {})
    two = [made_run([ground], n) for ground in ("gravel", "lawn") for n in range(2)]
    with pytest.raises(DataError, match="ground 'gravel' has 2 runs, 3 are needed"):
        cross_validated(two)


def test_names_of_one_ground_and_logs_given_twice_are_refused(tmp_path: Path) -> None:
    runs = [made_run(["lawn"], 0), made_run(["gravel"], 1)]
    spelt = [
        dataclasses.replace(run, route=changes_in(run.route.windows, np.full(60, "Lawn "))) for run in runs
    ]
    with pytest.raises(DataError, match="'Lawn ' and 'lawn' differ in spelling alone"):
        check_runs([*runs, *spelt])
    for name in ("monday", "copy"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "meta.yaml").write_text("start_ns: 0\nterrain: lawn\n")
    with pytest.raises(TerrafusionError, match=r"copy: is the same log as .*monday"):
        terrain.inputs_of([str(tmp_path / "monday"), str(tmp_path / "copy")])


def test_written_and_read_back(model: TerrainModel, tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_model(model, tmp_path / f"{name}.yaml")
    assert (tmp_path / "a.yaml").read_bytes() == (tmp_path / "b.yaml").read_bytes()
    again = load_terrain_model(tmp_path / "a.yaml")
    assert (again.inputs, again.made_by, again.vehicles) == ({"day/log": "00"}, "a test", ("husky",))
    for name, mixture in model.classes.items():
        assert again.classes[name].mean == pytest.approx(mixture.mean, rel=1e-5)


def test_grounds_that_the_policy_does_not_know_have_the_pooled_noise(model: TerrainModel) -> None:
    config = EstimatorConfig(as_vehicle("husky").rig(), "husky", terrain_model=model)
    estimator = Estimator(config)
    assert set(SHAKES) < set(estimator.weights.posterior())
    assert config.policy.classes["lawn"] == config.policy.fixed
    assert estimator.weights.learned_grounds() is None, "the model knows the robot"
    again = Estimator.restore(config, estimator.dump())
    assert again.weights.posterior() == estimator.weights.posterior()
    with pytest.raises(ConfigError, match="of another configuration"):
        Estimator.restore(EstimatorConfig(config.rig, "husky"), estimator.dump())


def test_a_model_of_another_robot_is_refused(model: TerrainModel) -> None:
    with pytest.raises(ConfigError, match="is of husky, the vehicle is warthog"):
        EstimatorConfig(as_vehicle("warthog").rig(), "warthog", terrain_model=model)


@pytest.mark.usefixtures("no_report")
def test_labelled_logs_to_a_model_that_replay_and_live_use(tmp_path: Path) -> None:
    """A robot that the shipped model does not know, on ground of which that says `unknown`."""
    logs = []
    for ground in ("asphalt", "loose_sand"):
        for seed in range(3):
            run = tf.simulate("figure_eight", vehicle="husky", terrain=ground, seed=seed)
            logs.append(str(write_log_folder(until(run, 70.0), tmp_path / f"{ground}-{seed}")))
    held, out = [logs.pop(5), logs.pop(2)], tmp_path / "grounds.yaml"
    result = CliRunner().invoke(terrain.app, ["train", "--out", str(out), *logs])
    assert result.exit_code == 0, result.output
    figures = tmp_path / "figures.json"
    result = CliRunner().invoke(terrain.app, ["eval", "--model", str(out), "--out", str(figures), *held])
    assert result.exit_code == 0, result.output
    assert json.loads(figures.read_text())["macro_f1"] > 0.9
    seen = CliRunner().invoke(terrain.app, ["eval", "--model", str(out), held[0], logs[0]])
    assert "was trained on 1 of these logs" in str(seen.exception)
    assert tf.replay(held[1], terrain_model=out).metrics["terrain"]["asphalt"] > 0.8
    words = [held[0], "--terrain-model", str(out), "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(main.app, ["replay", *words])
    assert result.exit_code == 0, result.output
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["terrain"]["loose_sand"] > 0.8
    result = CliRunner().invoke(main.app, ["live", *words[:3]])
    assert result.exit_code == 0, result.output
    result = CliRunner().invoke(main.app, ["replay", *words, "--vehicle", "warthog"])
    assert "the terrain model is of husky, the vehicle is warthog" in f"{result.exception} {result.output}"
