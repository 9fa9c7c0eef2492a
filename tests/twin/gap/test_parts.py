"""Parts of the diagnosis alone: sensitivities, probabilities, candidates."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Overrides
from terrafusion.twin.calibrate.inputs import DT_S
from terrafusion.twin.calibrate.predict import predict
from terrafusion.twin.effects import catalogue
from terrafusion.twin.effects.alternative_terramechanics import second_terramechanics
from terrafusion.twin.effects.form import Form, one
from terrafusion.twin.gap.answer.verdict import null_probability
from terrafusion.twin.gap.data.candidates import RANGE_SHARE, SMALLEST, Candidates
from terrafusion.twin.gap.data.logs import prepared
from terrafusion.twin.gap.data.samples import sample_map
from terrafusion.twin.gap.null.channel_noise import data_sheet_noise
from terrafusion.twin.gap.null.score import score
from terrafusion.twin.gap.rollout import batch
from terrafusion.twin.gap.rollout.batch import (
    SampledSensors,
    assign_graphs,
    effect_groups,
    make_lanes,
    motion_effects,
)
from terrafusion.twin.gap.rollout.residuals import initial_state_sigma, residuals_from, whitened
from terrafusion.twin.gap.rollout.sensitivities import (
    Rollout,
    channel_sensitivities,
    linearise,
    moved_to,
    predictions,
)
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.simulate import simulate
from tests.twin.gap.runs import DRIVE, run

CANDIDATES = Candidates.of()


@pytest.fixture(scope="module")
def log_and_model():
    recording = run(1)
    (log,), model, _ = prepared([recording], load_vehicle("elevate"), None)
    return log, model


@pytest.mark.parametrize(("short", "within"), [(False, 1e-8), (True, 2e-6)])
def test_a_drive_from_other_poses_is_the_same_drive_moved(log_and_model, monkeypatch, short, within) -> None:
    """In 64 bits to the last digits; in the 32 that the diagnosis takes, as far as these go."""
    monkeypatch.setattr(batch, "SINGLE_PRECISION", short)
    log, model = log_and_model
    moved = log.start + np.array([2.0, -1.0, 0.3])
    keys = ("gnss_lever_arm/offset/x", "wheel_radius/scale")
    first, there = (
        channel_sensitivities(log, linearise(log, model, CANDIDATES, at, keys)) for at in (log.start, moved)
    )
    here = moved_to(log, first, log.start, moved)
    for mine, its in zip(here, there, strict=True):
        for name in ("value", "columns", "heading"):
            np.testing.assert_allclose(getattr(mine, name), getattr(its, name), atol=within)
    east = [o.channel for o in log.observed].index("gnss_east_m")
    assert np.abs(here[east].columns[:, 3:] - first[east].columns[:, 3:]).max() > 1e-3


def test_signatures_are_what_a_finite_effect_does(log_and_model) -> None:
    log, model = log_and_model
    keys = ("wheel_radius/scale", "gyro_scale/scale", "gnss_latency/both")
    found = channel_sensitivities(log, linearise(log, model, CANDIDATES, log.start, keys))
    columns = [CANDIDATES.keys.index(k) for k in keys]
    sets = [{k: 0.1 * float(CANDIDATES.scale[c])} for k, c in zip(keys, columns, strict=True)]
    plain, *with_effect = predictions([Rollout(log, some) for some in ({}, *sets)], model, CANDIDATES)
    assert plain is not None
    for column, values in zip(columns, with_effect, strict=True):
        assert values is not None
        for i, observed in enumerate(log.observed):
            if observed.channel in ("accel_x_mps2", "wheel_left_radps", "wheel_right_radps"):
                continue  # a wheel that is about to slide is not linear in anything
            true = (values[i] - plain[i]) / 0.1
            error = np.linalg.norm(true - found[i].columns[:, 3 + column])
            assert error < 0.12 * np.linalg.norm(true) + 0.02 * np.median(observed.sigma) * len(true) ** 0.5


def test_a_column_does_not_depend_on_what_else_is_asked_for(log_and_model) -> None:
    log, model = log_and_model
    keys = (
        "mass/at_cg",
        "slope/uniform",
        "wheel_radius/scale",
        "gyro_scale/scale",
    )  # of several assign_graphs
    all_, some = (
        linearise(log, model, CANDIDATES, log.start),
        linearise(log, model, CANDIDATES, log.start, keys),
    )
    assert np.array_equal(all_.fine, some.fine)
    for i, key in enumerate(CANDIDATES.keys[: CANDIDATES.count]):
        if key in keys:
            np.testing.assert_allclose(
                some.columns[:, :, 3 + i], all_.columns[:, :, 3 + i], rtol=0.0, atol=1e-9
            )
            assert np.abs(some.columns[:, :, 3 + i]).max() > 1e-3
        else:
            assert not some.columns[:, :, 3 + i].any()


@pytest.mark.parametrize(("short", "within"), [(False, 1e-3), (True, 0.05)])
def test_sets_of_effects_batch_are_what_each_is_alone(log_and_model, monkeypatch, short, within) -> None:
    """Whatever graphs run them, although those of the sensors alone share a run. In units of the noise;
    32 bits may differ by more in a row where a wheel is about to slide, but not in all."""
    monkeypatch.setattr(batch, "SINGLE_PRECISION", short)
    log, model = log_and_model
    alone = {
        "gyro_bias/constant": 0.01, "mass/at_cg": 0.1, "wheel_radius/scale": 0.02, "dead_time/transport": 0.1,
        "slip_sinkage/linear": 0.5, "soil_strength/shear": 0.1,
    }  # fmt: skip
    sets = [{}, *({k: v} for k, v in alone.items()), {"mass/at_cg": 0.1, "gyro_bias/constant": 0.01}]
    sets += [{"wheel_radius/scale": 0.002 * k} for k in range(1, 9)]
    together = predictions([Rollout(log, some) for some in sets], model, CANDIDATES)
    for some, found in zip(sets, together, strict=True):
        (by_itself,) = predictions([Rollout(log, some)], model, CANDIDATES)
        square = 0.0
        for observed, a, b in zip(log.observed, found, by_itself, strict=True):
            np.testing.assert_allclose(a, b, atol=within * np.median(observed.sigma), err_msg=f"{some}")
            square += float(np.sum(((a - b) / np.median(observed.sigma)) ** 2))
        assert square < 0.01
    plain, biased, heavy = together[0], together[1], together[2]
    rate = [o.channel for o in log.observed].index("yaw_rate_radps")
    np.testing.assert_allclose(biased[rate] - plain[rate], 0.01, rtol=1e-9)
    np.testing.assert_allclose(together[7][rate] - heavy[rate], 0.01, rtol=1e-9)


def test_numbers_of_32_bits_lose_less_than_steps_of_third_order(log_and_model, monkeypatch) -> None:
    """In units of the sensors' noise, with effects of each kind."""
    log, model = log_and_model
    keys = ("mass/at_cg", "wheel_radius/scale", "slip_sinkage/linear", "backlash/lost_motion")
    keys += ("slope/uniform",)
    asks = [Rollout(log, {})]
    asks += [Rollout(log, {k: 0.3 * float(CANDIDATES.scale[CANDIDATES.keys.index(k)])}) for k in keys]
    told = {}
    for short, order in ((True, 3), (False, 3), (False, 4)):
        monkeypatch.setattr(batch, "SINGLE_PRECISION", short)
        monkeypatch.setattr(batch, "INTEGRATOR_ORDER", order)
        found = predictions(asks, model, CANDIDATES)
        told[short, order] = np.array(
            [np.concatenate([y / o.sigma for o, y in zip(log.observed, ys, strict=True)]) for ys in found]
        )
    by_bits = told[True, 3] - told[False, 3]
    by_order = told[False, 4] - told[False, 3]
    assert 0.0 < np.abs(by_bits).max() < 0.02
    assert np.square(by_bits).sum() < np.square(by_order).sum()


