"""NEES and NIS with bands: against samples whose statistics are known in closed form."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from terrafusion.datasets.core.channels import Terrain
from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.fusion.estimate.estimate import Innovation
from terrafusion.fusion.metrics import consistency as c
from terrafusion.fusion.metrics import pooled_consistency
from terrafusion.fusion.metrics.scores import score
from tests.studies import twin_consistency as twin


def gauss_markov(n: int, a: float, rng: np.random.Generator, columns: int = 2) -> np.ndarray:
    """Stationary, unit variance, autocorrelation a^k."""
    from scipy.signal import lfilter

    noise = rng.normal(size=(n, columns)) * np.sqrt(1.0 - a**2)
    noise[0] = rng.normal(size=columns)
    return np.asarray(lfilter([1.0], [1.0, -a], noise, axis=0))


def series(values: np.ndarray, quantity: str = "position", step_s: float = 0.1) -> c.Whitened:
    return c.Whitened(quantity, (np.arange(len(values)) * step_s * 1e9).astype(np.int64), values)


def everything(whitened: c.Whitened) -> np.ndarray:
    return np.ones(len(whitened.t_ns), dtype=bool)


@pytest.mark.parametrize("degrees", [0.7, 1.0, 2.0, 11.5, 400.0])
def test_the_band_is_the_chi_square_quantiles(degrees):
    from scipy.stats import chi2

    assert c.band(degrees) == pytest.approx(chi2.ppf([0.025, 0.975], degrees) / degrees, rel=1e-9)
    assert c.band(degrees, 0.5) == pytest.approx(chi2.ppf([0.25, 0.75], degrees) / degrees, rel=1e-9)


@given(st.lists(st.booleans(), min_size=1, max_size=60))
def test_pairs_are_counted_exactly(rows):
    mask = np.array(rows)
    by_hand = [int((mask[: len(mask) - k] & mask[k:]).sum()) for k in range(len(mask))]
    assert c.pair_counts(mask).tolist() == by_hand


def test_independent_samples_count_in_full():
    values = np.random.default_rng(0).normal(size=(4000, 2))
    rows = np.ones(4000, dtype=bool)
    assert c.effective_samples(rows, c.squared_correlation(values, rows)) == pytest.approx(4000, rel=0.05)


@pytest.mark.parametrize("a", [0.5, 0.9, 0.98])
def test_a_gauss_markov_error_counts_as_bayley_and_hammersley_say(a):
    """sum of a^(2 |k|) over all lags is (1 + a^2) / (1 - a^2)."""
    n = 40_000
    values = gauss_markov(n, a, np.random.default_rng(3))
    rows = np.ones(n, dtype=bool)
    found = c.effective_samples(rows, c.squared_correlation(values, rows))
    assert found == pytest.approx(n * (1.0 - a**2) / (1.0 + a**2), rel=0.15)


def test_a_constant_error_is_one_sample_however_long_it_lasts():
    row = c.summarise(series(np.full((5000, 2), 0.7)), np.ones(5000, dtype=bool), 0)
    assert row.effective == pytest.approx(1.0)
    assert row.mean == pytest.approx(0.49)
    assert row.verdict() == "consistent"
    assert (row.low, row.high) == pytest.approx(c.band(2.0))


def test_the_band_holds_correlated_drives_as_often_as_it_says():
    """300 consistent drives of 1000 correlated samples: the band of independent ones would hold few."""
    rng = np.random.default_rng(11)
    rows = np.ones(1000, dtype=bool)
    naive = c.band(2000.0)
    inside = inside_naive = 0
    for _ in range(300):
        row = c.summarise(series(gauss_markov(1000, 0.95, rng)), rows, 0)
        inside += row.verdict() == "consistent"
        inside_naive += naive[0] <= row.mean <= naive[1]
    assert 0.88 <= inside / 300 <= 0.99
    assert inside_naive / 300 < 0.5


@pytest.mark.parametrize(("factor", "word"), [(2.0, "overconfident"), (1.0, "consistent"), (0.5, "cautious")])
def test_a_wrong_covariance_is_told(factor, word):
    values = factor * gauss_markov(3000, 0.9, np.random.default_rng(5))
    assert c.summarise(series(values), np.ones(3000, dtype=bool), 0).verdict() == word


def test_whitened_errors_give_the_nees_of_the_errors(drive):
    errors = score(drive(noise_m=0.1, drift_mps=0.01).estimate, drive().recording).errors
    rng = np.random.default_rng(2)
    A = rng.normal(size=(len(errors.t_ns), 2, 2))
    errors = dataclasses.replace(errors, covariance_m2=A @ np.swapaxes(A, 1, 2) + 0.05 * np.eye(2))
    np.testing.assert_allclose(c.position(errors).squares(), errors.nees(), rtol=1e-6)


def test_improper_covariances_are_not_scored(drive):
    errors = score(drive().estimate, drive().recording).errors
    P = errors.covariance_m2.copy()
    P[0], P[1], P[2] = np.nan, np.zeros((2, 2)), np.diag([1.0, -1.0])
    sigma = errors.yaw_sigma_rad.copy()
    sigma[:4] = 0.0
    bad = dataclasses.replace(errors, covariance_m2=P, yaw_sigma_rad=sigma)
    assert c.position(bad).known().tolist()[:4] == [False, False, False, True]
    assert c.heading(bad).known().tolist()[:5] == [False] * 4 + [True]


def test_heading_nees_is_the_squared_error_over_its_variance(drive):
    """The drive's sigma is 0.02 rad; its heading drifts by 1 mrad/s."""
    rows = score(drive(yaw_drift_radps=1e-3).estimate, drive().recording).consistency
    found = next(row for row in rows if row.quantity == "heading" and row.terrain == c.ALL)
    t = np.arange(1201) * 0.1
    assert found.mean == pytest.approx(np.mean((1e-3 * t / 0.02) ** 2), rel=1e-6)


