"""A robot as rigid bodies in MuJoCo: wheels with point contact on bumpy ground that is slick in patches.

Nothing here is shared with the twin. The robot follows random way points with its true pose and takes all its
sensors from the simulation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from tests.studies.unseen_robots.draw import Robot

Array = NDArray[np.float64]

STEP_S, LOOP_S = 0.002, 0.01
HALF_SITE_M, CELLS = 60.0, 240
SMOOTH_M = 3.0
"""Correlation length of bumps and slick patches."""
REACHED_M = 1.5
STANDING_S = 3.0
"""The robot stands at the start."""


@dataclass(frozen=True, eq=False)
class Driven:
    """What happened, every `LOOP_S`; world axes east, north, up.

    Attributes:
        antenna_m: (N, 3) true place of the antenna.
        quaternion: (N, 4) x, y, z, w of the body.
        wheels_rad: (N, 4) angle turned by front left, front right, rear left, rear right wheel.
        steering_rad: (N,) mean angle of the front wheels.
        gyro_radps, force_mps2: (N, 3) at the IMU in its own axes, without errors.
    """

    t_s: Array
    antenna_m: Array
    quaternion: Array
    wheels_rad: Array
    steering_rad: Array
    gyro_radps: Array
    force_mps2: Array


def model_text(robot: Robot) -> str:
    """MuJoCo's XML of robot and ground."""
    radius, x, y = robot.radius_m * robot.wheel_error, 0.5 * robot.wheelbase_m, 0.5 * robot.track_m
    mass, height = robot.mass_kg, 1.5 * robot.radius_m
    wheels, motors, steers = "", "", ""
    for k, (sx, sy) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1))):
        if robot.drive == "differential" and sx < 0:
            continue
        steer = f'<joint name="steer{k}" axis="0 0 1" damping="{0.05 * mass}" armature="0.05"/>'
        turns = robot.drive == "ackermann" and sx > 0
        wheels += f"""
          <body pos="{sx * x} {sy * y} {robot.radius_m - height}">
            {steer if turns else ""}
            <inertial pos="0 0 0" mass="{0.01 * mass}" diaginertia="1e-3 1e-3 1e-3"/>
            <body>
              <joint name="spin{k}" axis="0 1 0" armature="{0.02 * mass * radius**2}"/>
              <geom name="wheel{k}" type="sphere" size="{radius}" mass="{0.02 * mass}"/>
            </body>
          </body>"""
        if robot.drive != "ackermann" or sx < 0:
            motors += f'<velocity name="motor{k}" joint="spin{k}" kv="{0.6 * mass * radius}"/>'
        if turns:
            steers += f'<position name="turn{k}" joint="steer{k}" kp="{4.0 * mass}"/>'
    if robot.drive == "differential":
        wheels += f"""
          <geom type="sphere" size="{radius}" pos="{-x} 0 {robot.radius_m - height}" friction="0.01 0 0"
                priority="1" mass="{0.02 * mass}"/>"""
    roll, pitch = np.degrees(robot.imu_tilt_rad)
    turn = f'euler="{np.degrees(robot.imu_yaw_rad)} {pitch} {roll}"'
    box = f"{0.1 * mass * robot.track_m**2} {0.1 * mass * robot.wheelbase_m**2}"
    places = [" ".join(map(str, place)) for place in (robot.antenna_m, robot.imu_m)]
    return f"""
      <mujoco>
        <compiler eulerseq="zyx"/>
        <option timestep="{STEP_S}" cone="elliptic" impratio="5" integrator="implicitfast"/>
        <default><geom friction="1 0 0" condim="3"/></default>
        <asset>
          <hfield name="ground" nrow="{CELLS}" ncol="{CELLS}" size="{HALF_SITE_M} {HALF_SITE_M} 10 1"/>
        </asset>
        <worldbody>
          <geom type="hfield" hfield="ground" friction="0.01 0 0"/>
          <body name="robot" pos="0 0 {height + 0.02}">
            <freejoint/>
            <inertial pos="0 0 {-0.3 * robot.radius_m}" mass="{0.85 * mass}"
                      diaginertia="{box} {0.095 * mass * (robot.track_m**2 + robot.wheelbase_m**2)}"/>
            <site name="antenna" pos="{places[0]}"/>
            <site name="imu" pos="{places[1]}" {turn}/>{wheels}
          </body>
        </worldbody>
        <actuator>{motors}{steers}</actuator>
        <sensor><gyro site="imu"/><accelerometer site="imu"/></sensor>
      </mujoco>"""


