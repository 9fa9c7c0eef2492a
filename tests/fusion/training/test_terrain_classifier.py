"""Class densities, their fit, and the file they are kept in."""

from __future__ import annotations

import copy
import functools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.fusion.terrain.classifier import (
    UNKNOWN,
    LikelihoodTable,
    TerrainModel,
    load_terrain_model,
)
from terrafusion.fusion.terrain.detector import TerrainDetector
from terrafusion.fusion.terrain.features import FEATURES, SLIP, YAW_SLIP
from terrafusion.fusion.terrain.sequence import PatchFilter
from terrafusion.fusion.training.mixture import fit, fit_best, shrink
from terrafusion.fusion.training.simulated_runs import Grid
from terrafusion.fusion.training.train_detector import TrainingPlan, fingerprint_of, write_model

D = len(FEATURES)
CLASSES = ("asphalt", "medium_sand", "loose_sand", "mud", "unknown")


@functools.cache
def shipped() -> TerrainModel:
    return load_terrain_model()


@pytest.fixture(scope="module")
def model() -> TerrainModel:
    return shipped()


def posterior(model: TerrainModel, values: Any, variances: Any = None) -> Any:
    log_p = LikelihoodTable(model, CLASSES).evaluate(values, np.zeros(D) if variances is None else variances)
    weights = np.exp(log_p - log_p.max())
    return weights / weights.sum()


def test_the_shipped_model_is_of_the_present_parameter_files(model: TerrainModel) -> None:
    # If this fails, a soil, scenario or vehicle changed: run `terrafusion terrain train --out ...` again.
    seeds = int(model.made_by.rsplit(" ", 1)[1])
    assert model.inputs_sha256 == fingerprint_of(TrainingPlan(seeds=seeds))
    assert Grid(("staircase",), (0.0,), (0.0,), (0,)).fingerprint() != model.inputs_sha256


def test_far_from_every_ground_is_unknown(model: TerrainModel) -> None:
    centre = np.mean([m.mean[0] for m in model.classes.values()], axis=0)
    for feature in range(SLIP):
        for step in (-2.0, 2.0):
            odd = centre.copy()
            odd[feature] += step
            assert CLASSES[int(posterior(model, odd).argmax())] == "unknown"


def test_every_class_claims_its_own_centre(model: TerrainModel) -> None:
    for name, mixture in model.classes.items():
        heaviest = mixture.mean[int(mixture.log_weight.argmax())]
        assert CLASSES[int(posterior(model, heaviest).argmax())] == name


def test_a_missing_feature_is_integrated_out(model: TerrainModel) -> None:
    values = model.classes["loose_sand"].mean[0] + 0.05
    partial = values.copy()
    partial[SLIP] = np.nan
    table = LikelihoodTable(model, CLASSES)
    got = table.evaluate(partial, np.zeros(D)) * model.temperature
    grid = np.linspace(-12.0, 12.0, 60001)
    total = np.zeros(len(CLASSES))
    for slip in grid[:: len(grid) // 6000]:
        values[SLIP] = slip
        total += np.exp(table.evaluate(values, np.zeros(D)) * model.temperature)
    step = grid[len(grid) // 6000] - grid[0]
    expected = np.log(total * step / np.sqrt(2.0 * np.pi))
    assert got == pytest.approx(expected, abs=1e-3)
    assert np.array_equal(table.evaluate(np.full(D, np.nan), np.zeros(D)), np.zeros(len(CLASSES)))


@given(st.floats(0.0, 3.0))
def test_an_uncertain_slip_says_less(extra: float) -> None:
    model = shipped()
    slip_only = np.full(D, np.nan)
    slip_only[SLIP] = 0.5
    sure, vague = np.full(D, 0.04**2), np.full(D, (0.04 + extra) ** 2)
    assert posterior(model, slip_only, vague).max() <= posterior(model, slip_only, sure).max() + 0.05
    assert posterior(model, slip_only, np.full(D, 1e4)).max() < 0.3


def test_grounds_without_a_density_neither_replace_unknown_nor_crowd_out_known_ones(
    model: TerrainModel,
) -> None:
    """As of a policy fitted to logs of another ground, or of a model of one's own grounds."""
    known = (*model.classes, UNKNOWN)
    for strange in (["moss"], ["moss", "lava", "ash"]):
        detector, alone = (TerrainDetector(model, names) for names in ((*strange, *known), known))
        p = dict(zip(detector.classes, detector.probabilities.tolist(), strict=True))
        assert p["moss"] < 0.6 * p[UNKNOWN]
        assert [p[name] for name in model.classes] == pytest.approx(alone.probabilities[:-1])
        assert sum(p.values()) == pytest.approx(1.0)


def test_a_foreign_robot_is_judged_by_its_slip_alone(model: TerrainModel) -> None:
    assert model.for_vehicle("elevate") is model
    foreign = model.for_vehicle("warthog")
    values = model.classes["mud"].mean[0].copy()
    quiet, shaken = values.copy(), values.copy()
    shaken[:SLIP] += 0.7
    shaken[YAW_SLIP] = 0.0
    assert np.array_equal(posterior(foreign, quiet), posterior(foreign, shaken))


@pytest.mark.parametrize(("slip", "named"), [(0.0, "unknown"), (-0.06, "unknown"), (0.2, "loose_sand")])
def test_a_foreign_robot_that_grips_is_on_unknown_ground(
    model: TerrainModel, slip: float, named: str
) -> None:
    foreign = model.for_vehicle(None)
    table, patches = LikelihoodTable(foreign, CLASSES), PatchFilter(5, 25.0, foreign.prior(CLASSES))
    values = np.full(D, np.nan)
    values[SLIP] = slip
    for _ in range(100):
        patches.predict(0.5)
        p = patches.update(table.evaluate(values, np.full(D, 0.02**2)))
    assert CLASSES[int(p.argmax())] == named
    assert p.max() > 0.8
    assert table.evaluate(np.zeros(D) * np.nan, np.zeros(D)).tolist() == [0.0] * 5


def test_em_finds_two_grounds_through_gaps() -> None:
    rng = np.random.default_rng(0)
    a = rng.multivariate_normal([0.0, 0.0, 0.0], [[1.0, 0.8, 0.0], [0.8, 1.0, 0.0], [0.0, 0.0, 0.1]], 3000)
    b = rng.multivariate_normal([4.0, 0.0, 3.0], np.diag([0.2, 0.2, 0.5]), 1000)
    x = np.vstack([a, b])
    x[rng.random(x.shape) < 0.2] = np.nan
    x = x[np.isfinite(x).any(axis=1)]
    mixture = fit_best(x, np.full(3, 0.01), 0)
    order = np.argsort(mixture.mean[:, 0])
    assert len(order) == 2
    assert np.exp(mixture.log_weight[order]) == pytest.approx([0.75, 0.25], abs=0.03)
    assert mixture.mean[order] == pytest.approx(np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 3.0]]), abs=0.1)
    assert mixture.covariance[order[0]][0, 1] == pytest.approx(0.8, abs=0.1)


