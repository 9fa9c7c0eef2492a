"""TUM trajectories: lines of `t x y z qx qy qz qw`, comments behind #."""

from pathlib import Path

import numpy as np

from terrafusion.datasets.core.arrays import Array, Mask
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.datasets.readers.delimited import BLANKS, head_lines
from terrafusion.datasets.readers.formats import HEAD_BYTES, Request
from terrafusion.datasets.readers.log_folder import truth_contents
from terrafusion.datasets.readers.timed_tables import in_time, new_times, read_rows

COLUMNS = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
NORM_TOLERANCE = 0.01


def claims(path: Path, head: bytes) -> bool:
    """Whether the name ends in .tum, or the first rows are eight numbers with a unit quaternion."""
    if path.suffix.lower() == ".tum" and head:
        return True
    rows = [line.split() for line in _lines(head)[:20]]
    complete = rows[:-1] if len(rows) > 1 else rows  # the head may end inside a line
    try:
        numbers = np.array(complete, dtype=float)
    except ValueError:
        return False
    return numbers.ndim == 2 and numbers.shape[1] == 8 and bool(_are_turns(numbers[:, 4:]).all())


def read(request: Request) -> list[Recording]:
    """The one recording of a trajectory: nothing but truth."""
    with request.path.open("rb") as file:
        lines = _lines(file.read(HEAD_BYTES))
    separator = "," if lines and "," in lines[0] else BLANKS
    rows = read_rows(request.path, COLUMNS, separator=separator, comment="#")
    tables, jumps, clock = in_time({"truth": rows}, repair_clock=request.repair_clock)
    rows = tables["truth"]
    notes = ["truth: the file names neither body nor world frame: taken as poses of the body, z up"]
    notes += rows.notes
    off = np.flatnonzero(~_are_turns(rows.stack(COLUMNS[4:])))
    if off.size:
        norm = np.linalg.norm(rows.stack(COLUMNS[4:])[off[0]])
        remedy = "give unit quaternions x, y, z, w"
        raise rows.error(int(off[0]), f"the quaternion has norm {norm:.3g}", remedy, "truth")
    once = new_times(rows.t_ns)
    if not once.all():
        notes.append(f"truth: {int((~once).sum())} poses with a repeated time left out")
    known = len(rows) == 1 or bool(rows.stack(COLUMNS[4:7]).any())
    if not known:
        notes.append("truth: every orientation is the identity: taken as unknown")
    rows = rows.select(once)
    truth = Trajectory(rows.t_ns, rows.stack(COLUMNS[1:4]), rows.stack(COLUMNS[4:]) if known else None)
    recording = Recording(
        name=request.path.stem,
        start_ns=max(int(truth.t_ns[0]), 0),  # no recording starts before 1970
        truth=truth,
        truth_channels=truth_contents(truth),
        source="TUM trajectory",
        notes=(*notes, *clock),
        clock_jumps=jumps,
    )
    return [recording]


def _lines(head: bytes) -> list[str]:
    """The lines that are neither blank nor a comment."""
    return [line for _, line in head_lines(head) if line.strip() and not line.startswith("#")]


def _are_turns(quaternion: Array) -> Mask:
    """Mask (N,) of the quaternions (N, 4) that have unit length."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(np.abs(np.linalg.norm(quaternion, axis=1) - 1.0) <= NORM_TOLERANCE)
