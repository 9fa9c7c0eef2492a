"""One run of a robot as rigid bodies in MuJoCo: wheels with point contact on bumpy ground of patchy friction.

The owner's program sends speed and turn rate towards random way points; its motors follow wheel speeds.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from terrafusion.datasets.core.channels import Command, Fix, Gnss, Imu, Wheels
from terrafusion.datasets.core.recording import Recording
from tests.studies.unseen_gap.changes import Change, Machine

Array = NDArray[np.float64]

STEP_S, LOOP_S = 0.002, 0.01
SECONDS = 60.0
HALF_SITE_M, CELLS, SMOOTH_M = 40.0, 160, 3.0
ACCEL_MPS2, YAW_ACCEL_RADPS2 = 1.0, 2.0
"""Limits of the owner's program."""
COMMAND_EVERY = 5
"""Loops between two commands: 20 Hz."""
GRAVITY = 9.81
START_NS = 1_750_000_000_000_000_000
GYRO_NOISE, ACCEL_NOISE, FIX_NOISE_M, FIX_SIGMA_M = 2e-4, 3e-3, 0.012, 0.02
"""Densities of the IMU, rad/s/sqrt(Hz) and m/s2/sqrt(Hz); white noise of RTK fixes, and what they report."""
GYRO_BIAS_RADPS, ACCEL_BIAS_MPS2, MU_SPREAD = 2e-4, 0.02, 0.03
"""1 sigma from run to run: of the biases, and of the ground's friction as a share."""


@dataclass(frozen=True)
class Style:
    """How a drive goes: share of the robot's speed, and how far apart way points are, m."""

    speed: float
    reach_m: float


def model_text(robot: Machine, change: Change) -> str:
    """MuJoCo's XML of robot and ground."""
    mass, y = robot.mass_kg, 0.5 * robot.track_m * (1.0 + change.of("track_width"))
    x, height = 0.5 * robot.wheelbase_m, 1.5 * robot.radius_m
    payload, left = mass * change.of("mass"), change.of("cg_lateral")
    loss = 0.25 * mass * GRAVITY * robot.radius_m * change.of("drivetrain_friction")
    rotor = 0.2 * mass * robot.radius_m**2
    wheels, motors = "", ""
    for k, (sx, sy) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1))):
        uneven = 1.0 - 0.5 * sy * change.of("wheel_radius_asymmetry")
        radius = robot.radius_m * (1.0 + change.of("wheel_radius")) * uneven
        wheels += f"""
          <body pos="{sx * x} {sy * y} {robot.radius_m - height}">
            <joint name="spin{k}" axis="0 1 0" armature="{rotor}" frictionloss="{loss}"/>
            <geom name="wheel{k}" type="sphere" size="{radius}" mass="{0.03 * mass}"/>
          </body>"""
        gain = 0.0 if change.name == "free_wheel" and k == 3 else 3.0 * mass * robot.radius_m
        motors += f'<velocity joint="spin{k}" kv="{gain}"/>'
    inner = 0.88 * mass + payload
    box = f"{0.1 * inner * robot.track_m**2} {0.1 * inner * robot.wheelbase_m**2}"
    antenna = np.add(robot.antenna_m, [change.of("gnss_lever_arm"), 0.0, 0.0])
    places = [" ".join(map(str, place)) for place in (antenna, robot.imu_m)]
    tilt = change.of("slope")
    return f"""
      <mujoco>
        <option timestep="{STEP_S}" cone="elliptic" impratio="5" integrator="implicitfast"
                gravity="{-GRAVITY * np.sin(tilt)} 0 {-GRAVITY * np.cos(tilt)}"/>
        <default><geom friction="1 0 0" condim="3"/></default>
        <asset>
          <hfield name="ground" nrow="{CELLS}" ncol="{CELLS}" size="{HALF_SITE_M} {HALF_SITE_M} 10 1"/>
        </asset>
        <worldbody>
          <geom type="hfield" hfield="ground" friction="0.01 0 0"/>
          <body name="robot" pos="0 0 {height + 0.02}">
            <freejoint/>
            <inertial pos="0 {left} {-0.3 * robot.radius_m}" mass="{inner}"
                      diaginertia="{box} {0.095 * inner * (robot.track_m**2 + robot.wheelbase_m**2)}"/>
            <site name="antenna" pos="{places[0]}"/>
            <site name="imu" pos="{places[1]}"/>{wheels}
          </body>
        </worldbody>
        <actuator>{motors}</actuator>
        <sensor><gyro site="imu"/><accelerometer site="imu"/></sensor>
      </mujoco>"""


