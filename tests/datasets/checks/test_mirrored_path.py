"""East and north swapped where fixes are too coarse for courses."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.checks import repair, run_checks
from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.frames import enu_to_geodetic
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate

RIG = load_vehicle("elevate").rig()


@pytest.fixture(scope="module")
def coarse() -> Recording:
    """Two bends, 20 m, with fixes of 2 m that drift."""
    legs = (DriveSegment(3.0), DriveSegment(12.0, 0.8, 0.12), DriveSegment(12.0, 0.8, -0.02))
    scenario = Scenario("bend", 27.0, drive=legs, route=(RouteLeg("asphalt"),))
    return with_fixes(simulate(scenario, seed=2), 0.3)


def with_fixes(log: Recording, noise_m: float) -> Recording:
    """Fixes that report 2 m."""
    gnss = log.gnss
    assert gnss is not None
    noise = np.random.default_rng(1).normal(0.0, noise_m, gnss.enu_m.shape)
    sigma = np.full_like(gnss.sigma_enu_m, 2.0)
    single = np.full_like(gnss.fix, Fix.SINGLE)
    coarse = dataclasses.replace(
        gnss, enu_m=gnss.enu_m + noise, sigma_enu_m=sigma, velocity_enu_mps=None, fix=single
    )
    return dataclasses.replace(log, gnss=coarse)


def swapped(log: Recording) -> Recording:
    gnss = log.gnss
    assert gnss is not None
    return dataclasses.replace(log, gnss=dataclasses.replace(gnss, enu_m=gnss.enu_m[:, [1, 0, 2]]))


def codes(log: Recording) -> set[str]:
    return {finding.code for finding in run_checks(log, RIG)}


def test_swapped_axes_of_coarse_fixes_are_found_and_mended(coarse: Recording) -> None:
    assert "gnss-course" not in codes(coarse)
    assert "gnss-course" in codes(swapped(coarse))
    mended, _ = repair(swapped(coarse), RIG)
    assert mended.gnss is not None
    assert coarse.gnss is not None
    np.testing.assert_allclose(mended.gnss.enu_m, coarse.gnss.enu_m)


def test_velocities_that_are_swapped_with_coarse_fixes_are_mended_with_them() -> None:
    legs = (DriveSegment(3.0), DriveSegment(27.0, 0.8, 0.2), DriveSegment(27.0, 0.8, -0.1))
    coarse = with_fixes(
        simulate(Scenario("bends", 57.0, drive=legs, route=(RouteLeg("asphalt"),)), seed=2), 0.3
    )
    assert coarse.gnss is not None
    assert coarse.truth is not None
    pace = np.gradient(coarse.truth.position_m, coarse.truth.t_ns * 1e-9, axis=0)
    columns = [np.interp(coarse.gnss.t_ns, coarse.truth.t_ns, pace[:, k]) for k in range(3)]
    for order in ([0, 1, 2], [1, 0, 2]):  # the velocities are right, or swapped with the positions
        velocity = np.column_stack(columns)[:, order]
        gnss = dataclasses.replace(coarse.gnss, velocity_enu_mps=velocity)
        mended, _ = repair(swapped(dataclasses.replace(coarse, gnss=gnss)), RIG)
        assert mended.gnss is not None
        np.testing.assert_allclose(mended.gnss.enu_m, coarse.gnss.enu_m)
        np.testing.assert_array_equal(mended.gnss.velocity_enu_mps, np.column_stack(columns))


def test_the_path_tells_latitude_from_longitude_where_courses_do_not() -> None:
    legs = (DriveSegment(3.0), DriveSegment(40.0, 0.8, 0.3))  # one circle: its turn rate is constant
    log = simulate(Scenario("circle", 43.0, drive=legs, route=(RouteLeg("asphalt"),)), seed=2)
    log = dataclasses.replace(log, truth=None, command=None, datum=None)
    assert log.gnss is not None
    degrees = enu_to_geodetic(log.gnss.enu_m, (48.0, 11.0, 500.0))
    first = dataclasses.replace(log.gnss, enu_m=degrees)  # latitude in the column of east
    mended, _ = repair(dataclasses.replace(log, gnss=first), RIG)
    assert mended.gnss is not None
    away = log.gnss.enu_m - log.gnss.enu_m[0]
    np.testing.assert_allclose((mended.gnss.enu_m - mended.gnss.enu_m[0])[:, :2], away[:, :2], atol=0.01)


def test_noise_of_single_fixes_does_not_hide_the_image(coarse: Recording) -> None:
    noisy = with_fixes(coarse, 0.6)
    assert "gnss-course" not in codes(noisy)
    assert "gnss-course" in codes(swapped(noisy))


def test_a_straight_path_or_wild_fixes_show_no_image(coarse: Recording) -> None:
    straight = Scenario("line", 27.0, drive=(DriveSegment(27.0, 0.8),), route=(RouteLeg("asphalt"),))
    assert "gnss-course" not in codes(swapped(with_fixes(simulate(straight, seed=2), 0.3)))
    assert "gnss-course" not in codes(swapped(with_fixes(coarse, 3.0)))


def test_a_gyro_of_the_wrong_sign_is_not_put_down_to_the_fixes(coarse: Recording) -> None:
    imu = coarse.imu
    assert imu is not None
    turned = dataclasses.replace(imu, gyro_radps=imu.gyro_radps * [1.0, 1.0, -1.0])
    found = codes(dataclasses.replace(coarse, imu=turned))
    assert "gnss-course" not in found
    assert "yaw-sign" in found


def test_fixes_too_coarse_for_courses_tell_swapped_wheels_from_a_gyro_of_the_wrong_sign(
    coarse: Recording,
) -> None:
    bare = dataclasses.replace(coarse, truth=None, command=None)
    assert bare.imu is not None
    assert bare.wheels is not None
    gyro = bare.imu.gyro_radps
    level = dataclasses.replace(bare.imu, accel_mps2=np.full_like(gyro, np.nan))
    bare = dataclasses.replace(bare, imu=level)
    assert codes(bare) == set()
    exchanged = dataclasses.replace(bare.wheels, speed=bare.wheels.speed[:, [1, 0, 3, 2]])
    mended, found = repair(dataclasses.replace(bare, wheels=exchanged), RIG)
    assert [finding.code for finding in found] == ["wheel-swap"]
    assert mended.wheels is not None
    np.testing.assert_array_equal(mended.wheels.speed, bare.wheels.speed)
    turned = dataclasses.replace(level, gyro_radps=gyro * [1.0, 1.0, -1.0])
    _, found = repair(dataclasses.replace(bare, imu=turned), RIG)
    assert [(finding.code, "assumed" in finding.fix) for finding in found] == [("yaw-sign", False)]


def test_without_sides_the_gyro_is_wrong_where_fixes_have_latitudes(coarse: Recording) -> None:
    assert coarse.imu is not None
    assert coarse.wheels is not None
    speed = coarse.wheels.speed.mean(axis=1, keepdims=True) * RIG.wheel_radius_m
    body = dataclasses.replace(coarse.wheels, speed=speed, names=("speed",), unit="mps", angle_rad=None)
    imu = dataclasses.replace(coarse.imu, gyro_radps=coarse.imu.gyro_radps * [1.0, 1.0, -1.0])
    imu = dataclasses.replace(imu, accel_mps2=np.full_like(imu.accel_mps2, np.nan))
    log = dataclasses.replace(coarse, truth=None, command=None, wheels=body, imu=imu)
    for datum, code in (((48.0, 11.0, 500.0), "yaw-sign"), (None, "gnss-course")):
        (finding,) = run_checks(dataclasses.replace(log, datum=datum), RIG)
        assert finding.code == code
