"""Steered drives of the twin beside rigid contact in MuJoCo, on firm ground, with the same wheel motion."""

from __future__ import annotations

import importlib.util
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from terrafusion.datasets.core.recording import Overrides
from terrafusion.twin.model.vehicle import VehicleParams, load_vehicle, with_overrides
from terrafusion.twin.physics.layout import INDEX, state_slice
from terrafusion.twin.run_setup import set_up
from terrafusion.twin.scenario.commands import wheel_angles
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario

pytestmark = pytest.mark.skipif(importlib.util.find_spec("mujoco") is None, reason="mujoco is not installed")

Array = NDArray[np.float64]
DT_S, STEP_S = 0.01, 0.001
FRICTION = 0.8


def model(vehicle: VehicleParams) -> str:
    """Body on four spheres (one point of contact each), every wheel with a motor and a steering joint."""
    body, radius, drive = vehicle.body, vehicle.wheel.radius_m, vehicle.drive
    wheels, motors, steers = "", "", ""
    for k, (sx, sy) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1))):
        x, y, z = 0.5 * sx * body.wheelbase_m, 0.5 * sy * body.track_m, radius - body.cg_height_m
        wheels += f"""
          <body pos="{x} {y} {z}">
            <joint name="steer{k}" axis="0 0 1" damping="2" armature="0.01"/>
            <inertial pos="0 0 0" mass="0.2" diaginertia="1e-3 1e-3 1e-3"/>
            <body>
              <joint name="spin{k}" axis="0 1 0" armature="{vehicle.wheel.inertia_kgm2}"/>
              <geom type="sphere" size="{radius}" mass="0.3"/>
            </body>
          </body>"""
        motors += f'<velocity joint="spin{k}" kv="{drive.speed_loop_p_nms}"/>'
        steers += f'<position joint="steer{k}" kp="500"/>'
    inertia = body.yaw_inertia_kgm2
    return f"""
      <mujoco>
        <option timestep="{STEP_S}" cone="elliptic" impratio="10"/>
        <default><geom friction="{FRICTION} 0 0"/></default>
        <worldbody>
          <geom type="plane" size="0 0 1"/>
          <body pos="0 0 {body.cg_height_m}">
            <freejoint/>
            <inertial pos="0 0 0" mass="{body.mass_kg - 2.0}"
                      diaginertia="{inertia} {inertia} {inertia}"/>{wheels}
          </body>
        </worldbody>
        <actuator>{motors}{steers}</actuator>
      </mujoco>"""


def rigid_drive(vehicle: VehicleParams, wheel_radps: Array, angle_rad: Array) -> Array:
    """Positions x, y and yaw (N, 3) where the wheels turn and point as given (N, 4) each."""
    import mujoco

    mj: Any = mujoco
    simulation = mj.MjModel.from_xml_string(model(vehicle))
    data = mj.MjData(simulation)
    poses = np.empty((len(wheel_radps), 3))
    for i, (speed, angle) in enumerate(zip(wheel_radps, angle_rad, strict=True)):
        data.ctrl[:] = np.concatenate([speed, angle])
        mj.mj_step(simulation, data, round(DT_S / STEP_S))
        w, _, _, z = data.qpos[3:7]
        poses[i] = data.qpos[0], data.qpos[1], 2.0 * np.arctan2(z, w)
    poses[:, 2] = np.unwrap(poses[:, 2])
    return poses


def both(drive: str, segment: DriveSegment) -> tuple[Array, Array]:
    """The twin's x, y, yaw (N, 3) and those of rigid contact with the twin's wheel speeds and angles."""
    vehicle = with_overrides(load_vehicle("elevate"), Overrides(drive=drive))
    scenario = Scenario("steered", segment.duration_s - 0.01, drive=(segment,), route=(RouteLeg("asphalt"),))
    setup = set_up(scenario, vehicle=vehicle)
    driven = setup.drive()
    speeds = driven.states[:, state_slice("wheel_speed")]
    twin = driven.states[:, [INDEX["x"], INDEX["y"], INDEX["yaw"]]]
    return twin, rigid_drive(vehicle, speeds, wheel_angles(driven.inputs, vehicle))


@pytest.mark.parametrize("drive", ["ackermann", "four_wheel_steer"])
@pytest.mark.parametrize("curvature_per_m", [0.3, -0.9])
def test_a_bend_is_that_of_rigid_contact(drive: str, curvature_per_m: float) -> None:
    twin, rigid = both(drive, DriveSegment(10.0, v_mps=0.6, curvature_per_m=curvature_per_m))
    path_m = np.hypot(*np.diff(twin[:, :2], axis=0).T).sum()
    assert path_m > 5.0
    assert np.hypot(*(twin - rigid)[:, :2].T).max() < 0.02 * path_m
    assert twin[-1, 2] == pytest.approx(rigid[-1, 2], rel=0.02)


@pytest.mark.parametrize("drive", ["ackermann", "four_wheel_steer"])
def test_a_slalom_is_that_of_rigid_contact(drive: str) -> None:
    wave = DriveSegment(12.0, v_mps=0.7, yaw_rate_amplitude_radps=0.5, period_s=4.0)
    twin, rigid = both(drive, wave)
    path_m = np.hypot(*np.diff(twin[:, :2], axis=0).T).sum()
    assert np.hypot(*(twin - rigid)[:, :2].T).max() < 0.03 * path_m
    assert np.abs(twin[:, 2] - rigid[:, 2]).max() < 0.02 * np.abs(np.diff(twin[:, 2])).sum()
