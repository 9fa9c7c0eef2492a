"""Which recordings are compared, read from a folder of public sets or named one by one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from terrafusion.datasets.catalog.catalog import CatalogFile, load_catalog
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers.open import open_recordings
from terrafusion.fusion.benchmark.field_logs import CUT
from tests.studies.field_runs import WHOLE
from tests.studies.joined_windows import chains_of
from tests.studies.twin_field.field_run import FieldRun, field_run

SETS = ("norlab_drive", "umich_husky", "wvu_pathfinder")
"""Sets with a reference for the motion; of the others of the catalogue only the wheels are known."""


@dataclass
class Drives:
    """Runs by vehicle, and why other recordings were left out."""

    runs: dict[str, list[FieldRun]] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)


def read(data: Sequence[Path | str], progress: Callable[[str], None] = lambda _: None) -> Drives:
    """The drives of folders that hold sets of the catalogue, and of single logs.

    Raises:
        DataError: a folder holds none of the sets; a log cannot be read or does not name its vehicle.
    """
    drives = Drives()
    for name, path in _logs(data, drives.left_out):
        progress(f"reading {name}")
        recordings = open_recordings(path)
        if not all(map(_can_be_told, recordings)):
            drives.left_out[name] = "no wheels or no gyro"
            continue
        runs = field_runs(name, recordings)
        scored = any(run.has_sides or np.isfinite(run.velocity_mps).any() for run in runs)
        if not scored:
            drives.left_out[name] = (
                "no reference for the speed, and no left and right wheels to tell the turn"
            )
            continue
        drives.runs.setdefault(runs[0].vehicle.name, []).extend(runs)
    return drives


def field_runs(name: str, recordings: Sequence[Recording]) -> list[FieldRun]:
    """The runs of one file; consecutive windows are joined.

    Raises:
        DataError: the log has no wheels or no gyro, or does not say which vehicle it is.
    """
    chains = chains_of(recordings)
    return [
        field_run(f"{name}#{k}" if len(chains) > 1 else name, name, chain) for k, chain in enumerate(chains)
    ]


def _can_be_told(recording: Recording) -> bool:
    """Whether it has what a model needs: wheels, and a gyro for the heading."""
    wheels, imu = recording.wheels, recording.imu
    if wheels is None or imu is None or min(len(wheels), len(imu)) < 2:
        return False
    return int(np.isfinite(imu.gyro_radps[:, 2]).sum()) >= 2


def _logs(data: Sequence[Path | str], left_out: dict[str, str]) -> list[tuple[str, Path | str]]:
    found: list[tuple[str, Path | str]] = []
    for place in data:
        if Path(place).is_dir() and not (Path(place) / "meta.yaml").is_file():
            found.extend(_of_folder(Path(place), left_out))
        else:
            found.append((str(place), place))
    return found


def _of_folder(folder: Path, left_out: dict[str, str]) -> list[tuple[str, Path | str]]:
    catalogued = {
        name: folder / entries[0].file
        for name, entries in load_catalog().recordings().items()
        if entries[0].set_name in SETS and _are_there(folder, entries)
    }
    if not catalogued:
        raise DataError(
            f"holds no recording of {', '.join(SETS)}", file=folder,
            remedy="give the folder that `terrafusion fetch` filled, or the logs themselves",
        )  # fmt: skip
    out: list[tuple[str, Path | str]] = []
    for name, path in sorted(catalogued.items()):
        drive, _, kind = name.rpartition("/")
        if kind == CUT and f"{drive}/{WHOLE}" in catalogued:
            left_out[name] = f"cut from {drive}/{WHOLE}"
        else:
            out.append((name, path))
    return out


def _are_there(folder: Path, entries: Sequence[CatalogFile]) -> bool:
    return all((folder / entry.file).is_file() for entry in entries)