def test_nees_is_told_by_the_true_ground_where_it_is_known(drive):
    """The error jumps by three sigma where the annotated ground changes."""
    d = drive(offset_m=(0.1, 0.1))
    label_ns = d.recording.start_ns + np.array([0, 40], dtype=np.int64) * 10**9
    terrain = Terrain(label_ns, np.array(["gravel", "snow"]))
    path = d.estimate.trajectory
    late = path.t_ns >= label_ns[1]
    moved = dataclasses.replace(path, position_m=path.position_m + 0.2 * late[:, None] * np.array([1, 1, 0]))
    estimate = dataclasses.replace(d.estimate, trajectory=moved)
    rows = score(estimate, dataclasses.replace(d.recording, terrain=terrain)).consistency
    nees = {row.terrain: row.mean for row in rows if row.quantity == "position"}
    assert list(nees) == [c.ALL, "gravel", "snow"]
    assert nees["gravel"] == pytest.approx(1.0)
    assert nees["snow"] == pytest.approx(9.0)


def test_a_detectors_terrain_channel_is_not_taken_for_the_truth(drive):
    d = drive()
    terrain = Terrain(d.recording.truth.t_ns[:1], np.array(["snow"]), source="detector")
    with_channel = dataclasses.replace(d.recording, terrain=terrain)
    t_ns = d.estimate.trajectory.t_ns
    assert set(c.ground_at(with_channel, d.estimate, t_ns)) == {"asphalt", "loose_sand"}
    assert c.ground_at(with_channel, d.estimate, t_ns).tolist() == d.estimate.dominant_terrain().tolist()


def test_windows_cover_the_drive_and_show_when_it_went_wrong(drive):
    d = drive(turn_radps=0.0, offset_m=(0.1, 0.1), drift_mps=0.05, drift_from_s=60.0)
    errors = score(d.estimate, d.recording).errors
    assert errors is not None
    rows = c.over_time(c.position(errors), d.recording.start_ns)
    assert [round(row.start_s) for row in rows] == [0, 20, 40, 60, 80, 100, 120]
    assert sum(row.samples for row in rows) == 1201
    assert [row.mean for row in rows[:3]] == pytest.approx([1.0] * 3)
    assert rows[5].mean > rows[4].mean > rows[3].mean > 1.0


def test_innovations_are_told_by_sensor_and_keep_their_nis():
    rng = np.random.default_rng(4)
    found = [
        Innovation(k * 10**8, "gnss", rng.normal(size=3), float(rng.chisquare(2)), 2, k % 9 > 0)
        for k in range(500)
    ]
    found += [Innovation(k * 10**8, "wheels", np.array([-0.1]), 0.25, 1, True) for k in range(100)]
    gnss, wheels = c.innovations(found)
    assert (gnss.quantity, wheels.quantity) == ("nis gnss", "nis wheels")
    np.testing.assert_allclose(gnss.squares() * 2, [i.nis for i in found[:500]], rtol=1e-12)
    row = c.summarise(gnss, everything(gnss), 0)
    assert row.effective > 450
    assert row.verdict() == "consistent"
    one_sided = c.summarise(wheels, everything(wheels), 0)
    assert one_sided.mean == pytest.approx(0.25)
    assert one_sided.effective == pytest.approx(1.0)


def test_an_innovation_of_size_zero_is_a_nis_of_zero():
    (gnss,) = c.innovations([Innovation(0, "gnss", np.zeros(3), 0.0, 2, True)])
    assert gnss.squares().tolist() == [0.0]


def test_without_reference_only_the_innovations_are_tested(drive):
    d = drive()
    rows = score(d.estimate, dataclasses.replace(d.recording, truth=None)).consistency
    assert {row.quantity for row in rows} == {"nis gnss"}


@given(st.integers(2, 60), st.floats(0.1, 5.0))
@settings(max_examples=30, deadline=None)
def test_the_effective_number_is_between_one_and_the_samples(n, scale):
    values = scale * np.random.default_rng(n).normal(size=(n, 2)).cumsum(axis=0)
    row = c.summarise(series(values), np.ones(n, dtype=bool), 0)
    assert 1.0 <= row.effective <= n
    assert row.low < 1.0 < row.high


