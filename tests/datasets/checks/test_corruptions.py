"""One good log, corrupted in many ways: each fault is found and repaired, with no other error."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from terrafusion.datasets.checks import repair, run_checks
from terrafusion.datasets.core.channels import Channel, Wheels
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.frames import enu_to_geodetic
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.robot import KnownNumber, SensorNumbers
from terrafusion.datasets.core.sensors import Rig
from terrafusion.datasets.readers import open_recording
from terrafusion.datasets.writers import write_log_folder
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.scenario.file import load_scenario
from terrafusion.twin.scenario.scenario import Scenario
from terrafusion.twin.simulate import simulate

pytestmark = pytest.mark.usefixtures("checked_once")

SCENARIO = """\
description: straights, turns both ways, a stop, a stretch in reverse
drive:
  - {duration_s: 3}
  - {duration_s: 25, v_mps: 0.9}
  - {duration_s: 8, v_mps: 0.9, yaw_rate_radps: 0.4}
  - {duration_s: 8, v_mps: 0.9, yaw_rate_radps: -0.4}
  - {duration_s: 10, v_mps: 0.6}
  - {duration_s: 4}
  - {duration_s: 6, v_mps: -0.5}
  - {duration_s: 8, v_mps: 0.8, yaw_rate_radps: 0.3}
  - {duration_s: 25, v_mps: 1.0}
  - {duration_s: 3}
max_accel_mps2: 0.8
route:
  - {terrain: asphalt}
"""

Corrupt = Callable[[Recording], Recording]
RADIUS_M = 0.175
"""Of the twin's default vehicle."""


@dataclass(frozen=True)
class Case:
    """A corruption, the code it must be found under, and whether it can be repaired.

    Mended means: of the channel at least `kept` of the rows are left, their times those of the good
    log to `time_s`, their values to `share` of the largest in the column, and no finding but those of
    the codes `left`, such as the gap where bad rows were. The columns `lost` are empty then.
    `good` makes of the good log what the repaired one is to be compared with.
    """

    corrupt: Corrupt
    code: str
    channel: str
    repaired: bool = True
    time_s: float = 0.0
    share: float = 1e-9
    kept: float = 1.0
    left: tuple[str, ...] = ()
    lost: tuple[str, ...] = ()
    good: Corrupt = lambda r: r


@pytest.fixture(scope="module")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> Scenario:
    path = tmp_path_factory.mktemp("scenario") / "good.yaml"
    path.write_text(SCENARIO)
    return load_scenario(path)


@pytest.fixture(scope="module")
def good(scenario: Scenario) -> Recording:
    return simulate(scenario, seed=1)


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_vehicle("elevate").rig()


def change(channel: str, **changed: Callable[[Any], Any]) -> Corrupt:
    """Replace fields of a channel by functions of them."""

    def corrupt(r: Recording) -> Recording:
        before = getattr(r, channel)
        after = {name: function(getattr(before, name)) for name, function in changed.items()}
        return dataclasses.replace(r, **{channel: dataclasses.replace(before, **after)})

    return corrupt


def rows(channel: str, choose: Callable[[Any], Any]) -> Corrupt:
    """Take the chosen rows of a channel, by mask, slice or index."""

    def corrupt(r: Recording) -> Recording:
        before = getattr(r, channel)
        return dataclasses.replace(r, **{channel: before.select(choose(before))})

    return corrupt


def chain(*corruptions: Corrupt) -> Corrupt:
    """One after the other."""
    return lambda r: functools.reduce(lambda done, corrupt: corrupt(done), corruptions, r)


def turned(axes: Any) -> Corrupt:
    """The IMU mounted another way: rows of the matrix are its axes in the body."""
    R = np.array(axes, dtype=float)
    return change("imu", gyro_radps=lambda w: w @ R.T, accel_mps2=lambda a: a @ R.T)


