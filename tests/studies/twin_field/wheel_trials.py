"""Trials of one wheel in a test bed (CMU, MATLAB v5): forces, sinkage, slip and side-slip, mean and spread of
each trial.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import DataError, errors_of

TRIALS_FILE = "cmu_single_wheel/all_smooth_data.mat"
"""Name in the catalogue."""
LARGEST = 1e6
"""No force in N, speed in mm/s or height in mm of the test bed is larger."""

SLIP_TOLERANCE = 0.02
_QUANTITIES = {
    "angle": ("side_slip", "rad", np.pi / 180.0),
    "Fy": ("tractive_force", "n", -1.0),
    "Fx": ("side_force", "n", 1.0),
    "Fz": ("load", "n", -1.0),
    "Z": ("sinkage", "m", -1e-3),
    "Vx": ("travel_speed", "mps", 1e-3),
    "Vry": ("rim_speed", "mps", 1e-3),
}
"""Name and unit of each, and the factor from the file's axes and units to the wheel's axes and SI."""
FIELDS = {f"{kind}_{key}" for kind in ("avg", "std") for key in _QUANTITIES} | {
    *("Vry", "beta", "trial_num", "slip")
}


@dataclass(frozen=True, eq=False)
class WheelTrials:
    """Steady-state means over trials, all (N,), and standard deviations within a trial (`_sd`).

    The wheel's axes: x along its heading, y to its side, z up. The travel is turned from the heading
    by the side-slip angle.

    Attributes:
        slip: (rim - travel) / max(rim, travel): 0.9 spins, -1 is locked; below 0 the wheel is braked.
        side_slip_rad: from heading to travel; 0 rolls straight, pi/2 is pushed sideways.
        tractive_force_n: soil on wheel along the heading, negative where it resists.
        side_force_n: soil on wheel, against the side-slip.
        load_n: the wheel on the soil.
        sinkage_m: depth of the wheel below the surface.
        travel_speed_mps: of the axle along the travel.
        rim_speed_mps: rate times radius.
        commanded_rim_speed_mps, commanded_side_slip_rad: what was asked for.
        trial: number of the repetition on its day.
        notes: what was unexpected in the file, in sentences.
    """

    slip: Array
    side_slip_rad: Array
    tractive_force_n: Array
    side_force_n: Array
    load_n: Array
    sinkage_m: Array
    travel_speed_mps: Array
    rim_speed_mps: Array
    side_slip_sd_rad: Array
    tractive_force_sd_n: Array
    side_force_sd_n: Array
    load_sd_n: Array
    sinkage_sd_m: Array
    travel_speed_sd_mps: Array
    rim_speed_sd_mps: Array
    commanded_rim_speed_mps: Array
    commanded_side_slip_rad: Array
    trial: NDArray[np.int64]
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name, column in self.columns().items():
            if column.shape != self.slip.shape or column.ndim != 1:
                raise ValueError(f"{name} has the shape {column.shape} for {len(self.slip)} trials")

    def __len__(self) -> int:
        return len(self.slip)

    def columns(self) -> dict[str, NDArray[np.float64 | np.int64]]:
        """The arrays by name."""
        return {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name != "notes"}

    def summary(self) -> dict[str, float | int | tuple[float, ...]]:
        """What the trials cover: counts, ranges (lowest, highest), and the side-slip angles asked for."""
        spans = {
            name: (float(column.min()), float(column.max()))
            for name, column in self.columns().items()
            if not name.startswith("commanded") and "_sd" not in name and name != "trial"
        }
        return {
            "trials": len(self),
            "braked": int((self.slip < -SLIP_TOLERANCE).sum()),
            "driven": int((self.slip > SLIP_TOLERANCE).sum()),
            "commanded_side_slip_rad": tuple(np.unique(self.commanded_side_slip_rad).tolist()),
            **spans,
        }


def read_wheel_trials(path: Path | str) -> WheelTrials:
    """Read the trials of the CMU single-wheel test bed (`all_results` in a MATLAB v5 file).

    The file's force axes are those of its sensor: its x lies across the wheel, its y against the
    heading, its z down; heights are negative in the soil. Speeds are in mm/s, angles in degrees.

    Raises:
        DataError: the file is missing, broken or holds no trials, or a trial lacks a number.
    """
    path = Path(path)
    if not path.is_file():
        raise DataError("no such file", file=path, remedy="check the path")
    with errors_of(path):
        return _trials(path)


def _trials(path: Path) -> WheelTrials:
    found = _structures(path)
    columns = {name: _column(name, found[name]) for name in FIELDS}
    if not len(columns["slip"]):
        raise DataError("holds no trials", remedy="give the file as published")
    means = {f"{name}_{unit}": f * columns[f"avg_{key}"] for key, (name, unit, f) in _QUANTITIES.items()}
    spreads = {
        f"{name}_sd_{unit}": abs(f) * columns[f"std_{key}"] for key, (name, unit, f) in _QUANTITIES.items()
    }
    return WheelTrials(
        slip=columns["slip"],
        **means,
        **spreads,
        commanded_rim_speed_mps=columns["Vry"] * _QUANTITIES["Vry"][2],
        commanded_side_slip_rad=columns["beta"] * _QUANTITIES["angle"][2],
        trial=columns["trial_num"].astype(np.int64),
        notes=_checked_slip(columns["slip"], means["travel_speed_mps"], means["rim_speed_mps"]),
    )


def _structures(path: Path) -> NDArray[Any]:
    """The first array of structures (N,) with the trials' fields."""
    import scipy.io

    try:
        variables = scipy.io.loadmat(path)
    except (ValueError, TypeError, OSError, NotImplementedError) as error:
        raise DataError(f"the MATLAB file cannot be read: {error}", remedy="copy it again") from None
    for values in variables.values():
        if isinstance(values, np.ndarray) and set(values.dtype.names or ()) >= FIELDS:
            return values.ravel()
    raise DataError(
        f"holds no structures with {', '.join(sorted(FIELDS))}", remedy="give the file as published"
    )


def _column(name: str, raw: NDArray[Any]) -> Array:
    cells = [np.ravel(cell).astype(float) if cell.dtype.kind in "iuf" else np.zeros(0) for cell in raw]
    bad = next((i for i, cell in enumerate(cells) if cell.shape != (1,) or not abs(cell[0]) < LARGEST), None)
    if bad is not None:
        raise DataError(
            f"trial {bad} has {len(cells[bad])} values, or an impossible one",
            channel=name,
            remedy="a trial has one number of each",
        )
    return np.array([cell[0] for cell in cells])


def _checked_slip(slip: Array, travel_mps: Array, rim_mps: Array) -> tuple[str, ...]:
    """A note where the file's slip is not that of its speeds."""
    fastest = np.maximum(rim_mps, travel_mps)
    expected = np.where(fastest > 0.0, (rim_mps - travel_mps) / np.where(fastest > 0.0, fastest, 1.0), 0.0)
    off = np.abs(slip - expected)
    if off.max() <= SLIP_TOLERANCE:
        return ()
    wrong = int((off > SLIP_TOLERANCE).sum())
    return (f"slip: off the speeds by up to {off.max():.2f}, in {wrong} of {len(off)} trials",)