def run(robot: Machine, change: Change, style: Style, seed: int) -> Recording:
    """The log of one run of a minute: commands, wheel speeds of both sides, IMU and RTK fixes."""
    import mujoco

    mj: Any = mujoco
    rng = np.random.default_rng([robot.seed, seed])
    model = mj.MjModel.from_xml_string(model_text(robot, change))
    heights = robot.bumps_m * _field(rng)
    model.hfield_data[:] = ((heights - heights.min()) / 10.0).ravel()
    weaker = 1.0 - change.of("soil_strength")
    friction = robot.friction * weaker * (1.0 + MU_SPREAD * rng.normal() + robot.patches * _field(rng))
    sides = np.array([1.0 - change.of("left_right_friction"), 1.0])
    data = mj.MjData(model)
    data.qpos[2] += _at(heights, 0.0, 0.0) - heights.min() + 2.0 * robot.bumps_m
    geoms = [model.geom(f"wheel{k}").id for k in range(4)]
    joints = [model.jnt_qposadr[model.joint(f"spin{k}").id] for k in range(4)]
    antenna, body = model.site("antenna").id, model.body("robot").id
    count, program = round(SECONDS / LOOP_S), _Program(robot, style, rng)
    late = round(change.of("dead_time") / LOOP_S)
    waiting = deque([np.zeros(2)] * (late + 1), maxlen=late + 1)
    lag, followed = change.of("actuator_lag"), np.zeros(2)
    twists, angles, places = np.zeros((count, 2)), np.zeros((count, 4)), np.zeros((count, 3))
    felt = np.zeros((count, 6))
    for i in range(count):
        x, y = data.qpos[:2]
        for k, geom in enumerate(geoms):
            here = _at(friction, *data.geom_xpos[geom, :2])
            model.geom_friction[geom, 0] = max(here * sides[k % 2], 0.02)
        w, qx, qy, qz = data.qpos[3:7]
        yaw = np.arctan2(2.0 * (w * qz + qx * qy), 1.0 - 2.0 * (qy**2 + qz**2))
        if i % COMMAND_EVERY == 0:
            program.decide(i * LOOP_S, np.array([x, y]), yaw)
        twists[i] = program.twist
        waiting.append(program.twist.copy())
        followed += (waiting[0] - followed) * (LOOP_S / lag if lag > LOOP_S else 1.0)
        v, turn = followed
        speeds = (v + np.array([-0.5, 0.5]) * turn * robot.track_m) / robot.radius_m
        data.ctrl[:] = [*speeds, *speeds]
        if change.name == "dragged_load":
            _drag(data, body, robot, change.size, yaw)
        mj.mj_step(model, data, round(LOOP_S / STEP_S))
        angles[i], places[i] = data.qpos[joints], data.site_xpos[antenna]
        felt[i] = data.sensordata
    return _logged(robot, change, seed, rng, twists, angles, places, felt)


def _drag(data: Any, body: int, robot: Machine, share: float, yaw: float) -> None:
    """A load behind the left wheels resists the motion with a share of the weight."""
    speed = data.qvel[:2]
    force = -share * robot.mass_kg * GRAVITY * speed / max(float(np.hypot(*speed)), 0.1)
    ahead = np.array([np.cos(yaw), np.sin(yaw)])
    arm = -0.5 * robot.wheelbase_m * ahead + 0.5 * robot.track_m * np.array([-ahead[1], ahead[0]])
    data.xfrc_applied[body] = [*force, 0.0, 0.0, 0.0, arm[0] * force[1] - arm[1] * force[0]]


