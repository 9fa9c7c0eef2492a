"""Log checks: a clean run has no finding, each fault has its own."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from terrafusion.datasets.checks import run, run_checks
from terrafusion.datasets.checks.finding import CheckContext, Finding, once
from terrafusion.datasets.core.channels import Gnss
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import Rig


def test_clean_drive_has_no_finding(drive: Recording, husky_rig: Rig) -> None:
    assert run_checks(drive) == []
    assert run_checks(drive, husky_rig) == []


def imu_gap(r: Recording) -> Recording:
    assert r.imu is not None
    return dataclasses.replace(
        r, imu=r.imu.select(~((np.arange(len(r.imu)) > 2000) & (np.arange(len(r.imu)) < 2100)))
    )


def wheel_jitter(r: Recording) -> Recording:
    assert r.wheels is not None
    late = np.random.default_rng(1).integers(0, 10**8, len(r.wheels))
    return dataclasses.replace(r, wheels=dataclasses.replace(r.wheels, t_ns=np.sort(r.wheels.t_ns + late)))


def repeated_times(r: Recording) -> Recording:
    assert r.gnss is not None
    return dataclasses.replace(
        r, gnss=r.gnss.select(np.repeat(np.arange(len(r.gnss)), [2, *[1] * (len(r.gnss) - 1)]))
    )


def held_wheels(r: Recording) -> Recording:
    assert r.wheels is not None
    index = np.arange(len(r.wheels)) // 4 * 4
    return dataclasses.replace(r, wheels=dataclasses.replace(r.wheels, speed=r.wheels.speed[index]))


def turned_imu(r: Recording) -> Recording:
    assert r.imu is not None
    return dataclasses.replace(r, imu=dataclasses.replace(r.imu, accel_mps2=r.imu.accel_mps2[:, [0, 2, 1]]))


def imu_down(r: Recording) -> Recording:
    assert r.imu is not None
    return dataclasses.replace(r, imu=dataclasses.replace(r.imu, accel_mps2=-r.imu.accel_mps2))


def accel_in_g(r: Recording) -> Recording:
    assert r.imu is not None
    return dataclasses.replace(r, imu=dataclasses.replace(r.imu, accel_mps2=r.imu.accel_mps2 / 9.81))


def no_gravity(r: Recording) -> Recording:
    assert r.imu is not None
    return dataclasses.replace(r, imu=dataclasses.replace(r.imu, accel_mps2=r.imu.accel_mps2 - [0, 0, 9.81]))


def gyro_flipped(r: Recording) -> Recording:
    assert r.imu is not None
    return dataclasses.replace(r, imu=dataclasses.replace(r.imu, gyro_radps=-r.imu.gyro_radps))


def left_negative(r: Recording) -> Recording:
    assert r.wheels is not None
    return dataclasses.replace(r, wheels=dataclasses.replace(r.wheels, speed=r.wheels.speed * [-1.0, 1.0]))


def zero_sigma(r: Recording) -> Recording:
    assert r.gnss is not None
    sigma = r.gnss.sigma_enu_m.copy()
    sigma[10, 0], sigma[20, 1], sigma[30, 1] = 0.0, -1.0, np.nan
    return dataclasses.replace(r, gnss=dataclasses.replace(r.gnss, sigma_enu_m=sigma))


def gnss_jump(r: Recording) -> Recording:
    assert r.gnss is not None
    enu = r.gnss.enu_m.copy()
    enu[100:] += [4.0, 3.0, 0.0]
    return dataclasses.replace(r, gnss=dataclasses.replace(r.gnss, enu_m=enu))


def wrong_radius(r: Recording) -> Recording:
    return dataclasses.replace(r, overrides=dataclasses.replace(r.overrides, wheel_radius_m=0.25))


def other_clock(r: Recording) -> Recording:
    assert r.gnss is not None
    return dataclasses.replace(r, gnss=dataclasses.replace(r.gnss, t_ns=r.gnss.t_ns + 10**12))


FAULTS: list[tuple[Callable[[Recording], Recording], str, str, str]] = [
    (imu_gap, "warning", "imu", "1 gap"),
    (wheel_jitter, "warning", "wheels", "uneven sampling"),
    (repeated_times, "warning", "gnss", "1 repeated times"),
    (held_wheels, "warning", "wheels", "values are held"),
    (turned_imu, "error", "imu", "gravity stands on +y"),
    (imu_down, "error", "imu", "gravity stands on -z"),
    (accel_in_g, "error", "imu", "looks like g"),
    (no_gravity, "error", "imu", "not 9.8"),
    (gyro_flipped, "error", "imu", "against the wheels"),
    (left_negative, "error", "wheels", "against each other"),
    (zero_sigma, "error", "gnss", "3 of 300 fixes"),
    (gnss_jump, "warning", "gnss", "1 jump"),
    (wrong_radius, "warning", "wheels", "times the wheel speed"),
    (other_clock, "error", "gnss", "begins after"),
]


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault[0].__name__)
def test_each_fault_is_found(drive: Recording, fault: tuple[Callable[..., Recording], str, str, str]) -> None:
    corrupt, severity, channel, what = fault
    findings = run_checks(corrupt(drive))
    assert (severity, channel) in [(f.severity, f.channel) for f in findings]
    found = next(f for f in findings if f.channel == channel and what in f.what)
    assert found.evidence
    assert found.fix
    assert set(found.to_dict()) == {"code", "severity", "channel", "what", "evidence", "fix", "repairable"}


def test_held_value_count_is_given(drive: Recording) -> None:
    found = next(f for f in run_checks(held_wheels(drive)) if f.what == "values are held")
    assert "every 4" in found.evidence


def test_fixes_held_over_rows_are_found_however_long_the_drive() -> None:
    t_s = np.arange(0.0, 200.0, 0.1)
    enu_m = np.stack([np.floor(t_s), 0.0 * t_s, 0.0 * t_s], axis=1)
    gnss = Gnss((t_s * 1e9).astype(np.int64), enu_m, 0.0 * enu_m + 1.0, np.ones(len(t_s), dtype=np.uint8))
    (found,) = run_checks(Recording("long", 0, gnss=gnss))
    assert (found.code, found.channel) == ("held-values", "gnss")
    assert "every 10" in found.evidence


def test_errors_come_first(drive: Recording) -> None:
    severities = [f.severity for f in run_checks(gyro_flipped(imu_gap(drive)))]
    assert severities == sorted(severities, key=lambda s: s != "error")


def test_sparse_logs_have_no_finding(drive: Recording) -> None:
    for name, channel in drive.channels().items():
        for n in (1, 2, 5):
            alone = Recording("x", drive.start_ns, **{name: channel.select(slice(0, n))})
            assert run_checks(alone) == [], (name, n)
    assert run_checks(Recording("x", 0)) == []


def test_a_signalling_nan_warns_no_more_than_another(drive: Recording) -> None:
    assert drive.wheels is not None
    speed = drive.wheels.speed.copy()
    speed.view(np.uint64)[5, 0] = 0x7FF0000000000001
    assert np.isnan(speed[5, 0])
    broken = dataclasses.replace(drive, wheels=dataclasses.replace(drive.wheels, speed=speed))
    speed = np.where(np.isnan(speed), np.nan, speed)
    quiet = dataclasses.replace(drive, wheels=dataclasses.replace(drive.wheels, speed=speed))
    assert [f.code for f in run_checks(broken)] == [f.code for f in run_checks(quiet)]


def test_what_several_checks_need_is_computed_once_a_context(drive: Recording) -> None:
    computed: list[CheckContext] = []

    @once
    def count(context: CheckContext) -> int:
        computed.append(context)
        return len(computed)

    context = CheckContext(drive, None)
    assert [count(context), count(context)] == [1, 1]
    assert count(dataclasses.replace(context, recording=drive)) == 2


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_dead_side_is_the_only_finding(drive: Recording, side: str) -> None:
    """And not also the scale of wheels that it brings about."""
    assert drive.wheels is not None
    speed = drive.wheels.speed * np.where([side in name for name in drive.wheels.names], 0.0, 1.0)
    wheels = dataclasses.replace(drive.wheels, speed=speed, angle_rad=None)
    log = dataclasses.replace(drive, wheels=wheels, truth=None, truth_channels=())
    (finding,) = run_checks(log)
    assert (finding.code, finding.channel) == ("dead", "wheels")
    assert finding.what == f"the {side} side stands throughout"


def test_what_another_finding_brings_about_waits_for_its_repair(
    drive: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    kinds = [("wheel-radius", "wheels"), ("stuck", "imu"), ("gaps", "gnss"), ("stuck", "gnss")]

    def found(count: int) -> list[str]:
        findings = [Finding(code, "error", channel, "", "", "") for code, channel in kinds[:count]]
        monkeypatch.setattr(run, "CHECKS", (lambda context: iter(findings),))
        return [finding.code for finding in run_checks(drive)]

    assert found(1) == ["wheel-radius"]
    assert found(4) == ["stuck", "gaps", "stuck"]


def test_counts_of_a_gyro_are_no_degrees(drive: Recording) -> None:
    assert drive.imu is not None
    counts = dataclasses.replace(drive.imu, gyro_radps=np.degrees(drive.imu.gyro_radps) * 131.0)
    (finding,) = run_checks(dataclasses.replace(drive, imu=counts))
    assert (finding.code, finding.repair) == ("impossible-value", None)
    assert "or are these counts" in finding.fix
