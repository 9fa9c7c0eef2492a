"""The least-squares problem: residuals of all logs and windows, and its normal equations.

Unknown are the parameters (as `coordinates.Coordinate`), constant errors of the sensors of each log (offsets
and gains: otherwise a current sensor that is 2 % off would pass for a heavier robot), and the pose at the
start of each window. All have Gaussian priors and are scaled by their prior sigma, so that the normal matrix
is never singular. The poses are eliminated window by window (Schur complement), which marginalises them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.calibrate.coordinates import Coordinate
from terrafusion.twin.calibrate.inputs import DT_S
from terrafusion.twin.calibrate.log import PreparedLog, window_of
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.calibrate.noise import ResidualNoise
from terrafusion.twin.calibrate.predict import POSE, predict
from terrafusion.twin.model.vehicle import VehicleParams

POSE_SIGMA = np.array([10.0, 10.0, 1.0])
"""1 sigma of a window's start about its guess (assumed, m and rad): wide, as the log determines it."""
UNPOSED_YAW_SIGMA = 0.2
"""1 sigma of the heading (assumed, rad) where the log does not determine it."""
HUBER = 2.5
"""Whitened residuals beyond this weigh linearly, not as squares, where robust (Huber 1964)."""

Key = tuple[int, int]
"""Log and channel, by number."""
NoiseModel = dict[Key, ResidualNoise]
"""Noise of each log's channels."""
GYRO_OFFSET_RADPS, ACCEL_OFFSET_MPS2 = 0.02, 0.5
"""1 sigma of the offsets of an IMU (assumed): a warm MEMS gyro; an accelerometer tilted by 3 deg."""
LEAST_GAIN, LEAST_CURRENT_OFFSET_A = 1e-3, 0.02
"""Least 1 sigma of a gain and of a current sensor's offset (assumed)."""


@dataclass(frozen=True, eq=False)
class Point:
    """Estimates of the solver: w (P,), sensor errors (L, B), poses (W, 3) a log; all in prior sigmas."""

    w: Array
    errors: Array
    pose: tuple[Array, ...]

    def moved(self, dw: Array, derrors: Array, dpose: Sequence[Array]) -> "Point":
        pose = tuple(p + d for p, d in zip(self.pose, dpose, strict=True))
        return Point(self.w + dw, self.errors + derrors, pose)


@dataclass(frozen=True, eq=False)
class ResidualBlock:
    """Residuals (twin less log) of one channel in one window, with their derivatives.

    Attributes:
        log, channel, window: by number.
        rows: (n,) its rows in the channel.
        residual: (n,).
        change: (n, P + B + 3) by parameters, sensor errors of the log and pose of the window.
    """

    log: int
    channel: int
    window: int
    rows: NDArray[np.int64]
    residual: Array
    change: Array


