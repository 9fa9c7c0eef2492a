"""Write a recording as a log folder; reading it back gives the same numbers to the bit."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.errors import DataError
from terrafusion.datasets.readers.log_folder import CHANNELS, META, QUATERNION, TRUTH_TWIST, WHEEL_LAYOUTS
from terrafusion.datasets.recording import Recording, Wheels
from terrafusion.datasets.trajectory import Trajectory


def write_log_folder(recording: Recording, folder: Path | str) -> Path:
    """Write `meta.yaml` and one CSV a channel into `folder`, which is made where needed.

    Values keep all their bits, times their nanoseconds; NaN becomes an empty cell. What the
    format has no column for is not kept: the reader's notes, and of the truth its covariance
    and the twist beyond u, v, r. A log folder that is already there is replaced.

    Raises:
        DataError: `folder` is a file, or holds other things than a log; or the wheels have a
            layout the format does not know.
    """
    folder = Path(folder)
    _check_wheels(recording.wheels, folder)
    _make_room(folder)
    try:
        for name, channel in recording.channels().items():
            _write_table(folder / f"{name}.csv", channel.t_ns - recording.start_ns, channel.columns())
        if recording.truth is not None and len(recording.truth):
            truth = recording.truth
            _write_table(folder / "truth.csv", truth.t_ns - recording.start_ns, _truth_columns(truth))
        _write_meta(recording, folder / META)
    except OSError as error:
        raise _unwritable(folder, error) from None
    return folder


def _unwritable(folder: Path, error: OSError) -> DataError:
    return DataError(
        f"cannot be written: {error.strerror or error}",
        file=folder,
        remedy="choose a folder you may write to, with room on the disk",
    )


def _make_room(folder: Path) -> None:
    """Make the folder, and take an older log out of it so that no stale channel stays."""
    if folder.exists() and not folder.is_dir():
        raise DataError("is a file", file=folder, remedy="give a folder to write the log into")
    try:
        if folder.is_dir() and any(folder.iterdir()) and not (folder / META).is_file():
            raise DataError(
                "the folder is not empty and holds no log", file=folder, remedy="give an empty or new folder"
            )
        folder.mkdir(parents=True, exist_ok=True)
        for name in CHANNELS:
            (folder / f"{name}.csv").unlink(missing_ok=True)
            (folder / f"{name}.csv.gz").unlink(missing_ok=True)
    except OSError as error:
        raise _unwritable(folder, error) from None


def _check_wheels(wheels: Wheels | None, folder: Path) -> None:
    if wheels is not None and (wheels.names, wheels.unit) not in WHEEL_LAYOUTS:
        raise DataError(
            f"the format has no columns for wheels {', '.join(wheels.names)} in {wheels.unit}",
            file=folder,
            channel="wheels",
            remedy="give left and right, or four wheels in rad/s",
        )


def _truth_columns(truth: Trajectory) -> dict[str, NDArray[Any]]:
    columns: dict[str, NDArray[Any]] = {"x_m": truth.position_m[:, 0], "y_m": truth.position_m[:, 1]}
    if not np.isnan(truth.position_m[:, 2]).all():
        columns["z_m"] = truth.position_m[:, 2]
    if truth.quaternion is not None:
        columns |= {name: truth.quaternion[:, k] for k, name in enumerate(QUATERNION)}
    if truth.twist_body is not None:
        columns |= {name: truth.twist_body[:, k] for name, k in TRUTH_TWIST.items()}
    return columns


def _write_table(path: Path, since_start_ns: NDArray[np.int64], columns: dict[str, NDArray[Any]]) -> None:
    cells = [[seconds_text(t) for t in since_start_ns.tolist()]]
    cells += [_cells(column) for column in columns.values()]
    with path.open("w", encoding="utf-8", newline="") as out:
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(["t_s", *columns])
        writer.writerows(zip(*cells, strict=True))


def _cells(column: NDArray[Any]) -> list[str]:
    """Shortest decimals that read back to the same double; empty for NaN."""
    if column.dtype == object or column.dtype.kind in "US":
        return [str(value) for value in column.tolist()]
    return ["" if value != value else repr(value) for value in column.astype(float).tolist()]


def seconds_text(t_ns: int) -> str:
    """Nanoseconds as decimal seconds with 9 decimals, exactly."""
    sign = "-" if t_ns < 0 else ""
    whole, rest = divmod(abs(t_ns), 10**9)
    return f"{sign}{whole}.{rest:09d}"


def _write_meta(recording: Recording, path: Path) -> None:
    from ruamel.yaml import YAML

    overrides = recording.overrides
    meta: dict[str, Any] = {
        "start_ns": int(recording.start_ns),
        "vehicle": recording.vehicle,
        "terrain": recording.terrain_name,
        "description": recording.description,
        "licence": recording.licence,
        "source": recording.source,
        "wheel_radius_m": overrides.wheel_radius_m,
        "track_m": overrides.track_m,
        "antenna_m": overrides.antenna_m and [float(x) for x in overrides.antenna_m],
        "imu_m": overrides.imu_m and [float(x) for x in overrides.imu_m],
        "datum": recording.datum and [float(x) for x in recording.datum],
        "truth_channels": list(recording.truth_channels) or None if recording.truth is not None else None,
    }
    if recording.truth is not None and recording.truth_frame != "base":
        meta["truth_frame"] = recording.truth_frame
    if recording.terrain is not None and recording.terrain.source != "annotation":
        meta["terrain_source"] = recording.terrain.source
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = None
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    with path.open("w", encoding="utf-8") as out:
        yaml.dump({key: value for key, value in meta.items() if value not in (None, "")}, out)