def at(indices: Any, values: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """A function of an array that changes some of its elements."""

    def changed(array: Any) -> Any:
        array = array.copy()
        array[indices] = values(array[indices])
        return array

    return changed


def wheels_scaled(factor: Any) -> Corrupt:
    """Speeds and angles of the wheels times a factor, or one for each wheel."""
    return change("wheels", speed=lambda s: s * factor, angle_rad=lambda a: a * factor)


def in_mps(factor: float) -> Corrupt:
    """Wheel speeds as rim speeds, called m/s, times a factor."""

    def corrupt(r: Recording) -> Recording:
        assert r.wheels is not None
        speed = r.wheels.speed[:, :2] * RADIUS_M * factor
        return dataclasses.replace(r, wheels=Wheels(r.wheels.t_ns, speed, ("left", "right"), "mps"))

    return corrupt


def sigmas(horizontal_m: float, up_m: float) -> Corrupt:
    """The same sigmas for all fixes."""
    return change("gnss", sigma_enu_m=lambda s: 0 * s + [horizontal_m, horizontal_m, up_m])


def noisy_fixes(sigma_m: float) -> Corrupt:
    """Fixes that scatter more, and say so."""
    noise = np.random.default_rng(7).normal(0.0, sigma_m, (501, 3))
    return chain(change("gnss", enu_m=lambda p: p + noise), sigmas(sigma_m, sigma_m))


def dilutions(worth_m: float) -> Corrupt:
    """The dilution of precision that changes with the satellites, times what one is worth."""
    dop = np.random.default_rng(8).integers(7, 13, (501, 1)) / 10
    return change("gnss", sigma_enu_m=lambda s: 0 * s + dop * worth_m * [1.0, 1.0, 2.0])


def without_angles(r: Recording) -> Recording:
    assert r.wheels is not None
    return dataclasses.replace(r, wheels=dataclasses.replace(r.wheels, angle_rad=None))


def held(channel: str, each: int) -> Corrupt:
    """Every value stands for so many rows."""

    def corrupt(r: Recording) -> Recording:
        before = getattr(r, channel)
        index = np.arange(len(before)) // each * each
        return dataclasses.replace(
            r, **{channel: dataclasses.replace(before.select(index), t_ns=before.t_ns)}
        )

    return corrupt


def late(channel: str, by_s: float, after_s: float = -1.0) -> Corrupt:
    """Times later than they were, all of them or those after a moment."""
    return change(channel, t_ns=lambda t: t + np.where(t - t[0] > after_s * 1e9, round(by_s * 1e9), 0))


def _spikes(values: Any) -> Any:
    values = values.copy()
    for k in range(20):
        values[300 + 450 * k, k % 3] += 80.0 * (-1) ** k
    return values


def _ragged(t_ns: Any) -> Any:
    """Times of arrival: late by up to four periods, in order."""
    rng = np.random.default_rng(4)
    return np.sort(t_ns + rng.integers(0, 4 * int(np.median(np.diff(t_ns))), len(t_ns)))


def _in_degrees(r: Recording) -> Recording:
    """Longitude, latitude and height where east, north and up belong."""
    assert r.gnss is not None
    assert r.datum is not None
    place = enu_to_geodetic(r.gnss.enu_m, r.datum)
    return dataclasses.replace(r, gnss=dataclasses.replace(r.gnss, enu_m=place[:, [1, 0, 2]]))


def _swap_east_north(values: Any) -> Any:
    return values[:, [1, 0, 2]]


FLIP_YZ = [[1, 0, 0], [0, -1, 0], [0, 0, -1]]
ON_ITS_SIDE = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
BACKWARDS = [[-1, 0, 0], [0, -1, 0], [0, 0, 1]]
LEFTWARDS = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
HUSKY = [[0, -1, 0], [0, 0, 1], [-1, 0, 0]]


IMU_CASES: dict[str, Case] = {
    "imu: lies on its side": Case(turned(ON_ITS_SIDE), "imu-axes", "imu"),
    "imu: forward, right, down": Case(turned(FLIP_YZ), "imu-axes", "imu"),
    "imu: mounted as on the husky": Case(turned(HUSKY), "imu-axes", "imu"),
    "imu: points backwards": Case(turned(BACKWARDS), "imu-forward", "imu"),
    "imu: points to the left": Case(turned(LEFTWARDS), "imu-forward", "imu"),
    "accel: upside down": Case(change("imu", accel_mps2=np.negative), "imu-axes", "imu"),
    "accel: in g": Case(change("imu", accel_mps2=lambda a: a / 9.80665), "accel-in-g", "imu"),
    "accel: gravity removed": Case(
        change("imu", accel_mps2=lambda a: a - np.array([0.0, 0.0, 9.80665])),
        "accel-magnitude", "imu", good=change("imu", accel_mps2=lambda a: np.full_like(a, np.nan)),
    ),
    "accel: saturated": Case(
        change("imu", accel_mps2=lambda a: np.clip(a, -10.2, 10.2)),
        "saturated", "imu", kept=0.6, left=("missing-values",),
    ),
    "gyro: in deg/s": Case(change("imu", gyro_radps=np.degrees), "gyro-in-degrees", "imu"),
    "gyro: sign of z": Case(change("imu", gyro_radps=lambda w: w * [1, 1, -1]), "yaw-sign", "imu"),
    "gyro: z is stuck": Case(
        change("imu", gyro_radps=lambda w: w * [1, 1, 0] + [0, 0, 0.001]),
        "stuck", "imu", lost=("gyro_z_radps",),
    ),
    "gyro: z stands still": Case(
        change("imu", gyro_radps=lambda w: w * [1, 1, 0]), "stuck", "imu", lost=("gyro_z_radps",)
    ),
    "gyro: z is stuck for 10 s": Case(
        change("imu", gyro_radps=at((slice(3000, 4000), 2), lambda w: w * 0 + w[0])),
        "stuck", "imu", kept=0.89, left=("missing-values",),
    ),
    "gyro: dead": Case(
        change("imu", gyro_radps=lambda w: w * 0),
        "dead", "imu", lost=("gyro_x_radps", "gyro_y_radps", "gyro_z_radps"),
    ),
    "gyro: offset of 3 deg/s": Case(
        change("imu", gyro_radps=lambda w: w + np.array([0.0, 0.0, 0.05])), "gyro-bias", "imu", share=0.01
    ),
    "imu: spikes": Case(change("imu", gyro_radps=_spikes), "spikes", "imu", kept=0.99),
    "imu: held": Case(held("imu", 5), "held-values", "imu", kept=0.2),
    "imu: huge values": Case(
        change("imu", gyro_radps=at((slice(500, 510), 2), lambda w: w * 0 + 1e30)),
        "impossible-value", "imu", kept=0.999,
    ),
}  # fmt: skip

WHEEL_CASES: dict[str, Case] = {
    "wheels: left is negative": Case(wheels_scaled([-1, 1, -1, 1]), "wheel-sign", "wheels"),
    "wheels: right is negative": Case(wheels_scaled([1, -1, 1, -1]), "wheel-sign", "wheels"),
    "wheels: both are negative": Case(wheels_scaled(-1), "wheel-reversed", "wheels"),
    "wheels: left is right": Case(
        change("wheels", speed=lambda s: s[:, [1, 0, 3, 2]], angle_rad=lambda a: a[:, [1, 0, 3, 2]]),
        "wheel-swap", "wheels",
    ),
    "wheels: one of four is dead": Case(
        change("wheels", speed=lambda s: s * [1, 1, 0, 1], angle_rad=lambda a: None),
        "wheel-odd", "wheels", share=0.1, good=without_angles,
    ),
    "wheels: 25 % too fast": Case(wheels_scaled(1.25), "wheel-scale", "wheels", repaired=False),
    "wheels: 25 % too slow": Case(wheels_scaled(0.8), "wheel-radius", "wheels", good=wheels_scaled(0.8)),
    "wheels: rev/min as rad/s": Case(
        change("wheels", speed=lambda s: s * 60 / (2 * np.pi)), "wheel-unit", "wheels"
    ),
    "wheels: m/s as rad/s": Case(
        change("wheels", speed=lambda s: s * RADIUS_M), "wheel-unit", "wheels", repaired=False
    ),
    "wheels: km/h as m/s": Case(in_mps(3.6), "wheel-unit", "wheels", good=in_mps(1.0)),
    "wheels: mm/s as m/s": Case(in_mps(1000.0), "wheel-unit", "wheels", good=in_mps(1.0)),
    "wheels: held": Case(held("wheels", 10), "held-values", "wheels", kept=0.1),
}  # fmt: skip

CLOCK_CASES: dict[str, Case] = {
    "clock: wheels late by 0.4 s": Case(late("wheels", 0.4), "clock-offset", "wheels", time_s=0.03),
    "clock: IMU early by 0.3 s": Case(late("imu", -0.3), "clock-offset", "imu", time_s=0.03),
    "clock: GNSS late by 1000 s": Case(late("gnss", 1000.0), "no-common-time", "gnss", time_s=0.25),
    "clock: GNSS on leap seconds": Case(late("gnss", 18.0), "clock-offset", "gnss", time_s=0.25),
    "clock: wheels jump ahead": Case(late("wheels", 3.0, 50.0), "clock-jump", "wheels", time_s=0.03),
    "clock: wheels drift by 1 %": Case(
        change("wheels", t_ns=lambda t: t[0] + np.rint((t - t[0]) * 1.01).astype(np.int64)),
        "clock-drift", "wheels", time_s=0.1,
    ),
    "clock: repeated times": Case(
        rows("imu", lambda imu: np.sort(np.r_[np.arange(len(imu)), np.arange(100, 9000, 90)])),
        "repeated-times", "imu",
    ),
    "clock: times of arrival": Case(
        change("wheels", t_ns=_ragged), "uneven-sampling", "wheels", time_s=0.08
    ),
    "clock: whole seconds": Case(
        change("wheels", t_ns=lambda t: t // 10**9 * 10**9), "coarse-times", "wheels", time_s=0.03
    ),
    "clock: a gap": Case(
        rows("imu", lambda imu: np.abs(np.arange(len(imu)) - 4000) > 150), "gaps", "imu", repaired=False
    ),
}  # fmt: skip

GNSS_CASES: dict[str, Case] = {
    "gnss: sigma zero": Case(change("gnss", sigma_enu_m=lambda s: s * 0), "sigma-impossible", "gnss"),
    "gnss: some sigmas negative": Case(
        change("gnss", sigma_enu_m=at((slice(50, 60), slice(None)), np.negative)), "sigma-impossible", "gnss"
    ),
    "gnss: some sigmas missing": Case(
        change("gnss", sigma_enu_m=at((slice(50, 60), 1), lambda s: s * np.nan)), "sigma-impossible", "gnss"
    ),
    "gnss: variances as sigmas": Case(
        chain(noisy_fixes(0.1), sigmas(0.1**2, 0.1**2)),
        "sigma-too-small", "gnss", good=noisy_fixes(0.1), share=0.2,
    ),
    "gnss: dilutions as sigmas": Case(
        dilutions(1.0), "sigma-dilution", "gnss", good=dilutions(0.02), share=1e-6
    ),
    "gnss: class none in between": Case(
        change("gnss", fix=at(slice(30, 33), lambda f: f * 0)), "fix-none", "gnss", kept=0.99
    ),
    "gnss: degrees as metres": Case(
        _in_degrees, "gnss-degrees", "gnss", share=1e-4, good=change("gnss", enu_m=lambda p: p - p[0])
    ),
    "gnss: velocity in km/h": Case(
        change("gnss", velocity_enu_mps=lambda v: v * 3.6, sigma_v_mps=lambda s: s * 3.6),
        "gnss-velocity", "gnss",
    ),
    "gnss: jumps": Case(
        change("gnss", enu_m=at((slice(200, 202), slice(0, 2)), lambda p: p + 8.0)),
        "gnss-jumps", "gnss", kept=0.99,
    ),
    "gnss: east and north swapped": Case(
        change("gnss", enu_m=_swap_east_north, velocity_enu_mps=_swap_east_north), "gnss-course", "gnss"
    ),
    "gnss: frozen for 12 s": Case(
        change("gnss", enu_m=at(slice(100, 160), lambda p: p * 0 + p[0])),
        "gnss-frozen", "gnss", kept=0.85, left=("gaps",),
    ),
}  # fmt: skip

CASES = IMU_CASES | WHEEL_CASES | CLOCK_CASES | GNSS_CASES


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("terrain", ["asphalt", "medium_sand", "loose_sand", "mud"])
def test_good_logs_have_no_finding(terrain: str, seed: int, scenario: Scenario, rig: Rig) -> None:
    """Otherwise the cases below would prove little: on no ground, with no noise, level or on a slope."""
    recording = simulate(scenario, terrain=terrain, slope_deg=6.0 * (seed % 2), seed=seed)
    assert run_checks(recording, rig) == []
    assert run_checks(recording) == []


@pytest.mark.parametrize("name", CASES)
def test_corruption_is_found_and_repaired(name: str, good: Recording, rig: Rig) -> None:
    """Found under its code, and no other error; repaired, or left and still reported."""
    case = CASES[name]
    corrupted = case.corrupt(good)
    findings = run_checks(corrupted, rig)
    assert (case.code, case.channel) in {(f.code, f.channel) for f in findings}, findings
    assert {f.code for f in findings if f.severity == "error"} <= {case.code}, findings
    repaired, done = repair(corrupted, rig)
    left = {finding.code for finding in run_checks(repaired, rig)}
    if not case.repaired:
        assert case.code in left
        return
    assert left <= set(case.left)
    assert sum(note.startswith("repaired: ") for note in repaired.notes) == len(done)
    truly = case.good(good)
    for channel in truly.channels():
        own = case if channel == case.channel else Case(case.corrupt, "", "")
        assert_like(getattr(repaired, channel), getattr(truly, channel), own)


def assert_like(repaired: Channel, good: Channel, case: Case) -> None:
    """The repaired channel is the good one, as far as the case allows."""
    assert case.kept * len(good) <= len(repaired) <= len(good)
    index = np.arange(len(good))
    if len(repaired) < len(good):
        after = np.clip(np.searchsorted(good.t_ns, repaired.t_ns), 1, len(good) - 1)
        index = after - (repaired.t_ns - good.t_ns[after - 1] < good.t_ns[after] - repaired.t_ns)
    assert np.abs(repaired.t_ns - good.t_ns[index]).max() <= case.time_s * 1e9
    columns = repaired.columns()
    for name, values in good.columns().items():
        if name in case.lost:
            assert name not in columns
            continue
        if values.dtype == object:
            assert (columns[name] == values[index]).all()
            continue
        known = np.isfinite(columns[name])
        assert known.sum() >= case.kept * len(good)
        error = np.abs(columns[name] - values[index])[known]
        assert error.max() <= case.share * np.abs(values).max() + 1e-12, name


def test_clock_set_back_is_found_and_repaired(good: Recording, rig: Rig, tmp_path: Path) -> None:
    """Times that run back never get into a recording: the reader takes the step out where asked."""
    write_log_folder(good, tmp_path / "log")
    table = tmp_path / "log" / "imu.csv"
    header, *lines = table.read_text().splitlines()
    cells = [line.split(",", 1) for line in lines]
    back = [f"{float(t) - 3.0 * (float(t) > 50.0):.9f},{rest}" for t, rest in cells]
    table.write_text("\n".join([header, *back, ""]))
    with pytest.raises(DataError, match=r"time runs backwards.*--repair-clock"):
        open_recording(tmp_path / "log")
    read = open_recording(tmp_path / "log", repair_clock=True)
    assert [(f.code, f.channel) for f in run_checks(read, rig)] == [("clock-jump", "imu")]
    repaired, _ = repair(read, rig)
    assert run_checks(repaired, rig) == []
    assert good.imu is not None
    assert repaired.imu is not None
    assert_like(repaired.imu, good.imu, Case(lambda r: r, "", "", time_s=1e-6))


def test_what_the_vehicle_file_corrects_is_no_finding(good: Recording, rig: Rig) -> None:
    """Fixes 1.2 s late and wheels that read a fifth too little: warnings, unless the file has both."""
    bare = dataclasses.replace(good, truth=None, command=None)
    wrong = late("gnss", 1.2)(change("wheels", speed=lambda s: s / 1.2, angle_rad=lambda a: None)(bare))
    codes = {finding.code for finding in run_checks(wrong, rig)}
    assert {"clock-offset", "wheel-radius"} <= codes
    learned = SensorNumbers(
        gnss_delay_s=KnownNumber(1.2, "calibrated", 0.05), wheel_scale=KnownNumber(0.2, "calibrated", 0.01)
    )
    known = {finding.code for finding in run_checks(wrong, dataclasses.replace(rig, known=learned))}
    assert codes - known == {"clock-offset", "wheel-radius"}
