"""Results of the estimator: single states, and whole runs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.frames import yaw_of
from terrafusion.datasets.core.printable import counted
from terrafusion.datasets.core.tables import text_html
from terrafusion.datasets.core.trajectory import Trajectory

if TYPE_CHECKING:
    import pandas as pd


STATUS = {
    "waiting": "no data that allow a start have come yet",
    "aligning": "heading is unknown until the robot has moved far enough for GNSS to show it",
    "running": "position, heading and slip are estimated",
    "outage": "no GNSS fix for more than two seconds; wheels and IMU carry the position",
    "doubtful": "fixes contradict wheels and gyro; sigma spans what is possible, the notes tell why",
    "stalled": "IMU samples do not come, or are not used, as when clocks were set back: the state is old, or "
    "after some seconds that of the wheels alone",
    "no_gnss": "no usable GNSS fix has placed the path; it is local, its start and heading are arbitrary",
}
"""Values of a status and the sentence that explains each."""
BIASES = (*(f"gyro_bias_{a}_radps" for a in "xyz"), *(f"accel_bias_{a}_mps2" for a in "xyz"))
JUMPED = "the fixes jumped as no robot moves, while wheels and gyro agree with them before and after"
"""Why a fix was not used that follows such a jump."""


@dataclass(frozen=True)
class WeightChange:
    """Why a sensor's weight changed at a keyframe."""

    t_ns: int
    sensor: str
    before: float
    after: float
    unit: str
    reason: str


@dataclass(frozen=True, eq=False, repr=False)
class State:
    """The estimate at one time.

    Attributes:
        t_ns: time of the keyframe.
        position_m: (3,) body origin in the world (ENU about the datum).
        quaternion: (4,) x, y, z, w of body to world.
        velocity_mps: (3,) in the world frame.
        angular_velocity_radps: (3,) in the body frame, bias removed.
        gyro_bias_radps, accel_bias_mps2: (3,) in the body frame.
        slip, slip_sigma: longitudinal slip 1 - v / (omega R) and its 1 sigma.
        linear, linear_sigma: the states of `key_state.LINEAR` and their 1 sigma.
        covariance: (6, 6) of the pose, ROS order (translation then rotation, world axes).
        velocity_covariance: (3, 3), world.
        twist_covariance: (6, 6) of the body twist, linear then angular.
        bias_sigma: (6,) 1 sigma of the gyro biases (rad/s), then of the accelerometer's (m/s2).
        terrain: class name -> probability.
        status: a key of `STATUS`.
        slipping: wheels and robot travel different distances (see `monitor`).
        immobilised: the robot is kept from moving, its wheels spinning or stalled.
    """

    t_ns: int
    position_m: Array
    quaternion: Array
    velocity_mps: Array
    angular_velocity_radps: Array
    gyro_bias_radps: Array
    accel_bias_mps2: Array
    slip: float
    slip_sigma: float
    linear: Array
    linear_sigma: Array
    covariance: Array
    velocity_covariance: Array
    twist_covariance: Array
    bias_sigma: Array
    terrain: dict[str, float]
    status: str
    slipping: bool = False
    immobilised: bool = False

    def __repr__(self) -> str:
        x_m, y_m, z_m = self.position_m
        sigma_m = float(np.sqrt(0.5 * self.covariance[:2, :2].trace()))
        ground = max(self.terrain, key=self.terrain.__getitem__, default="unknown")
        return (
            f"State at {self.t_ns} ns: {self.status}, position ({x_m:.2f}, {y_m:.2f}, {z_m:.2f}) m, "
            f"1 sigma {sigma_m:.2g} m, yaw {float(yaw_of(self.quaternion)):.3f} rad, "
            f"speed {float(np.linalg.norm(self.velocity_mps)):.2f} m/s, "
            f"slip {self.slip:.3f} +- {self.slip_sigma:.2g}, ground {ground}"
        )


@dataclass(frozen=True, eq=False)
class Innovation:
    """A measurement less its prediction: `value` (m; magnetometer: rad), normalised square `nis`, `dof`.

    `reason`: why it was not used, where more than its gate speaks against it.
    """

    t_ns: int
    sensor: str
    value: Array
    nis: float
    dof: int
    accepted: bool
    reason: str = ""


