"""The comparison as a whole: splits, scores, files, and a small part of the public drives."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.readers.open import open_recordings
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.simulate import simulate
from tests.studies.joined_windows import DT_S
from tests.studies.twin_field import compare, summary
from tests.studies.twin_field.field_run import FieldRun
from tests.studies.twin_field.forks import N_FUTURE, N_PAST, Forks, forks_of
from tests.studies.twin_field.models import BEST_KINEMATIC, TWIN, Hold
from tests.studies.twin_field.scores import METRICS, interval, medians, scores
from tests.studies.twin_field.slip import MEASURED, slip_rows
from tests.studies.twin_field.sources import field_runs, read
from tests.studies.twin_field.splits import evenly, folds

SAMPLES = N_PAST + N_FUTURE + 1


@pytest.fixture(scope="module")
def drives() -> Path:
    """The folder of field logs, where the environment names it."""
    root = os.environ.get("TERRAFUSION_DATA")
    if not root or not (Path(root) / "norlab_drive").is_dir():
        pytest.skip("TERRAFUSION_DATA names no folder with norlab_drive: the field logs are not at hand")
    return Path(root)


def run(name: str, seconds: float = 60.0, slip: float = 0.1, ground: str = "grass") -> FieldRun:
    """A drive of made-up wheels in which the body makes a share of the wheels' way and turns by 1.9 m."""
    t = np.arange(0.0, seconds, DT_S)
    sides = 4.0 + np.stack([np.sin(0.3 * t), np.cos(0.2 * t)], axis=1)
    vehicle = load_vehicle("warthog")
    rim = vehicle.wheel.radius_m * sides
    velocity = np.stack([(1.0 - slip) * rim.mean(axis=1), np.zeros(len(t))], axis=1)
    turn = (rim[:, 1] - rim[:, 0]) / 1.9
    return FieldRun(
        name, name, ground, vehicle, t, sides, np.full_like(sides, np.nan), turn, velocity,
        np.full(len(t), 0.01), True,
    )  # fmt: skip


def some_forks(recordings: list[str], known: bool = True) -> Forks:
    found = forks_of([run(name) for name in recordings], "wheels")
    assert found is not None
    return found if known else dataclasses.replace(found, motion=found.motion * (np.nan, np.nan, 1.0))


def test_horizons_do_not_overlap_and_standing_ones_are_left_out():
    moving = run("a")
    found = forks_of([moving], "wheels")
    assert found is not None
    assert len(found) == 11
    assert np.diff(found.time_s).min() >= 5.0 - 1e-9
    still = dataclasses.replace(moving, sides_radps=0.0 * moving.sides_radps)
    assert forks_of([still], "wheels") is None
    assert forks_of([moving], "commands") is None


def test_no_fork_is_trained_on_and_scored():
    for forks in (some_forks(["a", "b", "c"]), some_forks(["a"]), some_forks(["a", "b"], known=False)):
        cuts, _ = folds(forks)
        for cut in cuts:
            assert not (cut.train & cut.test).any()
            assert not set(forks.group[cut.train]) & set(forks.group[cut.test])
        assert sum(cut.test.astype(int) for cut in cuts).tolist() == [1] * len(forks)


def test_recordings_stay_whole_where_several_know_the_speed():
    forks = some_forks(["a", "b", "c"])
    cuts, rule = folds(forks)
    assert rule == "alternate recordings"
    for cut in cuts:
        assert not set(forks.recording[cut.train]) & set(forks.recording[cut.test])
    assert folds(some_forks(["a", "b"], known=False))[1] == "halves of each recording"


def test_evenly_keeps_at_most_so_many():
    mask = np.arange(100) % 2 == 0
    assert evenly(mask, 10).sum() == 10
    assert not (evenly(mask, 10) & ~mask).any()
    assert np.array_equal(evenly(mask, 1000), mask)


def test_scores_of_a_constant_error():
    forks = some_forks(["a"])
    told = forks.motion[:, N_PAST:] + [0.3, 0.0, 0.0]
    found = dict(zip(METRICS, scores(told, forks).T, strict=True))
    assert np.allclose(found["speed_rms_1s_mps"], 0.3)
    assert np.allclose(found["speed_rms_5s_mps"], 0.3)
    assert np.allclose(found["turn_rms_5s_radps"], 0.0, atol=1e-12)
    assert np.allclose(found["heading_rad"], 0.0, atol=1e-12)
    assert (found["position_m"] <= 1.5 + 1e-9).all()  # 0.3 m/s for 5 s, less in a curve
    assert (found["position_m"] > 1.0).all()


def test_scores_of_what_is_not_known_are_nan():
    forks = some_forks(["a"], known=False)
    found = dict(zip(METRICS, scores(Hold().predict(forks), forks).T, strict=True))
    assert np.isnan(found["speed_rms_5s_mps"]).all()
    assert np.isnan(found["position_m"]).all()
    assert np.isfinite(found["turn_rms_5s_radps"]).all()


def test_bootstrap_draws_groups_not_forks():
    rng = np.random.default_rng(0)
    level = np.repeat(rng.normal(0.0, 1.0, 8), 25)
    values = level + rng.normal(0.0, 0.01, 200)
    grouped, alone = (
        interval(float(middle[0]), draws[:, 0])
        for middle, draws in (
            medians(values[:, None], np.repeat(np.arange(8).astype(str), 25)),
            medians(values[:, None], np.arange(200).astype(str)),
        )
    )
    assert grouped.high - grouped.low > 2.0 * (alone.high - alone.low)
    assert grouped.low <= grouped.median <= grouped.high


