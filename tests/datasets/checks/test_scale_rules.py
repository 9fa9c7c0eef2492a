"""What is made of a measured scale of wheels or gyro: thresholds, words and repairs."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from terrafusion.datasets.checks import scale
from terrafusion.datasets.checks.finding import CheckContext, Finding
from terrafusion.datasets.checks.path import PathScale, scales
from terrafusion.datasets.core.bootstrap import BootstrapInterval
from terrafusion.datasets.core.channels import Fix, Gnss, Imu, Wheels
from terrafusion.datasets.core.recording import Overrides, Recording
from terrafusion.datasets.core.trajectory import Trajectory
from tests.datasets.conftest import RADIUS_M, make_drive


@pytest.fixture(scope="module")
def drive() -> Recording:
    """Clean, on grass; its wheels are in rad/s."""
    found = make_drive()
    return dataclasses.replace(found, overrides=Overrides(wheel_radius_m=RADIUS_M), terrain_name="grass")


def judged(
    recording: Recording,
    monkeypatch: pytest.MonkeyPatch,
    ratio: float,
    half: float = 0.001,
    *,
    spread: float = 0.15,
    source: str = "gnss",
    wheel_scale: float = 0.0,
    weight: np.ndarray | None = None,
) -> list[Finding]:
    """Findings where the ground speed is `ratio` times the wheels', to within `half`."""
    scales_of_windows = ratio * np.array([1.0 - spread, 1.0, 1.0 + spread])
    fits = SimpleNamespace(scale=scales_of_windows, weight=np.ones(3) if weight is None else weight)
    wide = PathScale(3.0, 0.1, 9.0, 5, "truth"), fits
    found = PathScale(ratio, ratio - half, ratio + half, 12, source), fits
    monkeypatch.setattr(scale, "scales", lambda _: [wide, found])
    monkeypatch.setattr(CheckContext, "known", lambda self, name: wheel_scale)
    return list(scale.check_speed_scale(CheckContext(recording, None)))


def test_without_a_gyro_the_scale_is_that_of_straight_stretches() -> None:
    """A chord is shorter than the path of a bend: the wheels seemed to read 4 % too much."""
    t_s = np.arange(0.0, 240.0, 0.1)
    rate = np.where(t_s % 60.0 < 30.0, 0.0, 0.3 * np.sin(2.0 * np.pi * t_s / 15.0))
    place = np.cumsum(np.exp(1j * np.cumsum(rate) * 0.1)) * 0.1
    t_ns = np.round(t_s * 1e9).astype(np.int64)
    zero = np.zeros(len(t_s))
    truth = Trajectory(t_ns, np.column_stack([place.real, place.imag, zero]))
    wheels = Wheels(t_ns, np.full((len(t_s), 2), 1.02), ("left", "right"), unit="mps")
    log = Recording(name="bends", start_ns=0, wheels=wheels, truth=truth)
    ((found, _),) = scales(CheckContext(log, None))
    assert found.ratio == pytest.approx(1.0 / 1.02, rel=2e-3)


@pytest.mark.parametrize("delay_s", [0.0, 0.3])
def test_an_antenna_whose_place_is_unknown_does_not_lengthen_the_path(delay_s: float) -> None:
    """In turns an antenna 2.5 m ahead drives further than the robot: the wheels seemed to read too little."""
    rng, t_s = np.random.default_rng(0), np.arange(0.0, 300.0, 0.05)
    yaw = 1.5 * np.sin(2.0 * np.pi * t_s / 20.0) + 0.4 * np.sin(2.0 * np.pi * t_s / 7.0)
    rate, ahead = np.gradient(yaw, t_s), np.exp(1j * yaw)
    fix = np.cumsum(ahead) * 0.05 + (2.5 + 0.6j) * ahead + 0.02 * (rng.normal(size=(len(t_s), 2)) @ [1, 1j])
    t_ns, zero = np.round(t_s * 1e9).astype(np.int64), np.zeros(len(t_s))
    few = slice(None, None, 4)
    fixes = Gnss(
        t_ns[few] + round(delay_s * 1e9), np.column_stack([fix.real, fix.imag, zero])[few],
        np.full((len(t_s[few]), 3), 0.02), np.full(len(t_s[few]), Fix.FIXED, dtype=np.uint8),
    )  # fmt: skip
    imu = Imu(t_ns, np.column_stack([zero, zero, rate]), np.column_stack([zero, rate, zero + 9.81]))
    wheels = Wheels(t_ns, np.full((len(t_s), 1), 1.0), ("speed",), unit="mps")
    log = Recording(name="long arm", start_ns=0, wheels=wheels, imu=imu, gnss=fixes)
    ((found, _),) = scales(CheckContext(log, None))
    assert found.ratio == pytest.approx(1.0, abs=5e-3)
    assert found.low < 1.0 < found.high