@dataclass(frozen=True, eq=False)
class EliminatedPose:
    """The pose (3,) of one window: its step is -own - by @ d[at] for a step d (G,) of the others.

    Attributes:
        at: the parameters and sensor errors that the window's residuals depend on.
        information, gradient: (3, 3) and (3,) of the pose alone, with the others fixed.
    """

    at: NDArray[np.int64]
    by: Array
    own: Array
    information: Array
    gradient: Array

    def reduced(self, J: Array) -> Array:
        """Derivatives (n, P + B) of residuals with the pose eliminated, from those (n, P + B + 3) with it."""
        return np.asarray(J[:, : len(self.at)] - J[:, len(self.at) :] @ self.by)


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal equations of parameters and sensor errors (G,), the poses eliminated.

    Attributes:
        H, g: (G, G) and (G,).
        cost: half the sum of squares, in nats.
        poses: eliminated poses by log and window.
    """

    H: Array
    g: Array
    cost: float
    poses: dict[Key, EliminatedPose]


class Problem:
    """Logs, a model and the coordinates of its unknown parameters."""

    def __init__(
        self, logs: Sequence[PreparedLog], model: Model, coordinates: Sequence[Coordinate], *, robust: bool
    ) -> None:
        self.logs, self.model, self.coordinates, self.robust = tuple(logs), model, tuple(coordinates), robust
        self.names = tuple(c.name for c in coordinates)
        self.errors = sensor_errors(model.vehicle)
        self.windows = [[window_of(o, log.windows) for o in log.observed] for log in self.logs]

    def start(self) -> Point:
        """At the parameters of the model, without sensor errors, at the guessed poses."""
        w = np.array([c.at(c.start) for c in self.coordinates])
        errors = np.zeros((len(self.logs), len(self.errors)))
        return Point(w, errors, tuple(np.zeros_like(log.start) for log in self.logs))

    def model_at(self, w: Array) -> Model:
        """The model with the parameters at w."""
        return self.model.replaced(
            {c.name: c.value(float(x)) for c, x in zip(self.coordinates, w, strict=True)}
        )

    def blocks(self, point: Point) -> list[ResidualBlock]:
        """Residuals and derivatives, in a fixed order; a TerrafusionError where the twin diverges."""
        rate = np.array([c.rate(float(x)) for c, x in zip(self.coordinates, point.w, strict=True)])
        model, out = self.model_at(point.w), []
        for i, (log, pose) in enumerate(zip(self.logs, point.pose, strict=True)):
            predicted = predict(log, model, self.names, log.start + pose * self.pose_sigma(log))
            for j, (observed, p) in enumerate(zip(log.observed, predicted, strict=True)):
                gain, by = self._sensor(observed.channel, p.value, point.errors[i])
                residual = p.value + by @ point.errors[i] - observed.value
                change = np.hstack([gain * p.change * rate, by, gain * p.by_pose * self.pose_sigma(log)])
                for window in np.unique(self.windows[i][j]):
                    rows = np.flatnonzero(self.windows[i][j] == window)
                    out.append(ResidualBlock(i, j, int(window), rows, residual[rows], change[rows]))
        return out

    def _sensor(self, channel: str, value: Array, errors: Array) -> tuple[float, Array]:
        """A channel's gain, and derivatives (n, B) of its reading by its errors, in which it is linear."""
        by, gain = np.zeros((len(value), len(self.errors))), 1.0
        for k, error in enumerate(self.errors):
            if error.channel == channel:
                by[:, k] = error.sigma * (value if error.kind == "gain" else 1.0)
                gain += error.sigma * float(errors[k]) if error.kind == "gain" else 0.0
        return gain, by

    @staticmethod
    def pose_sigma(log: PreparedLog) -> Array:
        """Prior sigma (3,) of a window's start, m and rad."""
        return POSE_SIGMA if log.posed else np.array([*POSE_SIGMA[:2], UNPOSED_YAW_SIGMA])

    def whitened(self, block: ResidualBlock, noise: NoiseModel) -> tuple[Array, Array]:
        """Residual (n,) and derivatives with white noise of variance one, outliers down-weighted."""
        observed = self.logs[block.log].observed[block.channel]
        columns = np.column_stack([block.residual, block.change])
        white = noise[block.log, block.channel].whiten(
            observed.slot[block.rows], observed.sigma[block.rows], columns
        )
        r, J = white[:, 0], white[:, 1:]
        if self.robust:
            root = np.sqrt(np.minimum(1.0, HUBER / np.maximum(np.abs(r), 1e-12)))
            r, J = r * root, J * root[:, None]
        return r, J

    def cost_of(self, r: Array) -> float:
        """Cost of weighted residuals; those down-weighted count by Huber's function."""
        if not self.robust:
            return 0.5 * float(r @ r)
        # An outlier was down-weighted to sqrt(HUBER |r|).
        outlier = np.abs(r) > HUBER
        return 0.5 * float(np.sum(np.where(outlier, 2.0 * r * r - HUBER**2, r * r)))

    def normal(
        self, point: Point, blocks: Sequence[ResidualBlock], noise: dict[Key, ResidualNoise]
    ) -> Normal:
        """Normal equations of parameters and sensor errors, priors included."""
        P, B, Q = len(self.coordinates), len(self.errors), len(POSE)
        size = P + B * len(self.logs)
        H, g = np.eye(size), np.concatenate([point.w, point.errors.ravel()])
        cost = 0.5 * sum(float((part**2).sum()) for part in (point.w, point.errors, *point.pose))
        poses: dict[Key, EliminatedPose] = {}
        by_window: dict[Key, list[ResidualBlock]] = {}
        for block in blocks:
            by_window.setdefault((block.log, block.window), []).append(block)
        for (i, k), mine in by_window.items():
            local, gradient = np.zeros((P + B + Q, P + B + Q)), np.zeros(P + B + Q)
            for block in mine:
                r, J = self.whitened(block, noise)
                cost += self.cost_of(r)
                local += J.T @ J
                gradient += J.T @ r
            at = np.concatenate([np.arange(P), P + B * i + np.arange(B)])
            A = local[P + B :, P + B :] + np.eye(Q)
            a = gradient[P + B :] + point.pose[i][k]
            solved = np.linalg.solve(A, np.column_stack([local[P + B :, : P + B], a]))
            H[np.ix_(at, at)] += local[: P + B, : P + B] - local[: P + B, P + B :] @ solved[:, :-1]
            g[at] += gradient[: P + B] - local[: P + B, P + B :] @ solved[:, -1]
            poses[i, k] = EliminatedPose(at, solved[:, :-1], solved[:, -1], A, a)
        return Normal(0.5 * (H + H.T), g, cost, poses)

    def step(self, normal: Normal, d: Array) -> tuple[Array, Array, list[Array]]:
        """Steps of w, sensor errors and poses for a step d (G,) of the normal equations."""
        P = len(self.coordinates)
        pose = [np.zeros_like(log.start) for log in self.logs]
        for (i, k), e in normal.poses.items():
            pose[i][k] = -e.own - e.by @ d[e.at]
        return d[:P], d[P:].reshape(len(self.logs), -1), pose

    def seconds(self) -> float:
        """Length of all logs, s."""
        return sum(float(np.diff(log.windows, axis=1).sum()) * DT_S for log in self.logs)


@dataclass(frozen=True)
class SensorError:
    """Gain or offset of one channel, reading = (1 + gain) true + offset, with its prior 1 sigma."""

    channel: str
    kind: str
    sigma: float

    @property
    def name(self) -> str:
        """Channel and kind."""
        return f"{self.channel} {self.kind}"


def sensor_errors(vehicle: VehicleParams) -> tuple[SensorError, ...]:
    """The errors of all channels, always in the same order."""
    imu, current = vehicle.realism.imu, vehicle.realism.current
    gyro, accel = max(imu.gyro_scale_sigma, LEAST_GAIN), max(imu.accel_scale_sigma, LEAST_GAIN)
    offset, gain = max(current.offset_sigma_a, LEAST_CURRENT_OFFSET_A), max(current.gain_sigma, LEAST_GAIN)
    found = [
        ("yaw_rate_radps", GYRO_OFFSET_RADPS, gyro),
        ("accel_x_mps2", ACCEL_OFFSET_MPS2, accel),
        ("accel_y_mps2", ACCEL_OFFSET_MPS2, accel),
        ("current_left_a", offset, gain),
        ("current_right_a", offset, gain),
    ]
    return tuple(
        SensorError(channel, kind, sigma)
        for channel, *sigmas in found
        for kind, sigma in zip(("offset", "gain"), sigmas, strict=True)
    )