def test_medians_leave_out_what_is_unknown():
    table = np.array([[1.0, np.nan, np.nan], [3.0, 5.0, np.nan], [8.0, 7.0, np.nan], [4.0, np.nan, np.nan]])
    middle, draws = medians(table, np.array(["a"] * 4))
    assert middle[:2].tolist() == [3.5, 6.0]
    assert np.isnan(middle[2])
    assert np.array_equal(draws[0], middle, equal_nan=True)


@pytest.fixture(scope="module")
def small() -> list[compare.Result]:
    """A comparison of two short drives that a kinematic model explains."""
    return compare.compare([run("a", 40.0), run("b", 40.0)])


def test_models_that_are_right_predict_rightly(small):
    by_name = {r.name: r for r in small}
    speed = METRICS.index("speed_rms_5s_mps")
    assert np.median(by_name["radius, track"].scores[:, speed]) < 1e-3
    assert np.median(by_name["plain"].scores[:, speed]) > 0.05
    assert np.median(by_name[TWIN].scores[:, speed]) < 0.05


def test_slip_and_track_are_those_of_the_drive(small):
    rows = {(row.source, row.recording): row for row in slip_rows(small, 0.30, 1.08)}
    measured = rows[MEASURED, ""]
    assert measured.slip.median == pytest.approx(0.1, abs=1e-6)
    assert measured.track_m.median == pytest.approx(1.9, abs=1e-6)
    assert rows["radius, track", ""].slip.median == pytest.approx(0.1, abs=2e-3)


def test_lines_count_every_fork_once_and_name_the_rule(small):
    lines = summary.lines("warthog", small)
    forks = forks_of([run("a", 40.0), run("b", 40.0)], "wheels")
    assert forks is not None
    assert {line.forks for line in lines} == {len(forks)}
    assert {line.rule for line in lines} == {"alternate recordings"}
    best = next(line for line in lines if line.model == BEST_KINEMATIC)
    assert best.ratios["speed_rms_5s_mps"].median == pytest.approx(1.0)
    rows = list(summary.line_rows(lines))
    assert json.loads(json.dumps(rows, allow_nan=False)) == rows
    tables = summary.markdown(lines, compare.SAME)
    assert tables.count("| warthog, wheels, grass |") == len(summary.SHOWN)
    assert len({line.count("|") for line in tables.splitlines() if line}) == 1


def test_a_simulated_drive_is_read_as_it_was_driven():
    made = simulate("figure_eight", vehicle="husky", terrain="asphalt", noiseless=True)
    (one,) = field_runs("made", [made])
    truth = made.truth
    assert truth is not None
    assert truth.twist_body is not None
    assert made.imu is not None
    clock = (truth.t_ns - made.imu.t_ns[0]) * 1e-9
    inner = slice(40, -40)
    for channel, found in ((0, one.velocity_mps[:, 0]), (5, one.yaw_rate_radps)):
        told = np.interp(one.t_s, clock, truth.twist_body[:, channel])
        assert np.sqrt(np.mean((found[inner] - told[inner]) ** 2)) < 0.01
        assert np.abs(found[inner] - told[inner]).max() < 0.1  # a corner of the speed, between knots
    assert np.isfinite(one.commanded_radps[inner]).all()
    still = dataclasses.replace(made, imu=None)
    with pytest.raises(DataError, match="no gyro"):
        field_runs("made", [still])


def test_a_folder_without_drives_is_refused(tmp_path):
    with pytest.raises(DataError, match="holds no recording"):
        read([tmp_path])


def test_command_refuses_in_one_line(tmp_path):
    words = [
        sys.executable,
        "-m",
        "tests.studies.twin_field.compare_drives",
        str(tmp_path),
        "--out",
        str(tmp_path / "out"),
    ]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_windows_of_a_step_are_joined_and_their_speed_is_near_the_wheels(drives):
    name = "norlab_drive/gravel_2024_8_6_11h37s32/windows"
    runs = field_runs(name, open_recordings(name))
    assert len(runs) < 100  # of 300 windows
    assert max(len(r.t_s) for r in runs) >= 120  # three windows of 40 rows
    forks = forks_of(runs, "wheels")
    assert forks is not None
    assert forks_of(runs, "commands") is not None
    way = forks.motion[:, N_PAST:, 0].mean(axis=1)
    rolled = forks.inputs_radps[:, N_PAST:].mean(axis=(1, 2)) * 0.3
    fast = np.abs(rolled) > 0.5
    assert np.median(way[fast] / rolled[fast]) == pytest.approx(0.95, abs=0.06)


def test_calibrated_twin_beats_the_fitted_centres_of_rotation_on_ice(drives):
    name = "norlab_drive/ice_2024_7_30_16h30s21/windows"
    runs = field_runs(name, open_recordings(name))
    wheels = [
        dataclasses.replace(r, commanded_radps=np.full_like(r.commanded_radps, np.nan)) for r in runs[:8]
    ]
    lines = {line.model: line for line in summary.lines("warthog", compare.compare(wheels))}
    twin = lines[TWIN]
    for metric in ("speed_rms_5s_mps", "turn_rms_5s_radps", "position_m"):
        assert twin.ratios[metric].high < 1.0, metric
    assert twin.errors["speed_rms_5s_mps"].median < 0.35