def drive(robot: Robot) -> Driven:
    """Drive the robot's route; takes a few seconds a robot."""
    import mujoco

    mj: Any = mujoco
    rng = np.random.default_rng([robot.seed, 1])
    model = mj.MjModel.from_xml_string(model_text(robot))
    heights = robot.bumps_m * _field(rng) if robot.bumps_m else np.zeros((CELLS, CELLS))
    lowest = float(heights.min())
    model.hfield_data[:] = ((heights - lowest) / 10.0).ravel()
    slick = _field(rng) < _level(robot.slick_share)
    data = mj.MjData(model)
    data.qpos[2] += _at(heights, 0.0, 0.0) - lowest + 2.0 * robot.bumps_m
    wheels = [k for k in range(4) if mj.mj_name2id(model, mj.mjtObj.mjOBJ_GEOM, f"wheel{k}") >= 0]
    geoms = [model.geom(f"wheel{k}").id for k in wheels]
    joints = [model.jnt_qposadr[model.joint(f"spin{k}").id] for k in wheels]
    steered = (
        [model.jnt_qposadr[model.joint(f"steer{k}").id] for k in (0, 1)] if robot.drive == "ackermann" else []
    )
    site, route = model.site("antenna").id, _Route(robot, rng)
    count = round(robot.duration_s / LOOP_S)
    out = Driven(
        np.arange(count) * LOOP_S, *(np.zeros((count, n)) for n in (3, 4, 4)), np.zeros(count),
        *(np.zeros((count, 3)) for _ in range(2)),
    )  # fmt: skip
    for i in range(count):
        x, y = data.qpos[:2]
        for geom in geoms:
            gx, gy = data.geom_xpos[geom, :2]
            # The larger friction of a pair counts: that of the wheels.
            model.geom_friction[geom, 0] = robot.slick if _at(slick, gx, gy) else robot.friction
        w, qx, qy, qz = data.qpos[3:7]
        yaw = np.arctan2(2.0 * (w * qz + qx * qy), 1.0 - 2.0 * (qy**2 + qz**2))
        data.ctrl[:] = route.command(i * LOOP_S, x, y, yaw)
        mj.mj_step(model, data, round(LOOP_S / STEP_S))
        out.antenna_m[i] = data.site_xpos[site]
        out.quaternion[i] = data.qpos[[4, 5, 6, 3]]
        out.wheels_rad[i, wheels] = data.qpos[joints]
        out.steering_rad[i] = np.mean(data.qpos[steered]) if steered else 0.0
        out.gyro_radps[i], out.force_mps2[i] = data.sensordata[:3], data.sensordata[3:]
    return out


class _Route:
    """Random way points, reached by turning towards the next one; speed changes slowly."""

    def __init__(self, robot: Robot, rng: np.random.Generator) -> None:
        self.robot, self.rng = robot, rng
        self.goal = self._next(np.zeros(2))
        self.phase = rng.uniform(0.0, 2.0 * np.pi, 2)

    def _next(self, here: Array) -> Array:
        while True:
            goal = self.rng.uniform(-self.robot.route_m, self.robot.route_m, 2)
            if np.hypot(*(goal - here)) > 0.5 * self.robot.route_m:
                return goal

    def command(self, t_s: float, x: float, y: float, yaw: float) -> list[float]:
        """Motor speeds, rad/s, and steering angles, in the order of the model's actuators."""
        robot, here = self.robot, np.array([x, y])
        if np.hypot(*(self.goal - here)) < REACHED_M:
            self.goal = self._next(here)
        off = np.arctan2(*(self.goal - here)[::-1]) - yaw
        off = np.arctan2(np.sin(off), np.cos(off))
        wave = 0.7 + 0.2 * np.sin(t_s / 7.0 + self.phase[0]) + 0.1 * np.sin(t_s / 2.3 + self.phase[1])
        speed = robot.speed_mps * wave * float(np.clip((t_s - STANDING_S) / 2.0, 0.0, 1.0))
        if robot.drive == "ackermann":
            angle = float(np.clip(off, -0.5, 0.5))
            curve = np.tan(angle) / robot.wheelbase_m
            sides = [speed * (1.0 - sign * curve * 0.5 * robot.track_m) for sign in (1, -1)]
            inner = [
                np.arctan(robot.wheelbase_m * curve / (1.0 - s * curve * 0.5 * robot.track_m))
                for s in (1, -1)
            ]
            return [*(v / robot.radius_m for v in sides), *inner]
        turn = float(np.clip(1.5 * off, -1.0, 1.0)) * speed / robot.track_m
        speed *= float(np.clip(1.2 - abs(off), 0.2, 1.0))
        sides = [(speed - sign * 0.75 * turn * robot.track_m) / robot.radius_m for sign in (1, -1)]
        return sides if robot.drive == "differential" else [*sides, *sides]


def _field(rng: np.random.Generator) -> Array:
    """A smooth random field (CELLS, CELLS) of zero mean and unit variance."""
    field = gaussian_filter(rng.normal(size=(CELLS, CELLS)), SMOOTH_M * CELLS / (2.0 * HALF_SITE_M))
    return (field - field.mean()) / field.std()


def _level(share: float) -> float:
    """Below it lies `share` of a normal variable."""
    from scipy.stats import norm

    return float(norm.ppf(share)) if share > 0.0 else -np.inf


def _at(field: NDArray[Any], x: float, y: float) -> Any:
    """Value of the cell at a place: MuJoCo's rows lie along y, its columns along x."""
    row, column = (
        int(np.clip((p + HALF_SITE_M) / (2.0 * HALF_SITE_M) * CELLS, 0, CELLS - 1)) for p in (y, x)
    )
    return field[row, column]
