"""Ground that varies along the path: what a change of the ground over a short distance does to each channel.

The ground is a Gauss-Markov process in the distance, linear between points of the path. Around a point, a
sensitivity of the whole run to the ground acts on wheels, body and motors as it does in the run, weighted by
the nearness; heading and position keep what they gained there.
"""

from collections.abc import Mapping

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.calibrate.inputs import DT_S
from terrafusion.twin.gap.data.samples import COARSE_STEP, Indices
from terrafusion.twin.physics.layout import OUTPUTS

PATCH_SIGMAS = {
    "soil_strength/shear": 0.5, "soil_strength/bearing": 0.5, "motion_resistance/rolling": 0.3,
    "left_right_friction/sides": 0.5,
}  # fmt: skip
"""Parameters of the ground that vary along the path, with their 1 sigma relative to each other, in typical
sizes (assumed)."""
STEP_M, LENGTH_M = 1.0, 3.0
"""Distance between points: about a robot's length, over which it averages the ground; and that at which the
correlation of the ground falls to 1/e (assumed: such a process has longer and shorter patches, too)."""
STEP_S = COARSE_STEP * DT_S
_V_E, _V_N = OUTPUTS.index("gnss_v_e_mps"), OUTPUTS.index("gnss_v_n_mps")
_EAST, _NORTH = OUTPUTS.index("gnss_east_m"), OUTPUTS.index("gnss_north_m")
_RATE, _SPEED = OUTPUTS.index("yaw_rate_radps"), OUTPUTS.index("speed_mps")


def patch_columns(y: Array, slopes: Mapping[str, Array], counts: Indices, track_m: float) -> Array:
    """Derivatives (n, Y, D) of the outputs by independent changes of the ground in a window, of 1 sigma.

    Args:
        y: (n, Y) outputs at the coarse samples of all windows.
        slopes: (n, Y) their sensitivities by the parameters that were asked for, in typical sizes.
        counts: (W,) number of samples of each window.
    """
    ground = [(slopes[k], sigma) for k, sigma in PATCH_SIGMAS.items() if k in slopes]
    ends = np.cumsum(counts)
    spans = [slice(end - count, end) for end, count in zip(ends, counts, strict=True)]
    weights = [_weights(y[span], track_m) for span in spans]
    most = max(w.shape[1] for w in weights)
    place = STEP_M * np.arange(float(most))
    root = np.linalg.cholesky(np.exp(-np.abs(place[:, None] - place) / LENGTH_M))
    out = np.zeros((*y.shape, len(ground), most))
    for span, weight in zip(spans, weights, strict=True):
        for g, (slope, sigma) in enumerate(ground):
            own = weight @ root[: weight.shape[1]]
            out[span, :, g] = _local(y[span], sigma * slope[span], own)
    return out.reshape(*y.shape, len(ground) * most)


def _weights(y: Array, track_m: float) -> Array:
    """Weights (n, H) of the points of a window's path, one in all at every sample: linear between points."""
    fast = np.maximum(np.abs(y[:, _SPEED]), 0.5 * track_m * np.abs(y[:, _RATE]))  # on the faster side
    place = _integral(fast[:, None]) / STEP_M
    return np.maximum(1.0 - np.abs(place - np.arange(np.ceil(place[-1, 0]) + 1.0)), 0.0)


def _local(y: Array, whole: Array, weight: Array) -> Array:
    """A sensitivity (n, Y) of a window to ground that changes with weights (n, H) in time: (n, Y, H)."""
    out = whole[:, :, None] * weight[:, None, :]
    turned = _integral(whole[:, _RATE, None])[:, 0]
    turn = _integral(out[:, _RATE])
    for velocity, position, across in ((_V_E, _EAST, -y[:, _V_N]), (_V_N, _NORTH, y[:, _V_E])):
        own = whole[:, velocity] - across * turned
        out[:, velocity] = own[:, None] * weight + across[:, None] * turn
        out[:, position] = _integral(out[:, velocity])
    return out


def _integral(values: Array) -> Array:
    """Integral (n, H) over time from the first sample on, by trapezoids."""
    out = np.zeros_like(values)
    out[1:] = np.cumsum(0.5 * STEP_S * (values[1:] + values[:-1]), axis=0)
    return out
