"""The random ground has the sigma, the correlation and the share it was asked for, and the robot feels it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.twin.model.ground import SoilPatches, Variation, gaussian_field, soil_field, value_at
from terrafusion.twin.model.plant import SoilField
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vectors import soil_vector
from terrafusion.twin.physics.layout import INDEX, SOIL_PARAMETERS
from terrafusion.twin.scenario.file import load_scenario
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate_run

CELLS, CELL_M, LENGTH_M = 128, 0.25, 1.5
STRAIGHT = Scenario(
    "field", 12.0, drive=(DriveSegment(2.0), DriveSegment(10.0, v_mps=1.0)), route=(RouteLeg("loose_sand"),)
)
PATCHY = dataclasses.replace(
    STRAIGHT, variation=Variation(0.3, 1.0), patches=SoilPatches("asphalt", 0.3, 1.5)
)  # fmt: skip


def fields(count: int = 60) -> np.ndarray:
    return np.stack(
        [gaussian_field(CELLS, CELL_M, LENGTH_M, np.random.default_rng(seed)) for seed in range(count)]
    )


def drawn(variation: Variation | None, patches: SoilPatches | None, seed: int) -> SoilField:
    """The field of a seed, with mud in the patches."""
    field = soil_field(variation, patches, soil_vector(load_soil("mud")), seed)
    assert field is not None
    return field


def within(samples: np.ndarray, expected: float) -> bool:
    """Whether `expected` lies in the mean's interval of 4 standard errors over independent fields."""
    return abs(samples.mean() - expected) < 4.0 * samples.std(ddof=1) / np.sqrt(len(samples))


def test_the_field_has_zero_mean_unit_sigma_and_the_correlation_asked_for() -> None:
    unit = fields()
    assert within(unit.mean(axis=(1, 2)), 0.0)
    assert within((unit**2).mean(axis=(1, 2)), 1.0)
    assert unit.var() == pytest.approx(1.0, abs=0.03)
    for lag in (1, 3, 6, 12):
        for axis in (1, 2):
            product = (unit * np.roll(unit, lag, axis=axis)).mean(axis=(1, 2))
            assert within(product, np.exp(-((lag * CELL_M / LENGTH_M) ** 2)))
    kurtosis = (unit**4).mean() / (unit**2).mean() ** 2
    assert kurtosis == pytest.approx(3.0, abs=0.15)


def test_the_field_has_no_border() -> None:
    """The step across the seam is like any other step: the grid repeats."""
    unit = fields(20)
    seam = ((unit[:, 0] - unit[:, -1]) ** 2).mean()
    inside = ((unit[:, 1:] - unit[:, :-1]) ** 2).mean()
    assert seam == pytest.approx(inside, rel=0.2)


@pytest.mark.parametrize("shift", [(1, 0), (0, 1), (-3, 2)])
def test_values_repeat_with_the_grid_and_meet_it_at_its_points(shift) -> None:
    rng = np.random.default_rng(5)
    grid = rng.normal(size=(6, 9))
    x, y = rng.uniform(-5, 5, 200), rng.uniform(-5, 5, 200)
    there = value_at(grid, 0.4, x + shift[0] * 9 * 0.4, y + shift[1] * 6 * 0.4)
    np.testing.assert_allclose(there, value_at(grid, 0.4, x, y), atol=1e-9)
    rows, columns = np.meshgrid(np.arange(6.0), np.arange(9.0), indexing="ij")
    at_points = value_at(grid, 0.5, 0.5 * columns.ravel(), 0.5 * rows.ravel())
    np.testing.assert_allclose(at_points, grid.ravel(), atol=1e-12)


@pytest.mark.parametrize("sigma", [0.1, 0.4])
def test_strength_has_its_sigma_about_the_soils_own_mean(sigma) -> None:
    logs = np.stack([drawn(Variation(sigma, 2.0), None, seed).log_gain for seed in range(20)])
    assert within(logs.std(axis=(1, 2)), sigma)
    assert within(np.exp(logs).mean(axis=(1, 2)), 1.0)


@pytest.mark.parametrize("share", [0.05, 0.3, 0.8])
def test_patches_cover_their_share(share) -> None:
    """On the grid by construction; where wheels go, at any point of the plane, within its interval."""
    rng = np.random.default_rng(1)
    met = []
    for seed in range(20):
        field = drawn(None, SoilPatches("mud", share, 1.0), seed)
        assert (field.patch_share > 0.5).mean() == pytest.approx(share, abs=1e-4)
        assert field.patch_share.min() >= 0.0
        assert field.patch_share.max() <= 1.0
        x, y = rng.uniform(-200, 200, (2, 4000))
        met.append((value_at(field.patch_share, field.cell_m, x, y) > 0.5).mean())
    assert within(np.array(met), share)