def codes(findings: list[Finding]) -> list[str]:
    return [finding.code for finding in findings]


@pytest.mark.parametrize(
    ("ratio", "half", "wheel_scale", "found"),
    [
        (1.0, 0.001, 0.0, []), (1.039, 0.001, 0.0, []), (1.041, 0.001, 0.0, ["wheel-radius"]),
        (1.041, 0.022, 0.0, []), (1.041, 0.02, 0.0, ["wheel-radius"]), (1.09, 0.001, 0.05, []),
        (1.093, 0.001, 0.05, ["wheel-radius"]), (1.093, 0.023, 0.05, []),
        (0.801, 0.15, 0.0, []), (0.799, 0.15, 0.0, ["wheel-scale"]),
        (0.93, 0.009, 0.0, ["wheel-scale"]), (0.93, 0.011, 0.0, []), (0.98, 0.001, 0.05, ["wheel-scale"]),
        (0.99, 0.001, 0.05, []),
    ],
)  # fmt: skip
def test_from_which_ratio_on(
    drive: Recording, monkeypatch: pytest.MonkeyPatch, ratio: float, half: float, wheel_scale: float,
    found: list[str],
) -> None:  # fmt: skip
    assert codes(judged(drive, monkeypatch, ratio, half, wheel_scale=wheel_scale)) == found