def consistency(mean: float, effective: float = 10.0, quantity: str = "position") -> c.Consistency:
    return c.Consistency(quantity, c.ALL, 0.0, 1.0, 100, effective, mean, *c.band(2 * effective))


def test_drives_are_pooled_with_equal_weight():
    (cell,) = pooled_consistency.pool("mud", "fixed", [(consistency(0.5),), (consistency(1.5),)])
    assert (cell.mean, cell.drives, cell.effective) == (1.0, 2, 20.0)
    assert cell.band == pytest.approx(c.band(40.0))
    assert cell.interval == (0.5, 1.5)
    assert cell.verdict() == "consistent"
    (uneven,) = pooled_consistency.pool("mud", "fixed", [(consistency(0.5, 1.0),), (consistency(1.5, 1e9),)])
    assert uneven.effective == pytest.approx(4.0)


def test_the_bootstrap_holds_the_mean_as_often_as_it_says():
    """A percentile interval of ten values is known to be somewhat short of its 95 %."""
    rng = np.random.default_rng(1)
    held = 0
    for _ in range(200):
        low, high = pooled_consistency.mean_interval(rng.normal(3.0, 1.0, size=10))
        held += low <= 3.0 <= high
    assert 0.82 <= held / 200 <= 0.98
    assert pooled_consistency.mean_interval(np.array([2.0])) == (2.0, 2.0)


def test_the_table_flags_what_is_not_consistent():
    cells = pooled_consistency.pool(
        "mud", "fixed", [(consistency(3.0), consistency(0.1, quantity="heading"))]
    )
    lines = twin.table(cells, ("position", "heading", "absent"))
    assert lines[0] == "| ground | mode | position | heading |"
    assert "3.00 [3.00, 3.00] + 0.48..1.71" in lines[2]
    assert "0.10 [0.10, 0.10] -" in lines[2]


def test_a_twin_drive_is_tested_inside_and_outside_its_outage():
    plan = twin.ConsistencyPlan(1, terrains=("asphalt",), modes=("adaptive",), scenario="figure_eight")
    found = twin.run(plan)
    cells = found.cells
    assert {cell.quantity for cell in cells} >= {
        "position", "position, outage", "heading", "heading, outage", "nis gnss", "nis wheels",
    }  # fmt: skip
    assert all(np.isfinite([cell.mean, *cell.band, *cell.interval]).all() for cell in cells)
    assert found.refused == ()
    assert len(twin.report(plan, found)) > 8


def test_a_drive_that_cannot_be_estimated_is_told_and_not_counted(monkeypatch):
    def refuses(recording, mode):
        raise DataError("the robot never moved", channel="gnss")

    monkeypatch.setattr(twin, "checked_drive", refuses)
    plan = twin.ConsistencyPlan(2, terrains=("asphalt",), modes=("fixed",), scenario="straight")
    found = twin.run(plan)
    assert found.cells == ()
    assert [line.split(":")[0] for line in found.refused] == [
        f"asphalt, fixed, seed {twin.FIRST_SEED + k}" for k in range(2)
    ]
    assert sum(line.startswith("not estimated: ") for line in twin.report(plan, found)) == 2


def test_no_seeds_is_a_one_line_error(capsys):
    with pytest.raises(ConfigError, match="0 seeds are none"):
        twin.run(twin.ConsistencyPlan(0))
    assert twin.command(["--seeds", "0"]) == 1
    assert capsys.readouterr().err.count("\n") == 1
    assert twin.command(["--seeds", "1", "--terrain", "cheese"]) == 1
    assert "cheese" in capsys.readouterr().err


def test_correlation_has_no_unit():
    values = np.random.default_rng(4).normal(size=(50, 2))
    rows = np.ones(50, dtype=bool)
    whole = c.squared_correlation(values, rows)
    np.testing.assert_allclose(c.squared_correlation(1e-3 * values, rows), whole, atol=1e-9)
    assert c.squared_correlation(0.0 * values, rows)[:2].tolist() == [1.0, 0.0]


def test_rows_that_are_not_chosen_are_no_part_of_the_correlation():
    values = gauss_markov(40, 0.9, np.random.default_rng(4), columns=1)
    rows = np.arange(40) % 3 != 0
    x = values[:, 0] * rows
    sums, pairs = (np.array([a[: 40 - k] @ a[k:] for k in range(4)]) for a in (x, rows.astype(float)))
    found = c.squared_correlation(values, rows)[:4]
    assert (found[:2] > 0.0).all()
    rho = sums * pairs[0] / (sums[0] * pairs)
    np.testing.assert_allclose(found[found > 0.0], (rho**2)[found > 0.0])
    np.testing.assert_allclose(c.squared_correlation(values + 9.0 * ~rows[:, None], rows)[:4], found)