def test_runs_of_several_logs_are_what_each_is_alone(log_and_model) -> None:
    """To the bit, though they have windows of other lengths, start elsewhere and end sooner."""
    log, model = log_and_model
    ends = log.windows + np.array([[137, 89], [89, -61]])
    begin_s, end_s = DT_S * ends[0, 0], DT_S * ends[-1, 1]
    inside = tuple(o.select((o.begin_s > begin_s) & (o.end_s < end_s)) for o in log.observed)
    start = log.start + np.array([3.0, 1.0, 0.5])
    other = dataclasses.replace(log, windows=ends, start=start, observed=inside)
    sets = [{}, {"mass/at_cg": 0.1}, {"gyro_bias/constant": 0.01}]
    asks = [Rollout(of, some) for some in sets for of in (log, other, log)]
    together = predictions(asks, model, CANDIDATES, jobs=2)
    for ask, found in zip(asks, together, strict=True):
        alone = predictions([Rollout(ask.log, some) for some in sets], model, CANDIDATES)[
            sets.index(ask.effects)
        ]
        for a, b in zip(found, alone, strict=True):
            np.testing.assert_array_equal(a, b)


def test_stretches_that_are_alike_hold_every_row_once(log_and_model) -> None:
    log, _ = log_and_model
    found, rows = sample_map(log), sum(len(o.value) for o in log.observed)
    assert sorted(np.concatenate([places.ravel() for _, _, places in found.equally_spaced])) == list(
        range(rows)
    )
    for i, of, places in found.equally_spaced:
        for mine, at in zip(of, places, strict=True):
            assert any(j == i and np.array_equal(some, mine) for j, _, some in found.blocks)
            assert np.ptp(at) == len(at) - 1