@dataclass(frozen=True, eq=False, repr=False)
class Estimate:
    """The estimate of a whole run.

    `trajectory` has the twist (body) and the covariance of every keyframe; the
    other arrays run along it. `classes` names the columns of `terrain`, `linear_names` those of `linear`.
    `start_ns` is that of the recording, from which `t_s` counts. `found_ground` (N,) names the ground that
    the robot found itself where no class describes it, else "".
    """

    trajectory: Trajectory
    velocity_mps: Array
    velocity_covariance: Array
    gyro_bias_radps: Array
    accel_bias_mps2: Array
    slip: Array
    slip_sigma: Array
    terrain: Array
    classes: tuple[str, ...]
    weights: dict[str, Array]
    changes: tuple[WeightChange, ...]
    innovations: tuple[Innovation, ...]
    status: NDArray[Any]
    notes: tuple[str, ...] = ()
    slipping: NDArray[np.bool_] | None = None
    immobilised: NDArray[np.bool_] | None = None
    twist_covariance: Array | None = None
    bias_sigma: Array | None = None
    linear: Array | None = None
    linear_sigma: Array | None = None
    linear_names: tuple[str, ...] = ()
    start_ns: int = 0
    found_ground: NDArray[Any] | None = None

    def __repr__(self) -> str:
        t_ns = self.trajectory.t_ns
        seconds = (int(t_ns[-1]) - int(t_ns[0])) * 1e-9 if len(t_ns) else 0.0
        names, counts = np.unique(self.status.astype(str), return_counts=True)
        status = ", ".join(f"{name} {n / len(t_ns):.0%}" for name, n in zip(names, counts, strict=True))
        return "\n".join(
            [
                f"Estimate: {len(t_ns)} keyframes over {seconds:.1f} s, "
                f"path {self.trajectory.path_length_m():.1f} m",
                f"  status: {status}",
                f"  slip: median {np.median(self.slip):.3f}, 1 sigma {np.median(self.slip_sigma):.3f}"
                if len(t_ns)
                else "  slip: none",
                f"  {len(self.changes)} changes of weights, {len(self.innovations)} innovations, "
                f"{counted(len(self.notes), 'note')}",
            ]
        )

    def _repr_html_(self) -> str:
        return text_html(repr(self))

    def to_pandas(self) -> pd.DataFrame:
        """One row a keyframe, indexed by `t_ns`: the columns of `estimate.csv`, and more of pose and twist.

        Columns carry their units; those that the file has too are described in docs/reference/outputs.md.
        The others: body twist `vx_mps` to `wz_radps`, 1 sigma of height, roll and pitch.
        """
        import pandas as pd

        path = self.trajectory
        table: dict[str, Any] = {"t_s": (path.t_ns - self.start_ns) * 1e-9}
        table |= {str(name): column.to_numpy() for name, column in path.to_pandas().items()}
        for i, axis in enumerate("enu"):
            table[f"v_{axis}_mps"] = self.velocity_mps[:, i]
        if path.twist_body is not None:
            table["yaw_rate_radps"] = path.twist_body[:, 5]
        table |= {"slip": self.slip, "slip_sigma": self.slip_sigma}
        table["terrain"] = self.dominant_terrain() if self.classes else ""
        table |= {f"p_{name}": self.terrain[:, i] for i, name in enumerate(self.classes)}
        if path.covariance is not None:
            for i, name in enumerate(("x_m", "y_m", "z_m", "roll_rad", "pitch_rad", "yaw_rad")):
                table[f"sigma_{name}"] = np.sqrt(path.covariance[:, i, i])
        biases = np.hstack([self.gyro_bias_radps, self.accel_bias_mps2])
        for i, bias in enumerate(BIASES):
            table[bias] = biases[:, i]
            if self.bias_sigma is not None:
                table[f"sigma_{bias}"] = self.bias_sigma[:, i]
        table |= {f"w_{name}": values for name, values in self.weights.items()}
        table["status"] = self.status
        if self.slipping is not None and self.immobilised is not None:
            table |= {"slipping": self.slipping, "immobilised": self.immobilised}
        for i, name in enumerate(self.linear_names):
            if name == "slip" or self.linear is None or self.linear_sigma is None:
                continue
            if np.isfinite(self.linear_sigma[:, i]).any():
                table |= {name: self.linear[:, i], f"sigma_{name}": self.linear_sigma[:, i]}
        return pd.DataFrame(table, index=pd.Index(path.t_ns, name="t_ns"))

    def dominant_terrain(self) -> NDArray[Any]:
        """The most probable class (N,) at each keyframe."""
        return np.array(self.classes)[self.terrain.argmax(axis=1)]

    def ground(self) -> NDArray[Any]:
        """The ground (N,) at each keyframe: one that the robot found, else the most probable class."""
        classes = self.dominant_terrain()
        if self.found_ground is None:
            return classes
        return np.where(self.found_ground != "", self.found_ground, classes)
