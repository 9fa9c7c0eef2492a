"""`Trajectory`: poses over time, with body twist and covariance where known."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from terrafusion.datasets.core.arrays import Array, TimeRows, TimesNs
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.frames import quaternion_to_matrix, yaw_of

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory(TimeRows):
    """Poses of the body (or antenna) in the world frame.

    Attributes:
        t_ns: (N,) int64, strictly increasing.
        position_m: (N, 3) world; z is NaN where the source is planar.
        quaternion: (N, 4) x, y, z, w of body to world, or None when unknown.
        twist_body: (N, 6) body-frame linear (m/s) then angular (rad/s) velocity, NaN where unknown, or None.
        covariance: (N, 6, 6) of the pose, ROS order (translation then rotation, world axes), or None.
    """

    t_ns: TimesNs
    position_m: Array
    quaternion: Array | None = None
    twist_body: Array | None = None
    covariance: Array | None = None

    def __post_init__(self) -> None:
        n = len(self.t_ns)
        shapes = {"position_m": (n, 3), "quaternion": (n, 4), "twist_body": (n, 6), "covariance": (n, 6, 6)}
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is not None and value.shape != shape:
                raise ValueError(f"trajectory: {name} has shape {value.shape}, not {shape}")
        back = np.flatnonzero(np.diff(self.t_ns) <= 0)
        if back.size:
            i = int(back[0])
            raise DataError(
                f"time does not increase after row {i}",
                channel="trajectory",
                time_s=float(self.t_ns[i] - self.t_ns[0]) * 1e-9,
                remedy="sort the rows and remove repeated times",
            )

    def limited_to(self, channels: Collection[str]) -> Trajectory:
        """The same trajectory without what is not in `channels`, of position, yaw, orientation and velocity.

        Positions that are not known become NaN; an orientation of which only the yaw is known is level.
        """
        q, P = self.quaternion, self.covariance
        position, twist = self.position_m, self.twist_body
        if "position" not in channels and not np.isnan(position).all():
            position = np.full_like(position, np.nan)
        if not {"yaw", "orientation"} & set(channels):
            q = None
        elif "orientation" not in channels:
            q = self.level().quaternion
        if "velocity" not in channels:
            twist = None
        if "position" not in channels or q is None:
            P = None
        if position is self.position_m and q is self.quaternion and twist is self.twist_body:
            return self
        return dataclasses.replace(self, position_m=position, quaternion=q, twist_body=twist, covariance=P)

    def level(self) -> Trajectory:
        """The same trajectory without roll and pitch; what is level already stays to the bit."""
        if self.quaternion is None or not np.nan_to_num(self.quaternion[:, :2]).any():
            return self
        half = 0.5 * self.yaw_rad()
        zero = np.zeros_like(half)
        quaternion = np.stack([zero, zero, np.sin(half), np.cos(half)], axis=1)
        quaternion[~np.isfinite(self.quaternion).all(axis=1)] = np.nan
        return dataclasses.replace(self, quaternion=quaternion)

    def yaw_rad(self) -> Array:
        """Yaw angles (N,), rad, in [-pi, pi]."""
        if self.quaternion is None:
            return np.full(len(self), np.nan)
        return yaw_of(self.quaternion)

    def path_length_m(self) -> float:
        """Length of the horizontal path, m."""
        step = np.diff(self.position_m[:, :2], axis=0)
        return float(np.nansum(np.hypot(step[:, 0], step[:, 1])))

    def positions_at(self, t_ns: TimesNs) -> Array:
        """Positions (M, 3) at the times (M,), linearly interpolated; NaN outside the trajectory's span."""
        out = np.full((len(t_ns), 3), np.nan)
        if not len(self):
            return out
        origin = self.t_ns[0]
        query, grid = (t_ns - origin) * 1e-9, (self.t_ns - origin) * 1e-9
        for axis in range(3):
            out[:, axis] = np.interp(query, grid, self.position_m[:, axis], left=np.nan, right=np.nan)
        return out

    def quaternions_at(self, t_ns: TimesNs) -> Array:
        """Orientations (M, 4) at the times (M,), by slerp; NaN outside the span or when unknown."""
        out = np.full((len(t_ns), 4), np.nan)
        if self.quaternion is None or len(self) < 2:
            return out
        from scipy.spatial.transform import Rotation, Slerp

        inside = (t_ns >= self.t_ns[0]) & (t_ns <= self.t_ns[-1])
        origin = self.t_ns[0]
        slerp = Slerp((self.t_ns - origin) * 1e-9, Rotation.from_quat(self.quaternion))
        out[inside] = slerp((t_ns[inside] - origin) * 1e-9).as_quat()
        return out

    def points_at(self, t_ns: TimesNs, lever_m: tuple[float, ...] | Array) -> Array:
        """World positions (M, 3) of the body-fixed point `lever_m` at the times (M,)."""
        lever = np.asarray(lever_m, dtype=float)
        positions = self.positions_at(t_ns)
        if not lever.any():
            return positions
        known = np.isfinite(positions[:, 0])
        out = np.full_like(positions, np.nan)
        if known.any():
            R = quaternion_to_matrix(self.quaternions_at(t_ns[known]))
            out[known] = positions[known] + R @ lever
        return out

    def to_pandas(self) -> pd.DataFrame:
        """Columns x_m, y_m, z_m, qx, qy, qz, qw and the body twist where known, indexed by `t_ns`."""
        import pandas as pd

        table: dict[str, Array] = {f"{axis}_m": self.position_m[:, i] for i, axis in enumerate("xyz")}
        if self.quaternion is not None:
            table |= {f"q{axis}": self.quaternion[:, i] for i, axis in enumerate("xyzw")}
        if self.twist_body is not None:
            names = ("vx_mps", "vy_mps", "vz_mps", "wx_radps", "wy_radps", "wz_radps")
            table |= {name: self.twist_body[:, i] for i, name in enumerate(names)}
        return pd.DataFrame(table, index=pd.Index(self.t_ns, name="t_ns"))
