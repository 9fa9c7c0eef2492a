"""Calibration finds the numbers a drive was made with, and says what it cannot find."""

from __future__ import annotations

import dataclasses
import functools
import itertools

import numpy as np
import pytest

from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.calibrate.calibrate import calibrate
from terrafusion.twin.calibrate.coordinates import Coordinate, Prior
from terrafusion.twin.calibrate.files import write_files
from terrafusion.twin.calibrate.log import prepare
from terrafusion.twin.calibrate.model import Model, resolve
from terrafusion.twin.calibrate.predict import predict
from terrafusion.twin.calibrate.problem import Point, Problem, ResidualBlock
from terrafusion.twin.calibrate.result import Calibration
from terrafusion.twin.calibrate.suggest import suggest
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate_run

SOIL = "loose_sand"
FACTORS = {
    f"{SOIL}.shear.friction_cap": 1.2, f"{SOIL}.shear.shear_modulus_m": 0.85,
    "vehicle.wheel.radius_m": 1.03, "vehicle.body.track_m": 1.1, "vehicle.body.mass_kg": 1.2,
}  # fmt: skip
DRIVE = Scenario(
    "short", 20.0, route=(RouteLeg(SOIL),),
    drive=(
        DriveSegment(1.0), DriveSegment(7.0, 0.8, 0.4), DriveSegment(6.0, 1.2, -0.5),
        DriveSegment(6.0, 0.5, v_amplitude_mps=0.4, period_s=2.0),
    ),
)  # fmt: skip
NAMES = tuple(FACTORS)


def nominal(**changes: float) -> Model:
    return Model(load_vehicle("elevate"), {SOIL: load_soil(SOIL)}, **changes)


TRUTH = {name: factor * nominal().value(name) for name, factor in FACTORS.items()}


@functools.cache
def drive(seed: int = 3, noiseless: bool = False, slope_deg: float = 0.0, **changes: float) -> Recording:
    """The short drive with `TRUTH` (and dead time, where given), without its reference pose."""
    model = nominal().replaced({**TRUTH, **{f"vehicle.drive.{k}": v for k, v in changes.items()}})
    run = simulate_run(
        DRIVE, vehicle=model.vehicle, soils=model.soils, seed=seed, noiseless=noiseless, slope_deg=slope_deg
    )
    return dataclasses.replace(run.recording, truth=None, truth_channels=())


@functools.cache
def fitted() -> Calibration:
    """The fit of all numbers to the noisy drive."""
    return calibrate(drive(), "elevate", SOIL, NAMES)


def problem_of(recording: Recording, names: tuple[str, ...] = NAMES, **changes: float) -> Problem:
    model = nominal(**changes)
    known = resolve(names, model)
    coordinates = [Coordinate.of(n, q, model.value(n), None) for n, q in known.items()]
    return Problem([prepare(recording, model, ground=SOIL)], model, coordinates, robust=False)


def test_exact_data_give_the_exact_numbers() -> None:
    found = calibrate(drive(noiseless=True), "elevate", SOIL, NAMES)
    assert found.converged()
    for name, value in TRUTH.items():
        assert found[name].value == pytest.approx(value, rel=1e-4)


def test_on_a_slope_the_rest_before_the_drive_is_not_believed() -> None:
    """How brakes and motors share the weight at rest depends on what was before the log."""
    found = calibrate(drive(noiseless=True, slope_deg=5.0), "elevate", SOIL, NAMES, slope_deg=5.0)
    for name, value in TRUTH.items():
        assert found[name].value == pytest.approx(value, rel=0.01)


def test_noisy_data_give_them_within_their_sigma() -> None:
    found = fitted()
    scores = [(found[name].value - value) / found[name].sigma for name, value in TRUTH.items()]
    assert np.max(np.abs(scores)) < 3.5
    assert all(found[name].sigma < 0.2 * found[name].value for name in NAMES)
    assert all(c.rms(c.after) <= 1.02 * c.rms(c.before) for c in found.channels)


@pytest.mark.parametrize("slope_rad", [0.0, 0.15])
def test_derivatives_of_the_residuals(slope_rad: float) -> None:
    problem = problem_of(drive(noiseless=True, slope_deg=float(np.degrees(slope_rad))), slope_rad=slope_rad)
    rng = np.random.default_rng(0)
    start = problem.start()
    errors = rng.normal(size=start.errors.shape)
    log = problem.logs[0]

    def moved(way: Point, step: float) -> np.ndarray:
        point = Point(start.w + step * way.w, errors + step * way.errors, (step * way.pose[0],))
        return np.concatenate([b.residual for b in problem.blocks(point)])

    # On a slope a window's heading also enters the next one's inner states, which is left out.
    pose = rng.normal(size=log.start.shape) * (1e-3 if slope_rad == 0.0 else 0.0)
    way = Point(rng.normal(size=len(NAMES)), rng.normal(size=errors.shape), (pose,))
    step = 1e-4
    numeric = (moved(way, step) - moved(way, -step)) / (2.0 * step)
    blocks = problem.blocks(Point(start.w, errors, start.pose))
    analytic = np.concatenate(
        [b.change @ np.concatenate([way.w, way.errors[b.log], way.pose[b.log][b.window]]) for b in blocks]
    )
    scale = np.concatenate([np.full(len(b.rows), np.abs(b.change).max()) for b in blocks])
    assert np.max(np.abs(numeric - analytic) / scale) < 2e-4


