"""Coulomb friction under four wheels: the motion of a skidding robot.

Each wheel drags its quarter of the robot against its slip velocity over the ground (the circle of friction,
Wong 2008, Theory of Ground Vehicles, sec. 1.4)::

    du/dt = - friction / 4 sum_i s_i / sqrt(|s_i|^2 + s0^2),   s_i = u + omega x r_i - (wheel speed, 0)

with `friction` = mu g. Below `SLIP_SPEED_MPS` the drag acts as a damper, so that a robot whose wheels hold
moves as they roll. In a turn the wheels of a skid-steered robot slip already, and hold less against
sliding outwards.
"""

import math

import numpy as np

from terrafusion.datasets.core.arrays import Array

SLIP_SPEED_MPS = 0.2
"""Slip speed s0 below which friction acts as a damper (assumed)."""
SUBSTEPS = 2
"""Integration steps per keyframe."""


def skid_motion(
    velocity_mps: Array,
    left_mps: float,
    right_mps: float,
    yaw_rate_radps: float,
    friction_mps2: Array,
    track_m: float,
    dt_s: float,
) -> tuple[Array, Array]:
    """Velocities at the end, in the body frame there, and displacements, in the body frame at the start, of K
    robots.

    Linearly implicit Euler steps (Hairer and Wanner 1996, sec. IV.7), stable for any friction. The
    wheelbase is taken to be the track.

    Args:
        velocity_mps: (K, 2), in the body frame at the start.
        left_mps, right_mps: circumferential speed of the wheels, their slip without force removed.
        yaw_rate_radps: rate at which the body turns.
        friction_mps2: (K,) largest acceleration by friction.
    """
    h, half = dt_s / SUBSTEPS, 0.5 * track_m
    pull = 0.25 * friction_mps2
    turn = yaw_rate_radps * h
    c, s = math.cos(turn), math.sin(turn)
    u, v = velocity_mps[:, 0], velocity_mps[:, 1]
    x, y = np.zeros_like(u), np.zeros_like(u)
    for i in range(SUBSTEPS):
        before_u, before_v = u, v
        u, v = c * u + s * v, c * v - s * u
        a_x = a_y = k_xx = k_yy = k_xy = np.zeros_like(u)
        for side, wheel in ((1.0, left_mps), (-1.0, right_mps)):
            slip_x = u - (side * half * yaw_rate_radps + wheel)
            for end in (1.0, -1.0):
                slip_y = v + end * half * yaw_rate_radps
                speed = np.sqrt(slip_x * slip_x + slip_y * slip_y + SLIP_SPEED_MPS**2)
                drag = pull / speed
                a_x, a_y = a_x - drag * slip_x, a_y - drag * slip_y
                cube = drag / (speed * speed)
                k_xx = k_xx + drag - cube * slip_x * slip_x
                k_yy = k_yy + drag - cube * slip_y * slip_y
                k_xy = k_xy - cube * slip_x * slip_y
        # (1 + h K) step = h a
        xx, yy, xy = 1.0 + h * k_xx, 1.0 + h * k_yy, h * k_xy
        det = xx * yy - xy * xy
        u, v = u + h * (yy * a_x - xy * a_y) / det, v + h * (xx * a_y - xy * a_x) / det
        # Both velocities in the frame of the step's start, and that in the one of the keyframe's.
        mean_u, mean_v = 0.5 * (before_u + c * u - s * v), 0.5 * (before_v + s * u + c * v)
        ci, si = math.cos(i * turn), math.sin(i * turn)
        x, y = x + h * (ci * mean_u - si * mean_v), y + h * (si * mean_u + ci * mean_v)
    return np.stack([u, v], axis=1), np.stack([x, y], axis=1)