def test_sets_may_start_from_poses_of_their_own(log_and_model) -> None:
    log, model = log_and_model
    moved, sets = log.start + np.array([0.0, 0.0, 0.3]), [{}, {}, {"gyro_bias/constant": 0.01}]
    asks = [Rollout(log, some, at) for some, at in zip(sets, (log.start, moved, moved), strict=True)]
    here, there, biased = predictions(asks, model, CANDIDATES)
    alone = predictions(asks[1:], model, CANDIDATES)
    for i, observed in enumerate(log.observed):
        np.testing.assert_allclose(there[i], alone[0][i], atol=1e-3 * np.median(observed.sigma))
        np.testing.assert_allclose(biased[i], alone[1][i], atol=1e-3 * np.median(observed.sigma))
    east = [o.channel for o in log.observed].index("gnss_east_m")
    assert np.abs(here[east] - there[east]).max() > 0.1


def test_graphs_hold_what_their_runs_need_and_every_run_once() -> None:
    def of(*sets: dict[str, float]) -> dict[tuple[str, ...], list[int]]:
        return assign_graphs(CANDIDATES, [motion_effects(CANDIDATES, some) for some in sets])

    few = of({}, {"gyro_bias/constant": 0.1}, *({"mass/at_cg": 0.01 * k} for k in range(1, 5)))
    assert list(few) == [next(g for g in effect_groups(CANDIDATES) if "mass/at_cg" in g)]
    assert sorted(run for runs in few.values() for run in runs) == list(range(6))
    apart = [{k: 0.01} for k in ("mass/at_cg", "wheel_radius/scale", "slip_sinkage/linear", "slope/uniform")]
    assert list(of({}, *apart)) == [CANDIDATES.moving]  # one vector of the whole graph
    assert list(of({}, {"soil_strength/shear": 0.1})) == [()]
    assert list(of({"mass/at_cg": 0.1, "slope/uniform": 0.1})) == [CANDIDATES.moving]


def test_null_probability_rises_with_the_p_value() -> None:
    values = [null_probability(p) for p in np.linspace(1e-6, 1.0, 60)]
    assert all(0.0 <= v <= 1.0 for v in values)
    assert np.all(np.diff(values) >= 0.0)
    assert null_probability(0.05) == pytest.approx(0.2893, abs=1e-3)  # Sellke et al. 2001, table 1


def test_an_effect_of_ones_own_takes_part() -> None:
    form = Form(
        "trailer", "drag", one("N", 10.0, 0.0, 200.0),
        {"body": lambda q, e: {"body_force_x_n": q["body_force_x_n"] - e * q["u"]}},
        "force e against the motion",
    )  # fmt: skip
    catalogue.register(form)
    own = Candidates.of()
    assert "trailer" in own.effects
    assert "trailer/drag" in own.moving
    assert own.hypotheses[-1].columns == (own.keys.index("trailer/drag"),)