def test_order_of_the_parameters_does_not_matter() -> None:
    one = fitted()
    other = calibrate(drive(), "elevate", SOIL, NAMES[::-1])
    for name in NAMES:
        assert other[name].value == pytest.approx(one[name].value, abs=0.05 * one[name].sigma)
        assert other[name].sigma == pytest.approx(one[name].sigma, rel=0.02)


def test_four_logs_halve_sigma() -> None:
    one = fitted()
    four = calibrate([drive(seed) for seed in range(3, 7)], "elevate", SOIL, NAMES)
    ratio = [four[name].sigma / one[name].sigma for name in NAMES]
    assert 0.4 < np.exp(np.mean(np.log(ratio))) < 0.62


def test_what_is_not_identified_keeps_its_value() -> None:
    height = "vehicle.body.cg_height_m"
    found = calibrate(drive(), "elevate", SOIL, (*NAMES, height))
    assert found[height].status == "not identified"
    assert found[height].value == nominal().value(height)
    assert found[height].sigma == pytest.approx(0.1, rel=0.02)
    assert any(height in direction.sentence for direction in found.identifiability.weak)


def test_a_slope_is_suggested_for_the_height_of_the_centre_of_gravity() -> None:
    """On level ground the height enters no load of the quasi-static twin; on a slope it does."""
    height = "vehicle.body.cg_height_m"
    found = calibrate(drive(), "elevate", SOIL, (*NAMES[:2], height))
    best = suggest(found, (("spin", 0.0), ("circle", 10.0)))
    assert [(s.name, s.scenario, s.slope_deg) for s in best] == [(height, "circle", 10.0)]
    assert best[0].ratio_then < 0.8 < best[0].ratio_now
    assert "slope of 10 deg" in best[0].sentence()


def test_two_that_act_as_one_are_reported_in_combination() -> None:
    """Bekker's moduli enter as k_c + b k_phi only."""
    names = (f"{SOIL}.pressure.k_c_n_per_m_n1", f"{SOIL}.pressure.k_phi_n_per_m_n2")
    priors = {names[0]: Prior(1e5, 5e4)}
    found = calibrate(drive(noiseless=True), "elevate", SOIL, (*NAMES, *names), priors=priors)
    assert {found[name].status for name in names} <= {"only in combination", "not identified", "identified"}
    pair = found.identifiability.weak[0]
    assert set(pair.weights) == set(names)
    assert "only in combination" in pair.sentence
    width = load_vehicle("elevate").wheel.width_m
    soil = load_soil(SOIL).pressure
    sums = [
        found[names[0]].value + width * found[names[1]].value,
        soil.k_c_n_per_m_n1 + width * soil.k_phi_n_per_m_n2,
    ]
    assert sums[0] == pytest.approx(sums[1], rel=1e-3)


def test_dead_time() -> None:
    name = "vehicle.drive.dead_time_s"
    found = calibrate(drive(dead_time_s=0.06), "elevate", SOIL, (*NAMES, name))
    assert found[name].value == pytest.approx(0.06, abs=3.5 * found[name].sigma)
    assert found[name].sigma < 0.01


@pytest.mark.parametrize(("source", "late"), [("auto", True), ("wheels", False)])
def test_wheels_that_follow_their_commands_late_are_noted(source: str, late: bool) -> None:
    fit = calibrate(drive(dead_time_s=0.2), "elevate", SOIL, ("vehicle.body.mass_kg",), source=source)
    assert any("s after the dead time of 0.00 s" in note for note in fit.notes) == late


def test_driven_by_measured_wheels() -> None:
    names = NAMES[:4]
    mass = {"vehicle.body.mass_kg": TRUTH["vehicle.body.mass_kg"]}
    vehicle = nominal().replaced(mass).vehicle
    found = calibrate(drive(), vehicle, SOIL, names, source="wheels")
    for name in names[1:]:
        assert found[name].value == pytest.approx(TRUTH[name], rel=0.02, abs=4.0 * found[name].sigma)
    assert not any(c.channel.startswith("wheel") for c in found.channels)
    assert any("measured wheel speeds" in note for note in found.notes)
    assert not any(note.startswith("commands were limited") for note in found.notes)
    with pytest.raises(DataError, match="cannot be identified"):
        calibrate(drive(), "elevate", SOIL, ("vehicle.drive.lag_s",), source="wheels")


def test_outliers_are_weighed_down() -> None:
    clean = drive()
    gnss = clean.gnss
    assert gnss is not None
    enu = gnss.enu_m.copy()
    enu[::9] += 3.0
    corrupt = dataclasses.replace(clean, gnss=dataclasses.replace(gnss, enu_m=enu))
    name = "vehicle.wheel.radius_m"
    channels = ("wheel", "gnss", "yaw")
    plain = calibrate(corrupt, "elevate", SOIL, NAMES[:4], channels=channels)
    robust = calibrate(corrupt, "elevate", SOIL, NAMES[:4], channels=channels, robust=True)
    assert robust[name].sigma < plain[name].sigma
    assert abs(robust[name].value - TRUTH[name]) < 4.0 * robust[name].sigma