@pytest.mark.parametrize(("share", "everywhere"), [(0.0, 0.0), (1.0, 1.0)])
def test_no_patches_and_nothing_but_patches(share, everywhere) -> None:
    field = drawn(None, SoilPatches("mud", share, 1.0), 0)
    assert (field.patch_share == everywhere).all()


def test_same_seed_same_bits_and_each_part_its_own_stream() -> None:
    patches = SoilPatches("mud", 0.3, 1.0)
    one, again, other = (drawn(Variation(0.2, 1.0), patches, seed) for seed in (7, 7, 8))
    stronger = drawn(Variation(0.4, 1.0), patches, 7)
    np.testing.assert_array_equal(one.log_gain, again.log_gain)
    np.testing.assert_array_equal(one.patch_share, again.patch_share)
    np.testing.assert_array_equal(one.patch_share, stronger.patch_share)
    assert np.abs(np.corrcoef(one.log_gain.ravel(), one.patch_share.ravel())[0, 1]) < 0.1
    assert np.abs(np.corrcoef(one.log_gain.ravel(), other.log_gain.ravel())[0, 1]) < 0.1


def test_even_ground_is_no_field() -> None:
    assert soil_field(None, None, None, 0) is None
    response = drawn(Variation(0.2, 1.0), None, 0).response
    follows = {name for name, r in zip(SOIL_PARAMETERS, response, strict=True) if r != 0.0}
    assert follows == {"k_c", "k_phi", "cohesion_pa", "tan_friction", "friction_cap"}


def test_lengths_too_far_apart_are_reported() -> None:
    with pytest.raises(ConfigError, match=r"0.1 and 50 m do not fit one grid; keep them within"):
        soil_field(Variation(0.2, 0.1), SoilPatches("mud", 0.3, 50.0), None, 0)


def test_symmetric_ground_gives_no_yaw_and_patchy_ground_does() -> None:
    assert np.abs(simulate_run(STRAIGHT, noiseless=True).states[:, INDEX["yaw"]]).max() < 1e-9
    uniform = dataclasses.replace(
        PATCHY, variation=Variation(0.0, 1.0), patches=SoilPatches("asphalt", 1.0, 1.0)
    )
    assert np.abs(simulate_run(uniform, noiseless=True).states[:, INDEX["yaw"]]).max() < 1e-9
    yaws = np.array([simulate_run(PATCHY, noiseless=True, seed=s).states[:, INDEX["yaw"]] for s in range(4)])
    assert np.abs(yaws).max(axis=1).min() > 1e-2
    assert np.std(yaws[:, -1]) > 1e-2


def test_a_run_on_patchy_ground_repeats_with_its_seed() -> None:
    a, b, c = (simulate_run(PATCHY, seed=seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(a.states, b.states)
    assert not np.array_equal(a.states, c.states)


def test_labels_follow_the_patches_under_the_body() -> None:
    run = simulate_run(PATCHY, noiseless=True, seed=1)
    terrain = run.recording.terrain
    assert terrain is not None
    assert set(terrain.label) == {"loose_sand", "asphalt"}
    assert run.recording.terrain_name == "mixed"
    # asphalt slips less than loose sand: the labels know where the robot is
    t_s = (terrain.t_ns - run.recording.start_ns) / 1e9
    moving = t_s > 4.0
    slip = np.interp(t_s, run.t_s, np.abs(run.slip).mean(axis=1))
    patch = terrain.label == "asphalt"
    assert slip[moving & patch].mean() < slip[moving & ~patch].mean()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("variation: {strength_sigma: 0.2}", r"'variation.length_m' is missing"),
        ("variation: {strength_sigma: 3, length_m: 1}", r"'variation.strength_sigma' is 3, out of range"),
        ("variation: 0.2", r"'variation' is '0.2'"),
        ("patches: {terrain: mud, share: 1.5, length_m: 1}", r"'patches.share' is 1.5, out of range"),
        ("patches: {share: 0.5, length_m: 1}", r"'patches.terrain' is missing"),
        ("patches: {terrain: [1], share: 0.5, length_m: 1}", r"'patches.terrain' is '\[1\]'"),
        ("patches: {terrain: custard, share: 0.5, length_m: 1}", r"unknown terrain 'custard'"),
        ("patches: {terrain: mud, share: 0.5, length_m: 1, size: 2}", r"unknown key 'patches.size'"),
    ],
)
def test_a_wrong_field_is_reported_by_key(tmp_path, text, message) -> None:
    path = tmp_path / "s.yaml"
    path.write_text(f"drive: [{{duration_s: 5}}]\n{text}\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=message):
        simulate_run(load_scenario(path))