def test_what_the_twin_has_can_also_be_less() -> None:
    """Between the ends of the range, from its own value; no side is shorter than the least size sought."""
    keys = ("slip_sinkage/linear", "motion_resistance/rolling", "wheel_radius/scale")
    at = [CANDIDATES.keys.index(key) for key in keys]
    scale, high = CANDIDATES.scale[at], RANGE_SHARE * CANDIDATES.high[at] / CANDIDATES.scale[at]
    low, _ = CANDIDATES.bounds(at)
    assert low[0] == low[1] == 0.0
    beside = CANDIDATES.beside(dict(zip(keys, scale * [4.0, 0.5 * SMALLEST, high[2]], strict=True)))
    low, end = beside.bounds(at)
    np.testing.assert_allclose(low, [-4.0, 0.0, -2.0 * high[2]])
    np.testing.assert_allclose(end, [high[0] - 4.0, high[1] - 0.5 * SMALLEST, 0.0], atol=1e-9)
    assert beside.changed(at[:1], low[:1]) == {keys[0]: pytest.approx(0.0, abs=1e-12)}


def test_other_terramechanics_are_no_candidate_unless_asked_for() -> None:
    name = next(iter(second_terramechanics())).split("/")[0]
    assert name in catalogue.effect_names()
    assert Candidates.of().keys == CANDIDATES.keys
    assert Candidates.of([name]).effects == (name,)


def test_the_geometry_that_logs_tell_is_said_and_has_to_be_one() -> None:
    vehicle = load_vehicle("elevate")
    plain = run(3)
    told = dataclasses.replace(plain, name="told", overrides=Overrides(wheel_radius_m=0.17))
    _, model, notes = prepared([told, told], vehicle, None)
    assert model.vehicle.wheel.radius_m == 0.17
    assert notes == ["the log's own geometry is used: wheel_radius_m = 0.17"]
    assert prepared([plain], vehicle, None)[2] == []
    another = (
        rf"told: it reports another geometry .* \(wheel_radius_m = 0.17\) than {plain.name} \(none\); "
        r"give.*`terrafusion convert`"
    )
    with pytest.raises(DataError, match=another):
        prepared([plain, told], vehicle, None)


def test_scores_are_those_of_the_whole_covariance(log_and_model) -> None:
    log, model = log_and_model
    keys = ("gyro_scale/scale", "wheel_radius/scale")
    channels = tuple(o.channel for o in log.observed)
    seen = channel_sensitivities(log, linearise(log, model, CANDIDATES, log.start, keys))
    raw = residuals_from(log, seen, model, CANDIDATES, channels)
    run, sigma = whitened(raw, data_sheet_noise([raw])), initial_state_sigma(CANDIDATES)
    T = run.states
    rows = run.rows.astype(float)
    covariance = np.eye(len(rows)) + (rows[:, :T] * sigma**2) @ rows[:, :T].T
    P = rows[:, T:-1]
    np.testing.assert_allclose(
        score(run, sigma).A, P.T @ np.linalg.solve(covariance, P), rtol=1e-3, atol=1e-2
    )


def test_what_a_vehicle_is_built_like_is_in_its_twin_and_no_cause() -> None:
    """The Husky's coupled wheels: the diagnosis's twin drives as that of the calibration does. With more load
    on the front axle, other wheels would turn differently."""
    husky = load_vehicle("husky")
    husky = dataclasses.replace(husky, body=dataclasses.replace(husky.body, cg_forward_m=0.1))
    assert husky.effects
    candidates = Candidates.of(None, husky.effects)
    assert candidates.keys == Candidates.of(None).keys
    recording = dataclasses.replace(simulate(DRIVE, vehicle=husky, seed=1), truth=None, truth_channels=())
    (log,), model, _ = prepared([recording], husky, None)
    for group in (*effect_groups(candidates), ()):
        (lane,) = make_lanes([(log, model, {}, log.start)], candidates, group)
        assert lane.plant.effects.items() >= husky.effects.items()
    sensors = SampledSensors(log, model, candidates, log.samples())
    assert {*sensors._graph_effects({}, ())} >= husky.effects.keys()
    (found,) = predictions([Rollout(log, {})], model, candidates)
    assert found is not None
    fine = channel_sensitivities(log, linearise(log, model, candidates, log.start, ()))
    for observed, a, b, c in zip(log.observed, predict(log, model, (), log.start), found, fine, strict=True):
        for mine in (b, c.value):
            assert np.sqrt(np.mean(((a.value - mine) / observed.sigma) ** 2)) < 0.05, observed.channel