def test_the_narrower_interval_counts_and_its_source_is_named(
    drive: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    (finding,) = judged(drive, monkeypatch, 1.1, source="truth")
    assert finding.evidence == (
        "1.099 to 1.101 (95 %) in 12 stretches by the truth; scores against this truth are then not "
        "independent of it"
    )
    (finding,) = judged(drive, monkeypatch, 1.1)
    assert finding.evidence == "1.099 to 1.101 (95 %) in 12 stretches by the gnss"


def test_a_larger_wheel_is_repaired_by_its_radius_or_the_speeds(
    drive: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    (finding,) = judged(drive, monkeypatch, 1.1)
    assert f"a wheel radius of {1.1 * RADIUS_M:.4f} m instead of {RADIUS_M:.4f} m" in finding.fix
    assert finding.what.startswith("ground speed is 1.100 times the wheel speed")
    assert finding.repair is not None
    assert finding.repair(drive).overrides.wheel_radius_m == pytest.approx(1.1 * RADIUS_M)
    assert drive.wheels is not None
    metres = dataclasses.replace(
        drive, wheels=dataclasses.replace(drive.wheels, unit="mps", speed=drive.wheels.speed * RADIUS_M)
    )
    (finding,) = judged(metres, monkeypatch, 1.1)
    assert finding.fix == "multiply the speeds by 1.100"
    assert finding.repair is not None
    repaired = finding.repair(metres).wheels
    assert repaired is not None
    assert repaired.speed == pytest.approx(1.1 * drive.wheels.speed * RADIUS_M)


def test_a_ratio_that_changes_between_stretches_is_no_radius(
    drive: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On mecanum wheels that drive aslant, the ground was 1.67 times the wheels: a radius was put in."""
    (finding,) = judged(drive, monkeypatch, 1.67, spread=0.37)
    assert (finding.code, finding.repair) == ("wheel-radius", None)
    assert "changes by 30% between stretches" in finding.fix
    assert "mecanum" in finding.fix


@pytest.mark.parametrize(
    ("ratio", "half", "repaired"),
    [(2.19, 0.001, True), (2.21, 0.001, False), (1.4, 0.13, True), (1.4, 0.15, False)],
)
def test_beyond_twice_the_radius_and_where_stretches_disagree_nothing_is_repaired(
    drive: Recording, monkeypatch: pytest.MonkeyPatch, ratio: float, half: float, repaired: bool
) -> None:
    silent = dataclasses.replace(drive, command=None)
    (finding,) = judged(silent, monkeypatch, ratio, half)
    assert (finding.repair is not None) == repaired
    assert ("check wheel radius and unit" in finding.fix) != repaired
    assert ("both are of one robot" in finding.fix) == (half == 0.15)


def sloping(drive: Recording, descent: float) -> Recording:
    """Straight for 100 m, down by a share of it."""
    gnss = drive.gnss
    assert gnss is not None
    way = np.linspace(0.0, 100.0, len(gnss))
    enu = np.stack([0.6 * way, 0.8 * way, 7.0 - descent * way], axis=1)
    enu[3] = np.nan
    return dataclasses.replace(drive, gnss=dataclasses.replace(gnss, enu_m=enu))


@pytest.mark.parametrize(("descent", "repaired"), [(0.04, True), (0.06, False), (-0.2, True)])
def test_downhill_wheels_may_be_braked(
    drive: Recording, monkeypatch: pytest.MonkeyPatch, descent: float, repaired: bool
) -> None:
    (finding,) = judged(sloping(drive, descent), monkeypatch, 1.1)
    assert (finding.repair is not None) == repaired
    assert ("downhill on braked wheels" in finding.fix) != repaired


def test_a_descent_needs_fixes_that_lie_apart(drive: Recording) -> None:
    assert scale._descent(sloping(drive, 0.1)) == pytest.approx(0.1)
    assert scale._descent(dataclasses.replace(drive, gnss=None)) == 0.0
    assert drive.gnss is not None
    for count in (0, 1):
        few = dataclasses.replace(drive, gnss=drive.gnss.select(np.arange(len(drive.gnss)) < count))
        assert scale._descent(few) == 0.0
    near = sloping(drive, 0.5)
    assert near.gnss is not None
    for metres, descent in ((0.9, 0.0), (1.1, 0.5)):
        enu = near.gnss.enu_m * 0.01 * metres
        short = dataclasses.replace(near, gnss=dataclasses.replace(near.gnss, enu_m=enu))
        assert scale._descent(short) == pytest.approx(descent)


def test_rad_s_in_a_column_of_m_s_is_a_possible_reason(
    drive: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert drive.wheels is not None
    log = dataclasses.replace(drive, wheels=dataclasses.replace(drive.wheels, unit="mps"))
    (finding,) = judged(log, monkeypatch, 0.117, spread=0.2)
    assert finding.fix.endswith("and unit: rad/s of a wheel with a radius of 0.117 m would read so")
    (finding,) = judged(log, monkeypatch, 0.7)
    assert finding.fix.endswith("check wheel speeds and unit")


def test_soft_ground_explains_slip(drive: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    assert codes(judged(drive, monkeypatch, 0.7)) == ["wheel-scale"]
    (finding,) = judged(drive, monkeypatch, 0.7)
    assert finding.what == "the wheels read 42.9% too much: ground speed is 0.700 times the wheel speed"
    assert f"({0.7 * RADIUS_M:.4f} m fits)" in finding.fix
    for soft in ("mud", "loose_sand", "ice"):
        assert not judged(dataclasses.replace(drive, terrain_name=soft), monkeypatch, 0.7)
    assert drive.terrain is not None
    for last, found in (("asphalt", 1), ("mud", 0)):
        label = np.array(["asphalt"] * (len(drive.terrain) - 1) + [last], dtype=object)
        terrain = dataclasses.replace(drive.terrain, label=label)
        labelled = dataclasses.replace(drive, terrain_name=None, terrain=terrain)
        assert len(judged(labelled, monkeypatch, 0.7)) == found


@pytest.mark.parametrize(
    ("ratio", "name", "factor"),
    [
        (2.0 * np.pi / 60.0, "rev/min", 2.0 * np.pi / 60.0), (np.pi / 180.0, "deg/s", np.pi / 180.0),
        (2.0 * np.pi, "rev/s or m/s", None),
    ],
)  # fmt: skip
def test_units_that_explain_the_ratio(
    drive: Recording, monkeypatch: pytest.MonkeyPatch, ratio: float, name: str, factor: float | None
) -> None:
    """Of wheels that are fast and even; without a command."""
    assert drive.wheels is not None
    fast = dataclasses.replace(drive.wheels, speed=drive.wheels.speed / ratio * 5.0)
    silent = dataclasses.replace(drive, wheels=fast, command=None)
    (finding,) = judged(silent, monkeypatch, ratio, spread=0.05)
    assert finding.code == "wheel-unit"
    assert f"look like {name}:" in finding.what
    if factor is None:
        assert finding.repair is None
        assert finding.fix == "give the unit: more than one fits"
    else:
        assert finding.repair is not None
        repaired = finding.repair(silent).wheels
        assert repaired is not None
        assert repaired.speed == pytest.approx(factor * fast.speed)
    if ratio < 1.0:
        assert codes(judged(silent, monkeypatch, ratio, spread=0.2)) == ["wheel-scale"], "uneven"
        assert codes(judged(silent, monkeypatch, 0.85 * ratio, spread=0.05)) == ["wheel-scale"], "no unit"
        slow = dataclasses.replace(silent, wheels=dataclasses.replace(fast, speed=fast.speed * 1e-3))
        assert codes(judged(slow, monkeypatch, ratio, spread=0.05)) == ["wheel-scale"], "a usual speed"


@pytest.mark.parametrize(("name", "factor"), [("km/h", 1.0 / 3.6), ("cm/s", 0.01), ("mm/s", 0.001)])
def test_units_of_speeds(drive: Recording, monkeypatch: pytest.MonkeyPatch, name: str, factor: float) -> None:
    assert drive.wheels is not None
    speed = drive.wheels.speed * RADIUS_M / factor
    other = dataclasses.replace(drive, wheels=dataclasses.replace(drive.wheels, unit="mps", speed=speed))
    (finding,) = judged(other, monkeypatch, factor)
    assert f"look like {name}:" in finding.what
    assert finding.fix == f"multiply them by {factor:.6g}"


@pytest.mark.parametrize(("weight", "code"), [(None, "wheel-scale"), ([0.001, 1.0, 0.001], "wheel-unit")])
def test_short_windows_do_not_make_a_ratio_uneven(
    drive: Recording, monkeypatch: pytest.MonkeyPatch, weight: list[float] | None, code: str
) -> None:
    """Beside coarse fixes the robot's first metres have a scale of their own."""
    assert drive.wheels is not None
    fast = dataclasses.replace(drive.wheels, speed=drive.wheels.speed * 180.0 / np.pi)
    degrees = dataclasses.replace(drive, command=None, wheels=fast)
    weights = None if weight is None else np.array(weight)
    found = judged(degrees, monkeypatch, np.pi / 180.0, spread=0.6, weight=weights)
    assert codes(found) == [code]


def test_a_command_decides_between_units(drive: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    assert scale.command_ratio(CheckContext(drive, None)) == pytest.approx(1.0, abs=0.05)
    assert drive.wheels is not None
    for factor in (2.0 * np.pi / 60.0, 2.0 * np.pi):
        other = dataclasses.replace(
            drive, wheels=dataclasses.replace(drive.wheels, speed=drive.wheels.speed / factor)
        )
        context = CheckContext(other, None)
        assert scale.command_ratio(context) == pytest.approx(factor, rel=0.05)
        assert codes(judged(other, monkeypatch, factor)) == ["wheel-unit"]
        assert codes(judged(other, monkeypatch, factor * 1.09)) == ["wheel-unit"]
        assert codes(judged(other, monkeypatch, factor * 1.12)) != ["wheel-unit"]
    assert codes(judged(drive, monkeypatch, 2.0 * np.pi / 60.0)) == ["wheel-scale"], "the command agrees"


def test_a_command_that_the_wheels_do_not_follow_says_nothing(drive: Recording) -> None:
    assert drive.command is not None
    for v_mps in (
        np.full(len(drive.command), np.nan),
        np.zeros(len(drive.command)),
        np.where(np.arange(len(drive.command)) < 9, 1.0, np.nan),
        np.random.default_rng(0).normal(1.0, 3.0, size=len(drive.command)),
    ):
        other = dataclasses.replace(drive, command=dataclasses.replace(drive.command, v_mps=v_mps))
        assert scale.command_ratio(CheckContext(other, None)) is None
    assert scale.command_ratio(CheckContext(dataclasses.replace(drive, command=None), None)) is None


@pytest.mark.parametrize(
    ("value", "half", "words"),
    [
        (0.03, 0.015, "3.0% too much"), (-0.03, 0.015, "3.0% too little"), (0.019, 0.001, ""),
        (0.021, 0.001, "2.1% too much"), (0.021, 0.012, ""), (0.199, 0.001, "19.9% too much"),
        (0.201, 0.001, ""), (-0.201, 0.001, ""), (0.1, 0.0249, "10.0% too much"), (0.1, 0.0251, ""),
    ],
)  # fmt: skip
def test_from_which_gyro_scale_on(
    drive: Recording, monkeypatch: pytest.MonkeyPatch, value: float, half: float, words: str
) -> None:
    error = BootstrapInterval(value, value - half, value + half)
    monkeypatch.setattr(scale, "_by_truth", lambda _: None)
    monkeypatch.setattr(scale, "_by_path", lambda _: (error, "the path of the fixes"))
    found = list(scale.check_gyro_scale(CheckContext(drive, None)))
    assert [finding.what for finding in found] == ([f"gyro z reads {words}"] if words else [])
    if words:
        assert found[0].evidence == (
            f"{1.0 + value:.4f} times the turns by the path of the fixes, 95 % interval "
            f"{1.0 + value - half:.4f} to {1.0 + value + half:.4f}"
        )
        assert found[0].repair is not None
        imu, repaired = drive.imu, found[0].repair(drive).imu
        assert imu is not None
        assert repaired is not None
        assert repaired.gyro_radps == pytest.approx(imu.gyro_radps * [1.0, 1.0, 1.0 / (1.0 + value)])


def test_a_gyro_with_holes_has_no_scale(drive: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    error = BootstrapInterval(0.05, 0.04, 0.06)
    monkeypatch.setattr(scale, "_by_truth", lambda _: (error, "the truth's yaw"))
    assert drive.imu is not None
    for share, found in ((0.009, 1), (0.011, 0)):
        gyro = drive.imu.gyro_radps.copy()
        gyro[: round(share * len(gyro)), 2] = np.nan
        holed = dataclasses.replace(drive, imu=dataclasses.replace(drive.imu, gyro_radps=gyro))
        findings = list(scale.check_gyro_scale(CheckContext(holed, None)))
        assert len(findings) == found
        assert all(one.evidence.endswith(scale.NOT_INDEPENDENT) for one in findings)
    assert not list(scale.check_gyro_scale(CheckContext(dataclasses.replace(drive, imu=None), None)))


def test_the_truth_tells_the_scale_of_the_gyro(drive: Recording) -> None:
    assert drive.imu is not None
    faster = dataclasses.replace(
        drive, imu=dataclasses.replace(drive.imu, gyro_radps=drive.imu.gyro_radps * 1.06)
    )
    for recording, value in ((drive, 0.0), (faster, 0.06)):
        found = scale._by_truth(CheckContext(recording, None))
        assert found is not None
        interval, source = found
        assert source == "the truth's yaw"
        assert interval.value == pytest.approx(value, abs=0.006)
        assert interval.low < interval.value < interval.high
        assert interval.high - interval.low < 0.05
    assert scale._by_truth(CheckContext(dataclasses.replace(drive, truth=None), None)) is None
    assert drive.truth is not None
    for end_s, enough in ((54, True), (50, False)):
        truth = drive.truth.select(drive.truth.t_ns < drive.start_ns + end_s * 10**9)
        shorter = CheckContext(dataclasses.replace(drive, truth=truth), None)
        assert (scale._by_truth(shorter) is not None) == enough


@pytest.mark.parametrize("factor", [0.92, 1.1])
def test_the_path_tells_by_how_much_the_gyro_is_wrong(factor: float) -> None:
    """A repair by the path made 1.1 times the turns 1.21 times."""
    t_s = np.arange(0.0, 300.0, 0.05)
    rate = 0.4 * np.sin(2.0 * np.pi * t_s / 41.0) + 0.1
    place = np.cumsum(np.exp(1j * np.cumsum(rate) * 0.05)) * 0.05
    t_ns, zero = np.round(t_s * 1e9).astype(np.int64), np.zeros(len(t_s))
    log = Recording(
        name="bends", start_ns=0,
        wheels=Wheels(t_ns, np.ones((len(t_s), 2)), ("left", "right"), unit="mps"),
        imu=Imu(t_ns, factor * np.column_stack([zero, zero, rate]), np.tile([0.0, 0.0, 9.81], (len(t_s), 1))),
        truth=Trajectory(t_ns, np.column_stack([place.real, place.imag, zero])),
    )  # fmt: skip
    (found,) = scale.check_gyro_scale(CheckContext(log, None))
    assert found.what.startswith(
        "gyro z reads 10.0% too much" if factor > 1.0 else "gyro z reads 8.0% too li"
    )
    assert found.repair is not None
    repaired = found.repair(log).imu
    assert repaired is not None
    assert repaired.gyro_radps[:, 2] == pytest.approx(rate, rel=2e-3, abs=1e-4)


@pytest.mark.parametrize(
    ("windows", "low", "used"),
    [(7, 0.04, None), (8, 0.04, "the path of the truth"), (7, 0.0501, "the path of the truth")],
)
def test_a_path_of_few_stretches_tells_clear_errors_only(
    drive: Recording, monkeypatch: pytest.MonkeyPatch, windows: int, low: float, used: str | None
) -> None:
    error = BootstrapInterval(0.06, low, 0.07)
    model = SimpleNamespace(windows=windows, gyro_scale=error)
    monkeypatch.setattr(scale, "model_by_fixes", lambda _: None)
    monkeypatch.setattr(scale, "model_by_truth", lambda _: model)
    found = scale._by_path(CheckContext(drive, None))
    assert found == (None if used is None else (error, used))
