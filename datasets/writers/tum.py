"""TUM trajectory files (read by `readers.text.tum`)."""

from pathlib import Path

import numpy as np

from terrafusion.datasets.core.trajectory import Trajectory


def write_tum(trajectory: Trajectory, path: Path) -> None:
    """Write lines of `t x y z qx qy qz qw`, 9 decimals, time in seconds exact to the nanosecond.

    The format has no missing values: an unknown height is written as 0, an unknown orientation as the
    identity.
    """
    orientation = trajectory.quaternion
    if orientation is None:
        orientation = np.tile([0.0, 0, 0, 1], (len(trajectory), 1))
    rows = np.hstack([np.nan_to_num(trajectory.position_m), orientation])
    with path.open("w", encoding="utf-8") as out:
        out.write("# timestamp_s x_m y_m z_m qx qy qz qw\n")
        for t_ns, row in zip(trajectory.t_ns.tolist(), rows.tolist(), strict=True):
            numbers = " ".join(f"{value:.9f}" for value in row)
            out.write(f"{t_ns // 10**9}.{t_ns % 10**9:09d} {numbers}\n")
