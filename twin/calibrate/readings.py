"""The twin's channels at many samples at once, with their derivatives along directions.

Their CasADi functions are evaluated by compiled code: a calibration in the virtual machine takes 7 times as
long.
"""

from __future__ import annotations

import ctypes
import functools
from typing import Any

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.engine.compiler import load
from terrafusion.twin.engine.sensitivity import Directions
from terrafusion.twin.model.measurement import (
    Jacobians,
    measured,
    measured_jacobians,
    measurement,
    measurement_jacobian,
)
from terrafusion.twin.model.motion import plane_rotation
from terrafusion.twin.model.plant import Plant
from terrafusion.twin.model.vectors import mounting_vector
from terrafusion.twin.physics.layout import INDEX, OUTPUTS, WHEELS

_LOOP = """
void tf_many(long n, const double **first, const long *stride, double **out, const long *size,
             long arguments, long results, long long *iw, double *w, const double **arg, double **res) {{
  for (long i = 0; i < n; i++) {{
    for (long k = 0; k < arguments; k++) arg[k] = first[k] + i * stride[k];
    for (long k = 0; k < results; k++) res[k] = out[k] + i * size[k];
    {name}(arg, res, iw, w, 0);
  }}
}}
"""


def readings(
    channels: tuple[str, ...],
    model: Model,
    plant: Plant,
    directions: Directions,
    t_s: Array,
    states: Array,
    changes: Array,
    inputs: Array,
) -> tuple[Array, Array]:
    """Values (N, C) of the channels and their derivatives (N, C, M) along the directions.

    Args:
        t_s: (N,) times, for the ground under the wheels.
        states, changes: (N, X) and (N, X, M), as the run gives them.
        inputs: (N, U).
    """
    effects = {name: plant.effects.get(name, 0.0) for name in plant.effect_names(directions.effects)}
    soil = np.tile(plant.route.along(plant.route.soil, t_s), (1, len(WHEELS)))
    y, by = _measured(states, inputs, plant.vehicle, soil, mounting_vector(model.vehicle), effects)
    d_soil = np.tile(plant.route.along(directions.soil, t_s), (1, len(WHEELS), 1))
    d_effects = [directions.effects.get(name, np.zeros(directions.count)) for name in sorted(effects)]
    dy = by.states @ changes + by.vehicle @ directions.vehicle + by.soil @ d_soil
    if effects:
        dy = dy + by.effects @ np.array(d_effects)
    return _channels(channels, model, y, dy, states, changes)


def _measured(
    states: Array, inputs: Array, vehicle: Array, soil: Array, mounting: Array, effects: dict[str, float]
) -> tuple[Array, Jacobians]:
    """`measured` and `measured_jacobians`, in compiled code where there is a compiler."""
    names = tuple(sorted(effects))
    value, derivative = _compiled(names)
    if value is None or derivative is None:
        arguments = (states, inputs, vehicle, soil, mounting, effects)
        return measured(*arguments), measured_jacobians(*arguments)
    values = np.array([effects[name] for name in names])
    given = (states, inputs, vehicle, soil, values, mounting)
    return value(len(states), *given)[0][:, :, 0], Jacobians(*derivative(len(states), *given))


@functools.cache
def _compiled(effects: tuple[str, ...]) -> tuple[Pointwise | None, Pointwise | None]:
    return pointwise(measurement(effects)), pointwise(measurement_jacobian(effects))


def _channels(
    channels: tuple[str, ...], model: Model, y: Array, dy: Array, states: Array, changes: Array
) -> tuple[Array, Array]:
    """The channels by name: those of the measurement graph, the mean of both sides' wheels, and the pose."""
    values, derivatives = [], []
    turn = plane_rotation(model.slope_rad, model.aspect_rad)
    for name in channels:
        if name in OUTPUTS:
            i = OUTPUTS.index(name)
            value, change = y[:, i], dy[:, i]
        elif name == "wheel_mean_radps":
            pair = [OUTPUTS.index(f"wheel_{side}_radps") for side in ("left", "right")]
            value, change = y[:, pair].mean(axis=1), dy[:, pair].mean(axis=1)
        elif name == "truth_yaw_rad":
            value, change = _heading(turn, states[:, INDEX["yaw"]], changes[:, INDEX["yaw"]])
        else:
            row = turn[("truth_east_m", "truth_north_m").index(name), :2]
            xy = [INDEX["x"], INDEX["y"]]
            value, change = states[:, xy] @ row, np.einsum("i,nim->nm", row, changes[:, xy])
        values.append(value)
        derivatives.append(change)
    return np.stack(values, axis=1), np.stack(derivatives, axis=1)


def _heading(turn: Array, yaw: Array, change: Array) -> tuple[Array, Array]:
    """Heading (N,) in the world of a yaw (N,) in the plane, unwrapped like it, and its derivatives (N, M)."""
    forward = np.stack([np.cos(yaw), np.sin(yaw)], axis=1) @ turn[:2, :2].T
    left = np.stack([-np.sin(yaw), np.cos(yaw)], axis=1) @ turn[:2, :2].T
    heading = np.arctan2(forward[:, 1], forward[:, 0])
    heading = yaw + np.angle(np.exp(1j * (heading - yaw)))
    size = (forward**2).sum(axis=1)
    rate = (forward[:, 0] * left[:, 1] - forward[:, 1] * left[:, 0]) / size
    return heading, rate[:, None] * change


class Pointwise:
    """`function`, whose results are dense, compiled with a loop over samples."""

    def __init__(self, function: Any, library: ctypes.CDLL) -> None:
        self._many = library.tf_many
        self._many.restype = None
        self._many.argtypes = [ctypes.c_long, *[ctypes.c_void_p] * 4, ctypes.c_long, ctypes.c_long,
                               *[ctypes.c_void_p] * 4]  # fmt: skip
        self._in, self._out = function.n_in(), function.n_out()
        self._shapes = [function.size_out(i) for i in range(self._out)]
        self._work = (function.sz_iw() + 1, function.sz_w() + 1, function.sz_arg(), function.sz_res())

    def __call__(self, count: int, *arguments: Array) -> list[Array]:
        """Results (count, rows, columns) for arguments (count, k), or (k,) where all samples share them."""
        given = [np.ascontiguousarray(a, dtype=float) for a in arguments]
        outs = [np.empty((count, columns, rows)) for rows, columns in self._shapes]
        iw, w, arg, res = self._work
        strides = [a.shape[1] if a.ndim == 2 else 0 for a in given]
        sizes = [rows * columns for rows, columns in self._shapes]
        ints, reals = (ctypes.c_longlong * iw)(), (ctypes.c_double * w)()
        pointers, results = (ctypes.c_void_p * max(arg, 1))(), (ctypes.c_void_p * max(res, 1))()
        self._many(
            count, (ctypes.c_void_p * self._in)(*(a.ctypes.data for a in given)),
            (ctypes.c_long * self._in)(*strides),
            (ctypes.c_void_p * self._out)(*(o.ctypes.data for o in outs)),
            (ctypes.c_long * self._out)(*sizes),
            self._in, self._out, ints, reals, pointers, results,
        )  # fmt: skip
        return [out.transpose(0, 2, 1) for out in outs]


def pointwise(function: Any) -> Pointwise | None:
    """The compiled function, None where there is no compiler (or it fails, which is logged)."""
    import casadi as ca

    generator = ca.CodeGenerator("twin.c", {"with_header": False, "casadi_int": "long long"})
    generator.add(function)
    source = generator.dump() + _LOOP.format(name=function.name())
    library = load("a graph", None, lambda: source)
    return Pointwise(function, library) if library is not None else None
