"""Rotations of any heading, and positions about any datum: both hemispheres, the date line, the poles."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from terrafusion.datasets.core import frames
from terrafusion.datasets.core.errors import DataError

ANY_TIME = settings(deadline=None)
ANGLES = st.floats(-math.pi, math.pi)
PITCHES = st.floats(-1.5, 1.5)
DATUMS = st.tuples(st.floats(-89.0, 89.0), st.floats(-180.0, 180.0), st.floats(-400.0, 8000.0))
NEAR = st.tuples(*[st.floats(-2000.0, 2000.0)] * 2, st.floats(-100.0, 100.0))
EQUATOR_M, FLATTENING = 6378137.0, 1.0 / 298.257223563


def radii_m(latitude_deg: float) -> tuple[float, float]:
    """Of curvature of WGS-84 along the meridian and across it (Torge 2001, eq. 4.15)."""
    square = FLATTENING * (2.0 - FLATTENING)
    w = math.sqrt(1.0 - square * math.sin(math.radians(latitude_deg)) ** 2)
    return EQUATOR_M * (1.0 - square) / w**3, EQUATOR_M / w


@ANY_TIME
@given(roll=ANGLES, pitch=PITCHES, yaw=ANGLES)
def test_a_rotation_is_the_same_in_every_form(roll: float, pitch: float, yaw: float) -> None:
    q = frames.rpy_to_quaternion([roll, pitch, yaw])
    R = frames.quaternion_to_matrix(q)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert frames.wrap_angle(frames.yaw_of(q) - yaw) == pytest.approx(0.0, abs=1e-9)
    again = frames.matrix_to_quaternion(R)
    assert again[3] >= 0.0
    np.testing.assert_allclose(frames.quaternion_to_matrix(again), R, atol=1e-9)
    np.testing.assert_allclose(frames.quaternion_to_matrix(-3.0 * q), R, atol=1e-9)


@ANY_TIME
@given(yaw=ANGLES)
def test_a_robot_faces_east_at_zero_and_turns_to_the_left(yaw: float) -> None:
    R = frames.quaternion_to_matrix(frames.rpy_to_quaternion([0.0, 0.0, yaw]))
    np.testing.assert_allclose(R[:, 0], [math.cos(yaw), math.sin(yaw), 0.0], atol=1e-12)
    np.testing.assert_allclose(R[:, 1], [-math.sin(yaw), math.cos(yaw), 0.0], atol=1e-12)


def test_roll_lowers_the_right_side_and_pitch_the_nose() -> None:
    rolled, pitched = (
        frames.quaternion_to_matrix(frames.rpy_to_quaternion(rpy)) for rpy in ([0.1, 0, 0], [0, 0.1, 0])
    )
    assert (rolled @ [0.0, -1.0, 0.0])[2] == pytest.approx(-math.sin(0.1))
    assert (pitched @ [1.0, 0.0, 0.0])[2] == pytest.approx(-math.sin(0.1))


@ANY_TIME
@given(angle=st.floats(-100.0, 100.0), turns=st.integers(-5, 5))
def test_angles_are_wrapped_to_one_turn(angle: float, turns: int) -> None:
    wrapped = float(frames.wrap_angle(angle))
    assert -math.pi <= wrapped < math.pi
    assert math.cos(wrapped - angle) == pytest.approx(1.0)
    other = float(frames.wrap_angle(angle + 2.0 * math.pi * turns))
    assert math.cos(other - wrapped) == pytest.approx(1.0)


@ANY_TIME
@given(datum=DATUMS, enu=NEAR)
def test_positions_come_back_about_any_datum(datum: tuple[float, ...], enu: tuple[float, ...]) -> None:
    llh = frames.enu_to_geodetic(enu, datum)
    assert abs(llh[0, 1]) <= 180.0
    np.testing.assert_allclose(frames.geodetic_to_enu(llh, datum)[0], enu, atol=1e-5)


@ANY_TIME
@given(latitude=st.floats(-85.0, 85.0), longitude=st.floats(-180.0, 180.0))
def test_a_little_north_and_east_are_arcs_of_the_ellipsoid(latitude: float, longitude: float) -> None:
    """In either hemisphere more latitude is north; across the date line east goes on."""
    meridian, across = radii_m(latitude)
    step = 1e-4
    beyond = (longitude + step + 180.0) % 360.0 - 180.0
    datum = (latitude, longitude, 0.0)
    north = frames.geodetic_to_enu([latitude + step, longitude, 0.0], datum)[0]
    east = frames.geodetic_to_enu([latitude, beyond, 0.0], datum)[0]
    up = frames.geodetic_to_enu([latitude, longitude, 5.0], datum)[0]
    arc = math.radians(step)
    np.testing.assert_allclose(north, [0.0, meridian * arc, 0.0], atol=1e-4)
    np.testing.assert_allclose(east, [across * math.cos(math.radians(latitude)) * arc, 0.0, 0.0], atol=1e-4)
    np.testing.assert_allclose(up, [0.0, 0.0, 5.0], atol=1e-6)


@ANY_TIME
@given(datum=DATUMS, enu=st.lists(NEAR, min_size=2, max_size=4))
def test_earth_centred_positions_keep_their_distances(datum, enu) -> None:
    import pymap3d

    ecef = np.array([pymap3d.enu2ecef(*one, *datum) for one in enu])
    found, R, used = frames.enu_from_ecef(ecef, datum)
    np.testing.assert_allclose(found, enu, atol=1e-4)
    np.testing.assert_allclose((ecef[1] - ecef[0]) @ R.T, found[1] - found[0], atol=1e-4)
    assert used == datum
    about_first = frames.enu_from_ecef(ecef)[0]
    np.testing.assert_allclose(about_first[0], 0.0, atol=1e-4)
    assert np.linalg.norm(about_first[1]) == pytest.approx(np.linalg.norm(ecef[1] - ecef[0]), abs=1e-4)


@pytest.mark.parametrize("latitude", [90.0, -90.0])
def test_a_datum_on_a_pole_is_refused(latitude: float) -> None:
    pole, place = (latitude, 10.0, 0.0), [[3.0, 4.0, 0.0]]
    for convert in (frames.enu_to_geodetic, frames.geodetic_to_enu):
        with pytest.raises(DataError, match="pole"):
            convert(place, pole)
    with pytest.raises(DataError, match="pole"):
        frames.enu_from_ecef([[0.0, 0.0, math.copysign(6_356_752.3, latitude)]])


@pytest.mark.parametrize("latitude", [89.99999, -89.99999])
def test_positions_come_back_a_metre_from_a_pole(latitude: float) -> None:
    """Latitude falls whichever way one goes far enough."""
    pole, places = (latitude, 10.0, 0.0), np.array([[3.0, 4.0, 0.0], [-500.0, 20.0, 5.0]])
    llh = frames.enu_to_geodetic(places, pole)
    assert (np.abs(llh[:, 0]) < 90.0).all()
    np.testing.assert_allclose(frames.geodetic_to_enu(llh, pole), places, atol=1e-5)


@ANY_TIME
@given(yaw=ANGLES, seed=st.integers(0, 1000))
def test_a_covariance_is_moved_from_body_to_world(yaw: float, seed: int) -> None:
    """Against drawn errors: rotation first in the body, then translation first in the world."""
    A = np.random.default_rng(seed).standard_normal((6, 6))
    R = frames.quaternion_to_matrix(frames.rpy_to_quaternion([0.1, -0.2, yaw]))
    moved = frames.gtsam_to_ros_covariance(A @ A.T, R)
    turned = np.vstack([R @ A[3:], R @ A[:3]])
    np.testing.assert_allclose(moved, turned @ turned.T, atol=1e-9)
