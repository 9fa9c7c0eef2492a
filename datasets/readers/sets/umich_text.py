"""Text logs of the University of Michigan's Husky: IMU, wheel speed and motion capture, a file each.

Columns, between blanks and without a header: `*_imu.txt` t wx wy wz ax ay az; `*_vel.txt` and
`*_vel_input.txt` t vx vy vz; `*_center.txt` and `*_front.txt` t x y z qx qy qz qw. Times are Unix
seconds. Any file of a recording opens all of it: the others are found beside it by their names.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from terrafusion.datasets.core.arrays import TimesNs
from terrafusion.datasets.core.channels import Imu, Wheels
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.frames import wrap_angle, yaw_of
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.datasets.readers.formats import Request
from terrafusion.datasets.readers.log_folder import truth_contents
from terrafusion.datasets.readers.timed_tables import TimedTable, are_numbers, in_time, new_times, read_rows

POSE = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
COLUMNS = {
    "imu": ("t", "wx", "wy", "wz", "ax", "ay", "az"),
    "wheels": ("t", "vx", "vy", "vz"),
    "center": POSE,
    "front": POSE,
}
STEM = r"(?:(?P<stem>.+?)_+)??"
NAMES = {
    "imu": re.compile(STEM + r"(?:wheel_)?imu\.txt"),
    "wheels": re.compile(r"(?!.*inekf)" + STEM + r"(?:wheel_)?vel(?:_input)?\.txt"),
    "center": re.compile(STEM + r"center\.txt"),
    "front": re.compile(STEM + r"front\.txt"),
}
"""Such as `trial1_wheel_imu.txt`, `2_test_imu.txt`, `hill1__wheel_vel_input.txt`, `trial1_loop_front.txt`, or
`wheel_imu.txt` in a folder of its own. `inekf_wheel_vel.txt` is an estimator's output, not a sensor's."""
NUMBERED = re.compile(r"0*(\d+)(?:_test)?")
"""`2_test` and `02` are other names of `trial2`."""
NORM_TOLERANCE = 1e-3
FRONT_DEG = 5.0
"""Yaw of the two rigid bodies may differ by this, as they start together and share a robot."""
LOST_FRAME = 1.5
"""An interval of so many periods lacks a frame."""


@dataclass(frozen=True)
class RecordingFile:
    """One file of a recording: what it holds, and the name that it shares with the others."""

    path: Path
    kind: str
    stem: str


def claims(path: Path, head: bytes) -> bool:
    """Whether the name is one of the set's, and the first line is numbers between blanks."""
    return path.is_file() and _part(path) is not None and are_numbers(head)


def companions(path: Path) -> list[Path]:
    """The files that are read with it, also those that are then found to be of another time."""
    given = _part(path)
    assert given is not None, "claimed by its name"
    return [part.path for part in _family(given)[1]]


def read(request: Request) -> list[Recording]:
    """The one recording that the file belongs to.

    Raises:
        DataError: a file of it is bad, the choice of files is open, a time runs backwards, the wheels
            move sideways, or a quaternion has not unit length.
    """
    given = _part(request.path)
    assert given is not None, "claimed by its name"
    name, parts = _family(given)
    rows = {part.kind: read_rows(part.path, COLUMNS[part.kind]) for part in parts}
    rows, jumps, clock = in_time(rows, repair_clock=request.repair_clock)
    rows, apart = _contemporaries(rows, given.kind)
    others = ", ".join(r.path.name for r in rows.values() if r.path != given.path)
    joined = f"joined with {given.path.name}: {others}" if others else f"{given.path.name} stands alone"
    notes = [joined, *apart, *clock, *(note for r in rows.values() for note in r.notes)]
    truth, truth_notes = _truth(rows)
    held = truth_contents(truth)
    truth_kind = "center" if "center" in rows else "front"
    wheels, wheel_notes = _wheels(rows.get("wheels"), given.kind == "wheels")
    imu = rows.get("imu")
    recording = Recording(
        name=name or request.path.resolve().parent.name,
        start_ns=max(min(int(r.t_ns[0]) for r in rows.values()), 0),  # no recording starts before 1970
        wheels=wheels,
        imu=Imu(imu.t_ns, imu.stack(("wx", "wy", "wz")), imu.stack(("ax", "ay", "az"))) if imu else None,
        truth=truth,
        truth_channels=held if "center" in rows else tuple(name for name in held if name != "position"),
        clock_jumps=tuple(
            replace(jump, channel="truth") if jump.channel == truth_kind else jump for jump in jumps
        ),
        notes=(*notes, *truth_notes, *wheel_notes),
    )
    return [recording]


def _part(path: Path) -> RecordingFile | None:
    for kind, pattern in NAMES.items():
        found = pattern.fullmatch(path.name)
        if found:
            return RecordingFile(path, kind, found["stem"] or "")
    return None


def _robot_name(stem: str) -> str:
    numbered = NUMBERED.fullmatch(stem)
    return f"trial{numbered[1]}" if numbered else stem


def _family(given: RecordingFile) -> tuple[str, list[RecordingFile]]:
    """Name of the recording and its files, one of a kind.

    Motion capture files have the shape of the path behind the name it shares with IMU and wheels.
    """
    found = [part for path in sorted(given.path.parent.glob("*.txt")) if (part := _part(path)) is not None]
    robots = {_robot_name(p.stem) for p in found if p.kind in ("imu", "wheels")}
    name = _owner(given, robots)
    own = [p for p in found if _owner(p, robots) == name]
    kinds = dict.fromkeys([given.kind, *(p.kind for p in own)])
    return name, [_choice(given, kind, [p for p in own if p.kind == kind]) for kind in kinds]


