"""A recording as the tables and the `meta.yaml` keys of the log folder, for all writers."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.channels import Imu
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.files import unwritable
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.datasets.readers.channel_tables import (
    ACCEL,
    COVARIANCE,
    GYRO,
    QUATERNION,
    TRUTH_TWIST,
    rows_with_values,
)
from terrafusion.datasets.readers.log_meta import parse_meta

PLANAR_TWIST = ("u_mps", "v_mps", "r_radps")
NUMBERS = ("wheel_radius_m", "track_m", "drive", "wheelbase_m", "steering_ratio")


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turns what goes wrong while a log is written into a DataError of the path."""
    try:
        yield
    except UnicodeEncodeError as error:
        raise DataError(
            f"a text holds {error.object[error.start : error.end]!r}, which is no character",
            file=path,
            remedy="take it out of the texts of the recording",
        ) from None
    except OSError as error:
        raise unwritable(path, error) from None


@dataclass(frozen=True, eq=False)
class OutputTable:
    """The table of one channel: times (N,) int64 ns, and its columns (N,) by name, texts among them."""

    t_ns: NDArray[np.int64]
    columns: dict[str, NDArray[Any]]

    def is_full(self) -> bool:
        """Whether there are rows, and each holds a value."""
        if "label" in self.columns:
            held = self.columns["label"].astype(object) != ""
        else:
            numbers = {name: c for name, c in self.columns.items() if c.dtype.kind == "f"}
            held = rows_with_values(numbers, len(self.t_ns))
        return len(held) > 0 and bool(held.all())


def tables_of(recording: Recording) -> dict[str, OutputTable]:
    """The table of every channel that is there, empty ones too, and of the truth.

    Raises:
        DataError: the truth holds quaternions that a reader would refuse.
    """
    tables = {}
    for name in Recording.CHANNELS:
        channel = getattr(recording, name)
        if channel is not None:
            columns = channel.columns()
            if isinstance(channel, Imu) and not columns:  # a table needs columns
                both = np.hstack([channel.gyro_radps, channel.accel_mps2])
                columns = dict(zip((*GYRO, *ACCEL), both.T, strict=True))
            tables[name] = OutputTable(channel.t_ns, columns)
    if recording.truth is not None:
        q = recording.truth.quaternion
        if q is not None and (np.abs(np.linalg.norm(q, axis=1) - 1.0) > 0.01).any():
            raise DataError("quaternions are not of norm 1", channel="truth", remedy="normalise them")
        tables["truth"] = OutputTable(recording.truth.t_ns, truth_columns(recording.truth))
    return tables


def truth_columns(truth: Trajectory) -> dict[str, NDArray[Any]]:
    """Columns of truth.csv; what is not known at all has none."""
    columns: dict[str, NDArray[Any]] = {"x_m": truth.position_m[:, 0], "y_m": truth.position_m[:, 1]}
    if not np.isnan(truth.position_m[:, 2]).all():
        columns["z_m"] = truth.position_m[:, 2]
    if truth.quaternion is not None:
        columns |= {name: truth.quaternion[:, k] for k, name in enumerate(QUATERNION)}
    if truth.twist_body is not None:
        twist = {name: truth.twist_body[:, k] for name, k in TRUTH_TWIST.items()}
        columns |= {n: c for n, c in twist.items() if n in PLANAR_TWIST or not np.isnan(c).all()}
    if truth.covariance is not None:
        P = truth.covariance
        symmetric = P.tobytes() == np.ascontiguousarray(P.transpose(0, 2, 1)).tobytes()
        columns |= {n: P[:, i, j] for n, (i, j) in COVARIANCE.items() if i <= j or not symmetric}
    return columns


def meta_of(recording: Recording, file: Path, name: str) -> dict[str, Any]:
    """The keys of `meta.yaml`, checked as they will be on reading; `name` is what the log would be called.

    Raises:
        ConfigError: a value that the format does not take; the message is about `file`.
    """
    r, o = recording, recording.overrides
    source = r.terrain.source if r.terrain is not None else "annotation"
    places = {"antenna_m": o.antenna_m, "imu_m": o.imu_m, "datum": r.datum}
    meta: dict[str, Any] = {
        "name": r.name if r.name != name else None,
        "start_ns": int(r.start_ns),
        "vehicle": r.vehicle,
        "terrain": r.terrain_name or None,
        **{key: getattr(r, key) or None for key in ("description", "licence", "source")},
        **{key: getattr(o, key) for key in NUMBERS},
        **{key: place and [float(x) for x in place] for key, place in places.items()},
        "truth_channels": list(r.truth_channels) if r.truth is not None or r.truth_channels else None,
        "truth_frame": r.truth_frame if r.truth_frame != "base" else None,
        "terrain_source": source if source != "annotation" else None,
        "imu_frame_id": r.imu_frame_id or None,
        "notes": list(r.notes) or None,
        "clock_jumps": [
            {"channel": jump.channel, "t_ns": int(jump.t_ns), "step_s": float(jump.step_s)}
            for jump in r.clock_jumps
        ]
        or None,
    }
    meta = {key: value for key, value in meta.items() if value is not None}
    parse_meta(meta, file)
    return meta