def test_em_of_one_gaussian_without_gaps_is_the_sample_moments() -> None:
    x = np.random.default_rng(1).normal(size=(500, 3)) @ np.diag([1.0, 2.0, 0.5])
    mixture, _ = fit(x, 1, np.zeros(3), 0)
    assert mixture.mean[0] == pytest.approx(x.mean(axis=0), abs=1e-9)
    assert np.diag(mixture.covariance[0]) == pytest.approx(x.var(axis=0), rel=1e-6)


@given(st.integers(4, 10000), st.integers(0, 1000))
def test_shrinkage_keeps_variances_and_definiteness(samples: int, seed: int) -> None:
    x = np.random.default_rng(seed).normal(size=(4, 6))
    shrunk = shrink(np.cov(x.T) + 1e-9 * np.eye(6), samples)
    assert np.diag(shrunk) == pytest.approx(x.var(axis=0, ddof=1), rel=1e-5)
    assert np.linalg.eigvalsh(shrunk).min() > 0.0


def test_written_and_read_back(model: TerrainModel, tmp_path: Path) -> None:
    write_model(model, tmp_path / "a.yaml")
    again = load_terrain_model(tmp_path / "a.yaml")
    write_model(again, tmp_path / "b.yaml")
    assert (tmp_path / "a.yaml").read_bytes() == (tmp_path / "b.yaml").read_bytes()
    assert np.array_equal(again.classes["mud"].covariance, model.classes["mud"].covariance)


BROKEN = [
    (["schema"], "terrafusion.terrain/9", "terrafusion.terrain/1"),
    (["colour"], "red", "unknown key 'colour'"),
    (["temperature"], None, "'temperature' is missing"),
    (["temperature"], 0.1, "'temperature' is 0.1"),
    (["patch_length_m"], "far", "patch_length_m"),
    (["features"], ["z_low"], "'features'"),
    (["classes"], {}, "'classes'"),
    (["classes", "unknown"], [], "without 'unknown'"),
    (["classes", "mud"], [], "classes.mud"),
    (["classes", "mud", 0, "mean"], [1.0], "classes.mud"),
    (["classes", "mud", 0, "mean"], ["x"] * D, f"give {D} numbers"),
    (["classes", "mud", 0, "extra"], 1, "classes.mud"),
    (["classes", "mud", 0, "weight"], -1.0, "'classes.mud[0].weight' is -1.0, out of range"),
    (["unknown", 0, "covariance"], np.zeros((D, D)).tolist(), "positive definite"),
    (["unknown", 0, "covariance"], [[float("nan")] * D] * D, "unknown[0].covariance"),
]


@pytest.fixture(scope="module")
def content(model: TerrainModel, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    from terrafusion.datasets.core.yaml_file import read_yaml

    path = tmp_path_factory.mktemp("model") / "model.yaml"
    write_model(model, path)
    return read_yaml(path)


@pytest.mark.parametrize(("where", "value", "words"), BROKEN)
def test_a_wrong_file_is_refused_in_lines_that_name_file_and_key(
    content: dict[str, Any], tmp_path: Path, where: list[Any], value: Any, words: str
) -> None:
    from ruamel.yaml import YAML

    broken = copy.deepcopy(content)
    inner: Any = broken
    for key in where[:-1]:
        inner = inner[key]
    if value is None:
        del inner[where[-1]]
    else:
        inner[where[-1]] = value
    path = tmp_path / "model.yaml"
    with path.open("w", encoding="utf-8") as out:
        YAML(typ="safe", pure=True).dump(broken, out)
    with pytest.raises(ConfigError) as caught:
        load_terrain_model(path)
    lines = str(caught.value).split("\n")
    assert words in lines[0]
    assert all(line.startswith(f"{path}: '{where[0]}") or words in line for line in lines)
