"""TUM trajectories: lines of `t x y z qx qy qz qw`, comments behind #."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.datasets.readers.delimited import BLANKS, TextLayout, head_lines, read_columns, read_text
from terrafusion.datasets.readers.formats import Request
from terrafusion.datasets.readers.log_folder import truth_contents
from terrafusion.datasets.readers.text.rows import row_times

COLUMNS = ("x", "y", "z", "qx", "qy", "qz", "qw")
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
    t_ns, table, notes = tum_rows(request.path)
    times = row_times(request, "truth", t_ns)
    table = table[times.order]
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


def tum_rows(path: Path) -> tuple[NDArray[np.int64], Array, tuple[str, ...]]:
    """Times (N,) int64 ns, positions and quaternions (N, 7) as the file has them, and notes.

    Raises:
        DataError: unreadable, no poses, or a line that is not eight finite numbers.
    """
    data = read_text(path)
    first = next((line for _, line in head_lines(data) if line.strip() and line.strip()[0] != "#"), "")
    if not first:
        raise DataError("no poses", remedy="a line is: t x y z qx qy qz qw")
    layout = TextLayout(("t", *COLUMNS), "," if "," in first else BLANKS, 1, "#")
    columns = read_columns(path, data, layout, COLUMNS, ["t"])
    table = columns.stack(COLUMNS)
    unknown = np.flatnonzero(np.isnan(table).any(axis=1))
    if unknown.size:
        name = COLUMNS[int(np.argmax(np.isnan(table[unknown[0]])))]
        raise columns.bad_cell(name, int(unknown[0]), "a line is: t x y z qx qy qz qw")
    return columns.times_ns("t"), table, columns.notes


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