def test_priors_and_ranges() -> None:
    name = f"{SOIL}.shear.friction_cap"
    tight = calibrate(drive(), "elevate", SOIL, NAMES, priors={name: Prior(0.5, 1e-4)})
    assert tight[name].value == pytest.approx(0.5, abs=1e-3)
    with pytest.raises(ConfigError, match="out of range"):
        calibrate(drive(), "elevate", SOIL, NAMES, priors={name: Prior(7.0, 0.1)})
    with pytest.raises(ConfigError, match="not calibrated"):
        calibrate(drive(), "elevate", SOIL, NAMES[1:], priors={name: Prior(0.5, 0.1)})


def test_files_load_again(tmp_path) -> None:
    found = fitted()
    write_files(found, tmp_path, "elevate")
    assert load_vehicle(tmp_path / "vehicle.yaml") == found.model.vehicle
    assert load_soil(tmp_path / "soil.yaml") == found.model.soils[SOIL]
    assert "calibrated from short: 1 sigma" in (tmp_path / "soil.yaml").read_text()


@pytest.mark.parametrize(
    ("names", "word"),
    [
        (("soil.shear.friktion_cap",), "unknown parameter"),
        (("vehicle.body.mass",), "did you mean vehicle.body.mass_kg"),
        (("soil.vibration.low_hz",), "no log can identify it"),
        (("vehicle.body.mass_kg", "vehicle.body.mass_kg"), "twice"),
        ((), "no parameter"),
    ],
)
def test_names_that_cannot_be_calibrated(names: tuple[str, ...], word: str) -> None:
    with pytest.raises(ConfigError, match=word):
        calibrate(drive(), "elevate", SOIL, names)


@pytest.mark.parametrize(
    ("given", "word"),
    [
        ({"channels": "gyro"}, "unknown channel 'gyro'; known are .*yaw_rate_radps"),
        ({"channels": ("gnss", 3)}, "'channels' is"),
        ({"effects": {"slop": 0.05}}, "unknown effect 'slop'; did you mean slope"),
        ({"effects": {"slope": 5.0}}, "effect 'slope/uniform' is 5.0, out of range"),
        ({"window_s": "long"}, "'window_s' is 'long'; give a number in"),
        ({"priors": ("x", 1.0)}, "priors are"),
    ],
)
def test_arguments_that_mean_nothing(given, word: str) -> None:
    with pytest.raises(ConfigError, match=word):
        calibrate(drive(), "elevate", SOIL, NAMES, **given)


def test_one_channel_is_that_channel(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("terrafusion.twin.calibrate.solver.MAX_RUNS", 1)
    found = calibrate(drive(), "elevate", SOIL, NAMES[:1], channels="gnss_east")
    assert {channel.channel for channel in found.channels} == {"gnss_east_m"}


def test_logs_that_lack_what_is_needed() -> None:
    bare = Recording("bare", 0, imu=drive().imu)
    with pytest.raises(DataError, match="neither commands nor wheel speeds"):
        calibrate(bare, "elevate", SOIL, NAMES)
    with pytest.raises(DataError, match="no commands"):
        calibrate(dataclasses.replace(drive(), command=None), "elevate", SOIL, NAMES, source="command")
    with pytest.raises(DataError, match="nothing in the log"):
        calibrate(dataclasses.replace(drive(), gnss=None), "elevate", SOIL, NAMES, channels=("gnss",))
    lost = dataclasses.replace(drive(), terrain=None, terrain_name="moon")
    with pytest.raises(DataError, match="no soil of the library"):
        calibrate(lost, "elevate", None, NAMES[2:])


def test_a_step_to_where_derivatives_diverge_is_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    plain, calls = Problem.blocks, itertools.count()

    def blocks(self: Problem, point: Point) -> list[ResidualBlock]:
        found = plain(self, point)
        if next(calls) == 1:
            found[0] = dataclasses.replace(found[0], change=np.full_like(found[0].change, 1e200))
        return found

    monkeypatch.setattr(Problem, "blocks", blocks)
    found = calibrate(drive(), soils=SOIL, parameters=NAMES)
    assert found.converged()
    for f in found.fitted:
        assert abs(f.value - TRUTH[f.name]) < 4.0 * f.sigma


def test_a_dead_time_among_the_effects_delays_the_inputs_as_that_of_the_vehicle_does() -> None:
    recording, late_s = drive(), 0.15
    log = prepare(recording, nominal())
    plain = nominal().replaced({"vehicle.drive.dead_time_s": nominal().vehicle.drive.dead_time_s + late_s})
    on_top = nominal().replaced({"effects.dead_time/transport": late_s})
    both = (predict(log, model, NAMES, log.start) for model in (plain, on_top))
    for one, other in zip(*both, strict=True):
        np.testing.assert_allclose(one.value, other.value, atol=1e-9)