class _Program:
    """The owner's program: turns towards the next of random way points; its limits hold for each command."""

    def __init__(self, robot: Machine, style: Style, rng: np.random.Generator) -> None:
        self.robot, self.style, self.rng = robot, style, rng
        self.goal, self.twist = self._next(np.zeros(2)), np.zeros(2)
        self.phase = rng.uniform(0.0, 2.0 * np.pi)

    def _next(self, here: Array) -> Array:
        reach = self.style.reach_m
        while True:
            goal = self.rng.uniform(-1.5 * reach, 1.5 * reach, 2)
            if np.hypot(*(goal - here)) > reach:
                return goal

    def decide(self, t_s: float, here: Array, yaw: float) -> None:
        if np.hypot(*(self.goal - here)) < 0.8:
            self.goal = self._next(here)
        off = np.arctan2(*(self.goal - here)[::-1]) - yaw
        off = float(np.arctan2(np.sin(off), np.cos(off)))
        stands = t_s < 2.0 or 30.0 < t_s < 32.0
        speed = self.style.speed * self.robot.speed_mps * (0.8 + 0.2 * np.sin(t_s / 5.0 + self.phase))
        wanted = np.array(
            [speed * float(np.clip(1.2 - abs(off), 0.1, 1.0)), float(np.clip(1.5 * off, -1.0, 1.0))]
        )
        steps = np.array([ACCEL_MPS2, YAW_ACCEL_RADPS2]) * COMMAND_EVERY * LOOP_S
        self.twist = self.twist + np.clip((np.zeros(2) if stands else wanted) - self.twist, -steps, steps)


def _logged(
    robot: Machine, change: Change, seed: int, rng: np.random.Generator,
    twists: Array, angles: Array, places: Array, felt: Array,
) -> Recording:  # fmt: skip
    """What the owner's program, encoders, IMU and receiver write down."""
    count = len(twists)
    # A sample of the loop is the state at its end.
    t_ns = START_NS + np.round((np.arange(count) + 1) * LOOP_S * 1e9).astype(np.int64)
    every = round(1.0 / (robot.wheels_hz * LOOP_S))
    rows = np.arange(0, count, every)
    unit = 2.0 * np.pi / robot.counts
    counted = np.floor(angles[rows] * (1.0 + change.of("encoder_scale")) / unit) * unit
    speed = np.diff(0.5 * (counted[:, :2] + counted[:, 2:]), axis=0) / (every * LOOP_S)
    gyro, force = felt[:, :3], felt[:, 3:]
    c, s = np.cos(change.of("imu_yaw_misalignment")), np.sin(change.of("imu_yaw_misalignment"))
    turned = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    gyro, force = gyro @ turned.T, force @ turned.T
    gyro = gyro * [1.0, 1.0, 1.0 + change.of("gyro_scale")] + [0.0, 0.0, change.of("gyro_bias")]
    gyro = gyro + GYRO_BIAS_RADPS * rng.normal(size=3) + 10.0 * GYRO_NOISE * rng.normal(size=gyro.shape)
    force = force + ACCEL_BIAS_MPS2 * rng.normal(size=3) + [change.of("accel_bias"), 0.0, 0.0]
    force = force + 10.0 * ACCEL_NOISE * rng.normal(size=force.shape)
    imu_ns = t_ns + round(change.of("imu_time_offset") * 1e9)
    fixes = np.arange(0, count, round(0.2 / LOOP_S))
    at_m = places[fixes] + FIX_NOISE_M * rng.normal(size=(len(fixes), 3))
    sigma, kind = np.full((len(fixes), 3), FIX_SIGMA_M), np.full(len(fixes), Fix.FIXED, np.uint8)
    fix_ns = t_ns[fixes] + round(change.of("gnss_latency") * 1e9)
    sent = np.arange(0, count, COMMAND_EVERY)
    return Recording(
        name=f"{robot.seed}-{seed}", start_ns=START_NS,
        command=Command(t_ns[sent] - round(LOOP_S * 1e9), twists[sent, 0], twists[sent, 1]),
        wheels=Wheels(t_ns[rows[1:]], speed, Wheels.LAYOUTS[0], "radps"), imu=Imu(imu_ns, gyro, force),
        gnss=Gnss(fix_ns, at_m, sigma, kind),
    )  # fmt: skip


def _field(rng: np.random.Generator) -> Array:
    """A smooth random field (CELLS, CELLS) of zero mean and unit variance."""
    field = gaussian_filter(rng.normal(size=(CELLS, CELLS)), SMOOTH_M * CELLS / (2.0 * HALF_SITE_M))
    return (field - field.mean()) / field.std()


def _at(field: Array, x: float, y: float) -> float:
    """Value of the cell at a place: MuJoCo's rows lie along y, its columns along x."""
    row, column = (
        int(np.clip((p + HALF_SITE_M) / (2.0 * HALF_SITE_M) * CELLS, 0, CELLS - 1)) for p in (y, x)
    )
    return float(field[row, column])
