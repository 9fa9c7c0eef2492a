"""Covariance of the body twist, from that of a keyframe."""

import math

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.sensors import ImuSpec
from terrafusion.fusion.graph.key_state import DIM, VELOCITY
from terrafusion.fusion.noise.policy import SensorNoise

_RATES, _BIASES = np.arange(3, 6), np.array([12, 13, 14, 9, 10, 11])


def twist_jacobian(R: Array, velocity_mps: Array, dim: int = DIM) -> Array:
    """Derivative (..., 6, dim) of the body twist by the tangent of a keyframe, or of several.

    With R <- R exp(theta), v <- v + dv and b <- b + db, the linear velocity R' v becomes
    u + [u]x theta + R' dv to first order, where u = R' v, and the angular rate w - b loses db
    (Forster et al. 2017, "On-manifold preintegration", eq. 22 and 23, for the retraction).

    Args:
        R: (..., 3, 3) body to world.
        velocity_mps: (..., 3) of the body origin, world axes.
    """
    J, back = np.zeros((*R.shape[:-2], 6, dim)), R.swapaxes(-1, -2)
    x, y, z = (back @ velocity_mps[..., None])[..., 0].T
    J[..., 0, 1], J[..., 0, 2] = -z, y
    J[..., 1, 0], J[..., 1, 2] = z, -x
    J[..., 2, 0], J[..., 2, 1] = -y, x
    J[..., :3, VELOCITY] = back
    J[..., 3, 12] = J[..., 4, 13] = J[..., 5, 14] = -1.0
    return J


def twist_covariance(P: Array, R: Array, velocity_mps: Array, gyro_sigma_radps: Array) -> Array:
    """Covariance (..., 6, 6) of the body twist in ROS order: linear (m/s), then angular (rad/s), body axes.

    The velocity of the body is known better than its world components: an error of heading turns
    both the pose and the world velocity. That is why the whole of `P` enters, not a block of it.

    Args:
        P: (..., dim, dim) of the keyframe's tangent.
        R: (..., 3, 3) body to world.
        velocity_mps: (..., 3) world.
        gyro_sigma_radps: (..., 3) white noise of the rates, as averaged over a keyframe's interval.
    """
    J = twist_jacobian(R, velocity_mps, P.shape[-1])
    Q = J @ P @ J.swapaxes(-1, -2)
    Q[..., _RATES, _RATES] += gyro_sigma_radps**2
    return np.asarray(0.5 * (Q + Q.swapaxes(-1, -2)))


def gyro_sigma_radps(imu: ImuSpec, keyframe_s: float, noise: SensorNoise) -> Array:
    """White noise (3,) of the gyro's mean over a keyframe's interval: density / sqrt(interval), inflated."""
    density = imu.gyro_noise_radps_sqrthz
    return np.array(noise.gyro_axes()) * density / math.sqrt(keyframe_s)


def bias_sigma(P: Array) -> Array:
    """1 sigma (..., 6) of the gyro biases, rad/s, then of the accelerometer biases, m/s2."""
    return np.sqrt(np.maximum(P.diagonal(axis1=-2, axis2=-1)[..., _BIASES], 0.0))
