"""Labelled logs as a source of the policy: motion from poses, labels, gaps, and what becomes of the rows."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from terrafusion.datasets.core.channels import Terrain, Wheels
from terrafusion.datasets.core.errors import DataError, TerrafusionError
from terrafusion.datasets.core.frames import rpy_to_quaternion
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.fusion.cli.main import app
from terrafusion.fusion.noise.policy import load_policy
from terrafusion.fusion.training import policy_fit
from terrafusion.fusion.training.ground_samples import SLIP_S, samples_of
from terrafusion.fusion.training.policy_fit import LoggedSamples, fingerprint_of, fit_policy, informed
from terrafusion.fusion.training.policy_logs import MEAN_S, logged_samples, motion_of, read_logs
from terrafusion.fusion.training.simulated_runs import Grid
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.simulate import simulate

START_NS = 1_700_000_000_000_000_000
TRACK_M = load_vehicle("warthog").rig().track_m
GRID = Grid(("staircase",), (3.0,), (0.0,), (5,))


def nanoseconds(t_s: np.ndarray) -> np.ndarray:
    return START_NS + np.round(t_s * 1e9).astype(np.int64)


def circled(
    slip: float = 0.1, rate: float = 0.2, seconds: float = 40.0, heading: float = 0.3, noise_m: float = 0.0
) -> Recording:
    """Wheels that say 1 m/s and twice the yaw rate, on a robot that slips; poses at 10 Hz, wheels at 7 Hz."""
    t, w = np.arange(0.0, seconds, 0.1), np.arange(0.0, seconds, 1.0 / 7.0)
    yaw, v = heading + rate * t, 1.0 - slip
    fine = np.linspace(0.0, seconds, 40_001)
    way = np.cumsum(v * np.stack([np.cos(heading + rate * fine), np.sin(heading + rate * fine)]), axis=1)
    xy = np.stack([np.interp(t, fine, x) for x in way * fine[1]], axis=1)
    xy = xy + noise_m * np.random.default_rng(7).normal(size=xy.shape)
    pose = Trajectory(
        nanoseconds(t),
        np.column_stack([xy, np.full(len(t), np.nan)]),
        np.stack([rpy_to_quaternion([0.0, 0.0, y]) for y in yaw]),
    )
    spin = rate * TRACK_M  # half of it on each side, times two
    speeds = np.tile([1.0 - spin, 1.0 + spin], (len(w), 1))
    return Recording(
        "made", START_NS, vehicle="warthog", truth=pose, truth_channels=("position", "yaw"),
        wheels=Wheels(nanoseconds(w), speeds, ("left", "right"), "mps"), terrain_name="grass",
    )  # fmt: skip


@settings(deadline=None)
@given(st.floats(-0.3, 0.6), st.floats(-0.4, 0.4), st.floats(-3.0, 3.0))
def test_slip_and_yaw_scale_of_a_circle_are_exact(slip: float, rate: float, heading: float) -> None:
    evidence = logged_samples(circled(slip, rate, 16.0, heading))["grass"]
    assert evidence.slip == pytest.approx(slip, abs=1e-3)
    assert evidence.side_slip == pytest.approx(0.0, abs=2e-3)
    if abs(rate) > 0.06:
        assert evidence.yaw_scale == pytest.approx(-0.5, abs=1e-6)


def test_a_pose_good_to_2_cm_tells_slip_to_half_a_percent() -> None:
    slips = logged_samples(circled(noise_m=0.02, seconds=400.0))["grass"].slip
    assert np.std(slips) == pytest.approx(np.sqrt(2.0) * 0.02 / MEAN_S, rel=0.3)
    assert np.mean(slips) == pytest.approx(0.1, abs=0.003)


def test_poses_of_the_twin_tell_what_its_true_velocity_tells() -> None:
    for scenario in ("staircase", "figure_eight"):
        drive = simulate(scenario, terrain="loose_sand", seed=3)
        known = samples_of(drive)
        assert drive.truth is not None
        blind = dataclasses.replace(drive, truth=dataclasses.replace(drive.truth, twist_body=None))
        found = logged_samples(blind)["loose_sand"]
        assert np.median(found.slip) == pytest.approx(np.median(known.slip), abs=0.01)
        assert len(found.wheel_mps) == len(found.gyro) == len(found.accel) == len(found.gnss) == 0
        if scenario == "figure_eight":
            assert np.median(found.yaw_scale) == pytest.approx(np.median(known.yaw_scale), abs=0.02)
            assert np.std(found.side_slip) < 2.0 * np.std(known.side_slip) + 0.01


def test_the_vehicle_asked_for_comes_before_that_of_the_log() -> None:
    unknown = dataclasses.replace(circled(), vehicle="prototype_7")
    by_its_name, asked = motion_of(circled()), motion_of(unknown, "warthog")
    assert np.array_equal(asked.wheel_radps, by_its_name.wheel_radps)
    other = motion_of(circled(), "husky")
    assert other.wheel_radps == pytest.approx(
        by_its_name.wheel_radps * TRACK_M / load_vehicle("husky").rig().track_m
    )


def test_a_mean_over_two_grounds_is_of_neither() -> None:
    labels = Terrain(nanoseconds(np.array([0.0, 15.0])), np.array(["grass", "gravel"]))
    found = logged_samples(dataclasses.replace(circled(), terrain=labels))
    assert set(found) == {"grass", "gravel"}
    lost = len(logged_samples(circled())["grass"].slip) - sum(len(e.slip) for e in found.values())
    assert lost == pytest.approx(MEAN_S / SLIP_S, abs=1)


def test_nothing_is_known_across_a_gap() -> None:
    whole = circled()
    assert whole.truth is not None
    holed = whole.truth.select(np.r_[0:100, 150:400])
    motion = motion_of(dataclasses.replace(whole, truth=holed))
    middle = (motion.t_ns - START_NS) * 1e-9
    silent = np.isnan(motion.forward_mps)
    half = 0.5 * MEAN_S
    assert silent[(middle > 10.0 - half) & (middle < 14.9 + half)].all()
    assert not silent[(middle < 9.8 - half) | (middle > 15.2 + half)].any()


def test_samples_that_are_no_numbers_are_left_out() -> None:
    whole = circled()
    assert whole.truth is not None
    assert whole.wheels is not None
    position, speed = whole.truth.position_m.copy(), whole.wheels.speed.copy()
    position[50], speed[100] = np.nan, np.nan
    holed = dataclasses.replace(
        whole,
        truth=dataclasses.replace(whole.truth, position_m=position),
        wheels=dataclasses.replace(whole.wheels, speed=speed),
    )
    slip = logged_samples(holed)["grass"].slip
    assert len(slip) == len(logged_samples(whole)["grass"].slip)
    assert slip == pytest.approx(0.1, abs=1e-3)


def test_a_drive_labelled_unknown_names_no_ground() -> None:
    assert logged_samples(dataclasses.replace(circled(), terrain_name="unknown")) == {}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"wheels": None}, "wheels of both sides"),
        ({"truth": None}, "truth with position and yaw"),
        ({"truth_channels": ("position",)}, "truth with position and yaw"),
        ({"truth_frame": "antenna"}, "truth with position and yaw"),
        ({"terrain_name": ""}, "no ground label"),
        ({"vehicle": None}, "--vehicle"),
        ({"truth": circled().truth.select(slice(1))}, "no two samples"),
    ],
)
def test_a_log_that_lacks_something_is_refused(changes: dict[str, object], words: str) -> None:
    recording = dataclasses.replace(circled(), **changes)  # type: ignore[arg-type]
    with pytest.raises(DataError, match=words):
        logged_samples(recording)


def test_labels_of_the_detector_itself_are_none() -> None:
    guess = Terrain(nanoseconds(np.array([0.0])), np.array(["mud"]), "detector")
    with pytest.raises(DataError, match=r"no ground label; name it in meta.yaml or the column map"):
        logged_samples(dataclasses.replace(circled(), terrain=guess, terrain_name=""))


@pytest.mark.parametrize(("seconds", "ground"), [(5.0, "grass"), (40.0, "unknown")])
def test_logs_that_show_no_ground_are_refused(
    monkeypatch: pytest.MonkeyPatch, seconds: float, ground: str
) -> None:
    log = dataclasses.replace(circled(seconds=seconds), terrain_name=ground)
    monkeypatch.setattr("terrafusion.datasets.readers.open_recordings", lambda name, rig: [log])
    monkeypatch.setattr("terrafusion.datasets.readers.hashes_of", lambda logs: {})
    with pytest.raises(DataError, match="no 6 s on one ground"):
        read_logs(["made"])


def test_too_little_driving_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "terrafusion.datasets.readers.open_recordings", lambda log, rig: [circled(seconds=8.0)]
    )
    with pytest.raises(DataError, match="slips on 'grass'"):
        read_logs(["made"])


def test_a_log_moves_the_means_and_the_rest_stays() -> None:
    told = logged_samples(circled(slip=0.25, seconds=120.0))["grass"]
    plain = fit_policy(GRID)
    logged = LoggedSamples({"asphalt": told, "grass": told}, {"a.csv": "12ab"})
    fitted = fit_policy(GRID, logged=logged)
    assert fitted.names() == ("asphalt", "medium_sand", "loose_sand", "mud", "grass", "unknown")
    moved = {"slip_mean": 0.25, "yaw_scale_mean": -0.5}
    for name, base in (("asphalt", plain.classes["asphalt"]), ("grass", plain.fixed)):
        found = dataclasses.asdict(fitted.classes[name])
        for field, value in dataclasses.asdict(base).items():
            assert found[field] == pytest.approx(moved.get(field, value), abs=2e-3, rel=1e-3), field
    for name in ("medium_sand", "loose_sand", "mud"):
        assert fitted.classes[name] == plain.classes[name]
    rows = {n: r for n, r in fitted.classes.items() if n != "unknown"}
    assert fitted.fixed.slip_mean == pytest.approx(np.mean([r.slip_mean for r in rows.values()]), rel=1e-3)
    assert plain.inputs_sha256 == fingerprint_of(GRID)
    assert fitted.inputs_sha256 == fingerprint_of(GRID, logged) != plain.inputs_sha256


def test_a_log_widens_a_scatter_and_never_narrows_it() -> None:
    row = load_policy().fixed
    told = logged_samples(circled(seconds=60.0))["grass"]
    sure = informed(row, told)
    for name in ("slip_sigma", "yaw_scale_sigma", "side_slip_sigma"):
        assert getattr(sure, name) == getattr(row, name)
    rng = np.random.default_rng(1)
    wild = dataclasses.replace(told, slip=told.slip + 0.5 * rng.normal(size=len(told.slip)))
    assert informed(row, wild).slip_sigma > 0.4


def test_the_slope_over_the_grade_is_the_logs_only_in_hills() -> None:
    row = load_policy().classes["loose_sand"]
    told = logged_samples(circled(seconds=60.0))["grass"]
    wave = np.sin(np.arange(len(told.slip)))
    for height, slope in ((0.01, row.slip_per_grade), (0.1, 2.0)):
        grade = height * wave
        found = informed(row, dataclasses.replace(told, grade=grade, slip=0.1 + slope * grade))
        assert found.slip_per_grade == pytest.approx(slope, rel=0.01)
        assert found.slip_mean == pytest.approx(0.1, abs=1e-3)


def test_a_drive_straight_ahead_tells_nothing_of_turning() -> None:
    row = load_policy().fixed
    found = informed(row, logged_samples(circled(rate=0.0, slip=0.2))["grass"])
    assert found == dataclasses.replace(row, slip_mean=found.slip_mean)
    assert found.slip_mean + 0.0 == pytest.approx(0.2, abs=1e-3)


@pytest.fixture
def few_drives(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(policy_fit, "SCENARIOS", ("staircase",))
    monkeypatch.setattr(policy_fit, "SLOPES_DEG", (0.0,))
    monkeypatch.setattr(policy_fit, "PAYLOADS_KG", (0.0,))


@pytest.mark.usefixtures("few_drives")
def test_the_command_takes_soils_and_logs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("terrafusion.datasets.readers.open_recordings", lambda log, rig: [circled()])
    log = tmp_path / "drive.csv"
    log.write_text("any\n")
    out = tmp_path / "policy.yaml"
    words = ["policy", "fit", "--out", str(out), "--seeds", "1", "--ground", "gravel", str(log)]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    policy = load_policy(out)
    assert policy.names() == ("gravel", "grass", "unknown")
    assert policy.classes["grass"].slip_mean == pytest.approx(0.1, abs=1e-3)
    first = out.read_bytes()
    assert str(tmp_path).encode() not in first
    CliRunner().invoke(app, words)
    assert out.read_bytes() == first
    log.write_text("another\n")
    CliRunner().invoke(app, words)
    assert load_policy(out).inputs_sha256 != policy.inputs_sha256


def test_a_ground_on_which_the_wheels_never_turn_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    still = logged_samples(circled(seconds=7.0))["grass"]
    monkeypatch.setattr(policy_fit, "samples_of", lambda recording: still)
    with pytest.raises(TerrafusionError, match=r"asphalt.*never turned"):
        fit_policy(GRID)


@pytest.mark.parametrize(
    ("words", "message"),
    [(["--ground", "lava"], "unknown soil 'lava'"), (["--vehicle", "boat"], "unknown vehicle 'boat'")],
)
def test_an_unknown_soil_or_vehicle_is_refused_at_once(
    tmp_path: Path, words: list[str], message: str
) -> None:
    result = CliRunner().invoke(app, ["policy", "fit", "--out", str(tmp_path / "p.yaml"), *words])
    assert result.exit_code != 0
    assert message in str(result.exception) + result.output


FIELD = os.environ.get("TERRAFUSION_DATA", "")


@pytest.mark.skipif(not FIELD, reason="TERRAFUSION_DATA names no folder of field logs")
def test_a_real_warthog_on_grass() -> None:
    log = Path(FIELD) / "norlab_drive/warthog_wheels_grass_2024_8_8_16h11s19/raw_dataframe.pkl"
    if not log.exists():
        pytest.skip("no norlab_drive among the field logs")
    logged = read_logs([str(log)])
    row = policy_fit.noise_of([logged.grounds["grass"]])
    assert 0.0 < row.slip_mean < 0.1
    assert -0.6 < row.yaw_scale_mean < -0.3  # docs/explanation/planar.md: what its yaw loses on any ground
    assert list(logged.inputs) == [f"{log.parent.name}/{log.name}"]