def _owner(part: RecordingFile, robots: Iterable[str]) -> str:
    if part.kind in ("imu", "wheels"):
        return _robot_name(part.stem)
    return max((r for r in robots if f"{part.stem}_".startswith(f"{r}_")), key=len, default=part.stem)


def _choice(given: RecordingFile, kind: str, candidates: list[RecordingFile]) -> RecordingFile:
    if kind == given.kind:
        return given
    same = [part for part in candidates if part.stem == given.stem] or candidates
    if len(same) > 1:
        raise DataError(
            f"{' and '.join(part.path.name for part in same)} both go with it",
            remedy="put the files of one recording into a folder of their own",
        )
    return same[0]


def _contemporaries(rows: dict[str, TimedTable], given: str) -> tuple[dict[str, TimedTable], list[str]]:
    """The files that share time with the given one, and a note for each other."""
    first, last = rows[given].t_ns[0], rows[given].t_ns[-1]
    shared = {kind: r for kind, r in rows.items() if r.t_ns[0] <= last and r.t_ns[-1] >= first}
    return shared, [
        f"{r.path.name} has no time in common with {rows[given].path.name}; not joined"
        for kind, r in rows.items()
        if kind not in shared
    ]


def _wheels(rows: TimedTable | None, asked_for: bool) -> tuple[Wheels | None, list[str]]:
    """The speed of the wheels; what moves sideways is the velocity of another source."""
    if rows is None:
        return None, []
    sideways = np.flatnonzero(rows.stack(("vy", "vz")).any(axis=1))
    if not sideways.size:
        note = "wheels: vy and vz are zero throughout and left out; the speed says nothing of yaw"
        return Wheels(rows.t_ns, rows.stack(("vx",)), ("speed",), "mps"), [note]
    if not asked_for:
        return None, [f"{rows.path.name} moves sideways: no speed of wheels; left out"]
    vy, vz = (rows.numbers[name][sideways[0]] for name in ("vy", "vz"))
    what = f"wheels that move sideways: vy {vy:g}, vz {vz:g} m/s"
    remedy = "are the columns t, vx, vy, vz? a body velocity of another source is not read as wheels"
    raise rows.error(int(sideways[0]), what, remedy)


def _truth(rows: dict[str, TimedTable]) -> tuple[Trajectory | None, list[str]]:
    """The centre's path; the front body's where there is no other."""
    paths = {kind: _trajectory(rows[kind]) for kind in ("center", "front") if kind in rows}
    if not paths:
        return None, []
    notes = [f"{kind}: {text}" for kind, (_, texts) in paths.items() for text in texts]
    if len(paths) == 2:
        return paths["center"][0], [*notes, _front_note(paths["center"][0], paths["front"][0])]
    (kind, (truth, _)) = next(iter(paths.items()))
    if kind == "front":
        notes.append("truth is the rigid body at the front, ahead of the centre: only its yaw is the robot's")
    return truth, notes


def _trajectory(rows: TimedTable) -> tuple[Trajectory, list[str]]:
    norm = np.linalg.norm(rows.stack(POSE[4:]), axis=1)
    bad = np.flatnonzero(np.abs(norm - 1.0) > NORM_TOLERANCE)
    if bad.size:
        row = int(bad[0])
        remedy = "are the columns t, x, y, z, qx, qy, qz, qw?"
        raise rows.error(row, f"the quaternion has length {norm[row]:.3f}, not 1", remedy)
    notes = []
    once = new_times(rows.t_ns)
    if not once.all():
        notes.append(f"{int((~once).sum())} rows repeat a time; only the first of each is used")
        rows = rows.select(once)
    if len(rows) > 1:
        notes += _gaps(rows.t_ns)
    position, quaternion = rows.stack(POSE[1:4]), rows.stack(POSE[4:])
    if max(np.abs(position[0]).max(), np.abs(quaternion[0, :3]).max()) > NORM_TOLERANCE:
        notes.append("does not start at the identity, as this format does: check its axes")
    return Trajectory(rows.t_ns, position, quaternion), notes


def _gaps(t_ns: TimesNs) -> list[str]:
    interval_s = np.diff(t_ns) * 1e-9
    period_s = float(np.median(interval_s))
    gaps = interval_s[interval_s > LOST_FRAME * period_s]
    if not gaps.size:
        return []
    lost = int(np.round(gaps / period_s - 1.0).sum())
    share = lost / (len(t_ns) + lost)
    return [f"{lost} frames lost ({share:.1%}) in {gaps.size} gaps, the longest {gaps.max():.2f} s"]


def _front_note(center: Trajectory, front: Trajectory) -> str:
    yaw = yaw_of(front.quaternions_at(center.t_ns)) - center.yaw_rad()
    apart = np.degrees(np.abs(wrap_angle(yaw[np.isfinite(yaw)])))
    if not apart.size:
        return "front: no time in common with the centre"
    agreement = f"yaw within {np.percentile(apart, 95):.1f} deg of the centre's in 95 % of the frames"
    verdict = "" if np.median(apart) < FRONT_DEG else ": one of the two is wrong"
    return f"front: second rigid body, used to check the centre only; {agreement}{verdict}"
