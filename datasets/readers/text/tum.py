"""TUM trajectories: lines of `t x y z qx qy qz qw`, comments behind #."""

from pathlib import Path

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.datasets.readers.delimited import BLANKS, head_lines
from terrafusion.datasets.readers.formats import HEAD_BYTES, Request
from terrafusion.datasets.readers.log_folder import truth_contents
from terrafusion.datasets.readers.text.rows import read_rows, row_times

COLUMNS = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
NORM_TOLERANCE = 0.01


def claims(path: Path, head: bytes) -> bool:
    """Whether the name ends in .tum, or the first rows are eight numbers with a unit quaternion."""
    if path.suffix.lower() == ".tum" and head:
        return True
    rows = [line.split() for _, line in head_lines(head, 20) if line.strip() and not line.startswith("#")]
    complete = rows[:-1] if len(rows) > 1 else rows  # the head may end inside a line
    try:
        numbers = np.array(complete, dtype=float)
    except ValueError:
        return False
    return (
        numbers.ndim == 2
        and numbers.shape[1] == 8
        and bool((np.abs(_norms(numbers[:, 4:]) - 1.0) < NORM_TOLERANCE).all())
    )


def read(request: Request) -> list[Recording]:
    """The one recording of a trajectory: nothing but truth."""
    with request.path.open("rb") as file:
        lines = [line for _, line in head_lines(file.read(HEAD_BYTES)) if line.strip() and line[0] != "#"]
    separator = "," if lines and "," in lines[0] else BLANKS
    rows = read_rows(request.path, COLUMNS, separator=separator, comment="#")
    times, notes = row_times(request, "truth", rows.t_ns), rows.notes
    table = rows.values[times.order]
    _check_norms(table[:, 3:])
    fresh = np.concatenate([[True], np.diff(times.t_ns) > 0])
    if not fresh.all():
        notes += (f"truth: {int((~fresh).sum())} poses with a repeated time left out",)
    quaternion: Array | None = table[fresh, 3:]
    if (table[:, 3:6] == 0.0).all() and len(table) > 1:
        quaternion = None
        notes += ("truth: every orientation is the identity: taken as unknown",)
    truth = Trajectory(times.t_ns[fresh], table[fresh, :3], quaternion)
    frames = "truth: the file names neither body nor world frame: taken as poses of the body, z up"
    recording = Recording(
        name=request.path.stem,
        start_ns=max(int(truth.t_ns[0]), 0),  # no recording starts before 1970
        truth=truth,
        truth_channels=truth_contents(truth),
        source="TUM trajectory",
        notes=(frames, *notes, *times.notes),
        clock_jumps=times.jumps,
    )
    return [recording]


def _check_norms(quaternion: Array) -> None:
    norm = _norms(quaternion)
    off = np.flatnonzero(np.abs(norm - 1.0) > NORM_TOLERANCE)
    if off.size:
        raise DataError(
            f"the quaternion has norm {norm[off[0]]:.3g} in row {int(off[0]) + 1}",
            channel="truth",
            remedy="give unit quaternions x, y, z, w",
        )


def _norms(quaternion: Array) -> Array:
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(np.linalg.norm(quaternion, axis=1))
