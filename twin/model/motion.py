"""Exact kinematics of the body and of points fixed to it, from the sampled states.

The world is ENU; the robot moves in a plane through the origin whose steepest
ascent points along `aspect_rad` (0 east, left positive).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.model.vehicle import VehicleParams
from terrafusion.twin.physics.layout import ENDS, INDEX, SIDES


@dataclass(frozen=True, eq=False)
class BodyMotion:
    """Body motion at the samples.

    Attributes:
        t_s: (N,) seconds from the start.
        position_m: (N, 3) of the body origin, world.
        rotation: (N, 3, 3) body to world.
        yaw_rad: (N,) heading in the plane, not wrapped.
        velocity_body_mps: (N, 3) of the body origin, body axes.
        yaw_rate_radps: (N,) about body z.
    """

    t_s: Array
    position_m: Array
    rotation: Array
    yaw_rad: Array
    velocity_body_mps: Array
    yaw_rate_radps: Array

    def point_position_m(self, lever_m: ArrayLike) -> Array:
        """World positions (N, 3) of the body-fixed point `lever_m`."""
        return np.asarray(self.position_m + self.rotation @ np.asarray(lever_m, dtype=float))

    def point_velocity_mps(self, lever_m: ArrayLike) -> Array:
        """World velocities (N, 3) of the body-fixed point `lever_m`: R (v + omega x lever)."""
        lx, ly, _ = np.asarray(lever_m, dtype=float)
        lever_mps = np.stack([-self.yaw_rate_radps * ly, self.yaw_rate_radps * lx, 0.0 * self.t_s], axis=1)
        return np.einsum("nij,nj->ni", self.rotation, self.velocity_body_mps + lever_mps)


def plane_rotation(slope_rad: float, aspect_rad: float) -> Array:
    """Rotation (3, 3) of plane axes to the world: about the horizontal line across the slope."""
    ca, sa, cb, sb = np.cos(aspect_rad), np.sin(aspect_rad), np.cos(slope_rad), np.sin(slope_rad)
    turn = np.array([[ca, -sa, 0.0], [sa, ca, 0.0], [0.0, 0.0, 1.0]])
    tilt = np.array([[cb, 0.0, -sb], [0.0, 1.0, 0.0], [sb, 0.0, cb]])
    return turn @ tilt @ turn.T


def motion_of(
    t_s: Array, states: Array, vehicle: VehicleParams, slope_rad: float, aspect_rad: float
) -> BodyMotion:
    """Motion of the body origin from the states (N, X), whose velocities are the centre of gravity's."""
    world_plane = plane_rotation(slope_rad, aspect_rad)
    x, y, yaw, u, v, r = (states[:, INDEX[name]] for name in ("x", "y", "yaw", "u", "v", "r"))
    zero, one = np.zeros_like(x), np.ones_like(x)
    heading = np.stack(
        [
            np.stack([np.cos(yaw), -np.sin(yaw), zero], axis=1),
            np.stack([np.sin(yaw), np.cos(yaw), zero], axis=1),
            np.stack([zero, zero, one], axis=1),
        ],
        axis=1,
    )
    origin = np.stack([u + r * vehicle.body.cg_left_m, v - r * vehicle.body.cg_forward_m, zero], axis=1)
    position = np.stack([x, y, zero], axis=1) @ world_plane.T
    return BodyMotion(t_s, position, world_plane @ heading, yaw, origin, r)


def wheel_shares(yaw_rad: ArrayLike, vehicle: VehicleParams, slope_rad: float, aspect_rad: float) -> Array:
    """Shares (N, 4) of the weight on the wheels of a robot that stands at headings (N,) on a slope.

    In the order of `layout.WHEELS`. A share that is not positive means that the wheel
    leaves the ground: the robot tips over, which the model does not do.
    """
    body, yaw = vehicle.body, np.atleast_1d(np.asarray(yaw_rad, dtype=float))
    along, across = -np.tan(slope_rad) * np.array([np.cos(aspect_rad - yaw), np.sin(aspect_rad - yaw)])
    lean_x = (body.cg_forward_m + body.cg_height_m * along) / body.wheelbase_m
    lean_y = (body.cg_left_m + body.cg_height_m * across) / body.track_m
    corners = zip(ENDS, SIDES, strict=True)
    return np.stack([(0.5 + end * lean_x) * (0.5 + side * lean_y) for end, side in corners], axis=1)
