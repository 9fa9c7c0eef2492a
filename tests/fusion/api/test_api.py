"""The public names: quick to import, typed by what they return, short to show."""

from __future__ import annotations

import subprocess
import sys
from importlib import metadata
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import terrafusion as tf
from terrafusion.datasets.writers.log_folder import write_log_folder
from terrafusion.fusion.benchmark.outage_plan import until


@pytest.fixture(scope="module")
def log() -> tf.Recording:
    return until(tf.simulate("straight", terrain="grass", seed=1), 35.0)


@pytest.fixture(scope="module")
def result(log: tf.Recording) -> tf.Replay:
    return tf.replay(log, vehicle="elevate", outages=[(20, 10)])


def test_every_public_name_is_there() -> None:
    for name in tf.__all__:
        assert getattr(tf, name) is not None
    assert tf.__version__ == metadata.version("terrafusion")
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        tf.nothing  # noqa: B018


def test_importing_loads_nothing_heavy() -> None:
    code = (
        "import sys, time; before = time.perf_counter(); import terrafusion;"
        "took = time.perf_counter() - before;"
        "heavy = ('numpy', 'gtsam', 'casadi', 'pandas', 'scipy', 'matplotlib');"
        "print([m for m in heavy if m in sys.modules], took)"
    )
    loaded, took = (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        .stdout.strip()
        .rsplit(" ", 1)
    )
    assert loaded == "[]"
    assert float(took) < 0.5  # 0.02 s when measured alone; the bound leaves room for a busy machine


def test_a_replay_has_metrics_estimate_and_report(result: tf.Replay, tmp_path: Path) -> None:
    assert result.metrics["mode"] == "adaptive"
    page = result.report(tmp_path / "out")
    assert page.is_file()
    assert {p.name for p in (tmp_path / "out").iterdir()} >= {
        "metrics.json",
        "estimate.csv",
        "trajectory.tum",
    }
    table = result.estimate.to_pandas()
    assert len(table) == len(result.estimate.trajectory)
    assert np.array_equal(table["x_m"], result.estimate.trajectory.position_m[:, 0])
    file = pd.read_csv(page.with_name("estimate.csv"), index_col="t_ns")
    known = [name for name in file if file[name].notna().any()]
    assert set(known) <= set(table)
    for name in known:
        if file[name].dtype.kind in "if":
            np.testing.assert_allclose(table[name].astype(float), file[name], rtol=1e-5, atol=1e-6)
        else:
            assert list(table[name]) == list(file[name])


def test_a_log_may_be_a_path_and_a_vehicle_an_object(
    log: tf.Recording, result: tf.Replay, tmp_path: Path
) -> None:
    folder = write_log_folder(log, tmp_path / "log")
    again = tf.replay(str(folder), vehicle=tf.Vehicle.load("elevate"), outages=[(20, 10)])
    assert again.scores.ate_m == result.scores.ate_m


def test_what_is_shown_is_short(log: tf.Recording, result: tf.Replay) -> None:
    for shown in (log, result, result.estimate, result.vehicle):
        assert 1 <= len(repr(shown).splitlines()) <= 12
        assert "<" in shown._repr_html_()
    fit = tf.calibrate(log, parameters="vehicle.wheel.radius_m")
    config = tf.Estimator.for_vehicle("elevate").config
    assert "sensors: imu six_axis, sides, gnss" in repr(config)
    for plain in (log.imu, log.wheels, log.gnss, log.truth, fit, config, tf.policy.load(), result.scores):
        assert 1 <= len(repr(plain).splitlines()) <= 12
        assert len(repr(plain)) < 600


def test_a_live_state_is_one_line(log: tf.Recording) -> None:
    estimator = tf.Estimator.for_vehicle("elevate")
    assert "no data that allow a start" in repr(estimator)
    for message in log.messages():
        estimator.add(message)
        if (state := estimator.latest()) is not None:
            break
    assert state is not None
    assert len(repr(state).splitlines()) == 1
    assert f"State at {state.t_ns} ns: {state.status}, position (" in repr(state)
    lines = repr(estimator).splitlines()
    assert lines[0] == f"Estimator (elevate, adaptive): {state.status}"
    assert lines[-1].strip() == repr(state)
    assert len(lines) <= 12
    assert "(elevate, adaptive)" in estimator._repr_html_()


def test_an_effect_may_be_named_alone() -> None:
    bare = tf.simulate("straight", effects={"slope": 0.05})
    full = tf.simulate("straight", effects={"slope/uniform": 0.05})
    assert bare.wheels is not None
    assert full.wheels is not None
    assert np.array_equal(bare.wheels.speed, full.wheels.speed)


def test_a_diagnosis_says_and_writes_its_answer(tmp_path: Path) -> None:
    references = [until(tf.simulate("circle", seed=seed), 45.0) for seed in range(3)]
    run = until(tf.simulate("circle", seed=9, effects={"slope": 0.05}), 45.0)
    answer = tf.diagnose(run, references=references, vehicle="elevate", effects=["slope", "mass"])
    assert answer.detected
    assert "slope" in answer.summary()
    assert len(repr(answer).splitlines()) <= 12
    assert answer.report(tmp_path).is_file()


def test_a_sweep_is_a_table(tmp_path: Path) -> None:
    plan = tmp_path / "tiny.yaml"
    plan.write_text("scenario: straight\nvehicle: elevate\naxes:\n  terrain: [asphalt, mud]\n")
    table = tf.sweep(plan, tmp_path / "out")
    assert len(table) == 2
