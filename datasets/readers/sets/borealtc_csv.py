"""CSV pairs of BorealTC, and of sets in its form: `TERRAIN/imu_NN.csv` and `TERRAIN/pro_NN.csv`.

`imu_NN`: time s, wx wy wz rad/s, ax ay az m/s2. `pro_NN`: time s, curL curR A, velL velR m/s. The two
of one number are one run, the folder names its ground, and both begin at 0: no absolute time.
"""

import re
from pathlib import Path

import numpy as np

from terrafusion.datasets.core.channels import TERRAINS, Imu, Motor, Terrain, Wheels
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers.delimited import head_lines, split
from terrafusion.datasets.readers.formats import Request
from terrafusion.datasets.readers.timed_tables import TimedTable, in_time, read_rows

COLUMNS = {
    "imu": ("time", "wx", "wy", "wz", "ax", "ay", "az"),
    "pro": ("time", "curL", "curR", "velL", "velR"),
}
NAME = re.compile(r"(?P<kind>imu|pro)_(?P<run>\w{1,40})\.csv")
FOLDER = re.compile(r"[A-Z][A-Z0-9]*(_[A-Z0-9]+)*")
CLASS_OF_FOLDER = {"PLOUGHED": "ploughed_soil"}
"""Grounds whose class in this library has another name than the folder."""
LATEST_START_NS = 60 * 10**9
"""Times count from the start of the run; what begins later is of another clock."""
EVEN_NS = 1000
"""Stamps of a clock scatter by more than this."""


def claims(path: Path, head: bytes) -> bool:
    """Whether the name and the header are those of the form, the columns in any order."""
    named = NAME.fullmatch(path.name) if path.is_file() else None
    if named is None:
        return False
    header = next((line for _, line in head_lines(head, 1)), "")
    return sorted(split(header, ",")) == sorted(COLUMNS[named["kind"]])


def companions(path: Path) -> list[Path]:
    """The files of the run."""
    return [file for file in _pair(path).values() if file.is_file()]


def read(request: Request) -> list[Recording]:
    """The one run that the file belongs to; its times count from the start of the run.

    Raises:
        DataError: a file of the run is bad, or a time runs backwards.
    """
    folder, run, files = request.path.parent, _run(request.path), _pair(request.path)
    rows = {
        kind: read_rows(path, COLUMNS[kind], separator=",", header=True)
        for kind, path in files.items()
        if path.is_file()
    }
    rows, jumps, clock = in_time(rows, repair_clock=request.repair_clock)
    for r in rows.values():
        if abs(int(r.t_ns[0])) > LATEST_START_NS:
            raise DataError(
                f"begins at {r.t_ns[0] * 1e-9:.6g} s, not at 0",
                file=r.path,
                remedy="subtract the start of the run from both files",
            )
    terrain, terrain_note = _terrain(folder.resolve().name)
    notes = [*_pairing(rows), *clock, *(note for r in rows.values() for note in r.notes), terrain_note]
    imu, pro = rows.get("imu"), rows.get("pro")
    recording = Recording(
        name=f"{folder.resolve().name}/{run}",
        start_ns=0,
        wheels=Wheels(pro.t_ns, pro.stack(("velL", "velR")), ("left", "right"), "mps") if pro else None,
        imu=Imu(imu.t_ns, imu.stack(("wx", "wy", "wz")), imu.stack(("ax", "ay", "az"))) if imu else None,
        motor=Motor(pro.t_ns, pro.stack(("curL", "curR"))) if pro else None,
        terrain=Terrain.throughout(0, terrain) if terrain else None,
        terrain_name=terrain,
        clock_jumps=jumps,
        notes=tuple(notes),
    )
    return [recording]


def _run(path: Path) -> str:
    named = NAME.fullmatch(path.name)
    assert named is not None, "claimed by its name"
    return named["run"]


def _pair(path: Path) -> dict[str, Path]:
    """Where the files of the run lie, or would lie, by kind."""
    return {kind: path.parent / f"{kind}_{_run(path)}.csv" for kind in COLUMNS}


def _terrain(folder: str) -> tuple[str, str]:
    """Terrain label by the folder's name, "" for none, and a note."""
    if not FOLDER.fullmatch(folder):
        return "", f"the folder '{folder}' names no ground (such as SNOW): no terrain label"
    label = CLASS_OF_FOLDER.get(folder, folder.lower())
    known = "" if label in TERRAINS else "; the library has no class for it"
    return label, f"terrain: '{label}' from the folder {folder}{known}"


def _pairing(rows: dict[str, TimedTable]) -> list[str]:
    """How the two files were put together, and what their times are worth."""
    notes = ["times count from the start of the run; the set has no absolute ones"]
    if len(rows) == 1:
        alone = next(iter(rows.values()))
        return [f"{alone.path.name} stands alone", *notes]
    imu, pro = rows["imu"], rows["pro"]
    ends = abs(int(imu.t_ns[-1]) - int(pro.t_ns[-1])) * 1e-9
    notes.append(
        f"{imu.path.name} and {pro.path.name} are assumed to start together; they end {ends:.2f} s apart"
    )
    even = [r.path.name for r in rows.values() if len(r) > 2 and int(np.ptp(np.diff(r.t_ns))) <= EVEN_NS]
    if even:
        notes.append(
            f"times of {' and '.join(even)} are exactly even: counted from a nominal rate, not stamped; "
            "the two may drift apart"
        )
    return notes
