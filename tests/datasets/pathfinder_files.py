"""Workspaces as the Pathfinder's are published, made of a drive that is known."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from terrafusion.datasets.core.frames import enu_to_geodetic
from terrafusion.datasets.core.gnss_time import GPS_EPOCH_S

START_S = 1_600_000_000.25
SECONDS = 60.0
RADIUS_M, TRACK_M = 0.116, 1.03
DATUM = (39.65, -79.97, 300.0)
WEEK_START_S = GPS_EPOCH_S + (1_600_000_000 - GPS_EPOCH_S) // 604_800 * 604_800


def motion(t: np.ndarray) -> tuple[np.ndarray, ...]:
    """Speed, yaw rate, east and north at seconds from the start: stops and turns."""
    fine = np.arange(-5.0, SECONDS + 5.0, 0.002)
    v = 0.7 * np.clip(2.0 * np.sin(0.35 * fine), 0.0, 1.0)
    rate = 0.4 * np.sin(0.8 * fine) * (v > 0)
    yaw = np.cumsum(rate) * 0.002
    east, north = np.cumsum(v * np.cos(yaw)) * 0.002, np.cumsum(v * np.sin(yaw)) * 0.002
    return tuple(np.interp(t, fine, column) for column in (v, rate, east, north))


def workspace() -> dict[str, np.ndarray]:
    """The variables of a workspace without fixes."""
    t, t_imu = np.arange(0.0, SECONDS, 0.1), np.arange(0.0, SECONDS, 0.004)
    v, rate, *_ = motion(t)
    table = {"tTodom": START_S + t, "tTimu": START_S + t_imu}
    for name in ("frontLeft", "rearLeft", "frontRight", "rearRight"):
        sign = -1.0 if name.endswith("Left") else 1.0
        speed = (v + sign * rate * TRACK_M / 2) * sign / RADIUS_M
        table |= {f"{name}Vel": speed, f"{name}Pos": np.cumsum(speed) * 0.1}
    v, rate, *_ = motion(t_imu)
    noise = np.random.default_rng(1).normal(0.0, 0.02, (6, len(t_imu)))
    table |= {"Ax": np.gradient(v, t_imu), "Ay": -v * rate, "Az": -9.8 + 0.0 * v}
    table |= {"Gx": 0.0 * v, "Gy": 0.0 * v, "Gz": -rate}
    return table | {n: table[n] + e for n, e in zip(("Ax", "Ay", "Az", "Gx", "Gy", "Gz"), noise, strict=True)}


def fixes(t: np.ndarray) -> dict[str, np.ndarray]:
    """Fixes of a few millimetres at seconds from the start."""
    _, _, east, north = motion(t)
    enu = np.stack([east, north, 0.0 * east], axis=1) + np.random.default_rng(2).normal(0, 0.002, (len(t), 3))
    llh = enu_to_geodetic(enu - enu[0], DATUM)
    return {"ENUGPS": enu - enu[0], "llhGPS": np.stack([*np.radians(llh[:, :2].T), llh[:, 2]], axis=1)}


def save(path: Path, table: dict[str, np.ndarray], times: np.ndarray | None = None) -> Path:
    """As MATLAB does: text before the HDF5, vectors as rows; `times` as a column of a table object."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in table.items():
            rows = values.reshape(1, -1) if values.ndim == 1 else values
            file.create_dataset(name, data=rows, compression="gzip").attrs["MATLAB_class"] = np.bytes_(
                "double"
            )
        if times is not None:
            add_table(file, {"time": times, "x": 0.0 * times})
    data = path.read_bytes()
    path.write_bytes(b"MATLAB 7.3 MAT-file, Platform: test".ljust(508) + b"\x00\x02IM" + data[512:])
    return path


def add_table(file: h5py.File, columns: dict[str, np.ndarray]) -> None:
    """A MATLAB table, as far as its numbers go."""
    refs = file.create_group("#refs#")

    def put(name: str, values: np.ndarray, kind: str) -> h5py.Reference:
        data = refs.create_dataset(name, data=values)
        data.attrs["MATLAB_class"] = np.bytes_(kind)
        return data.ref

    def cell(name: str, parts: list[h5py.Reference]) -> h5py.Reference:
        data = refs.create_dataset(name, (len(parts), 1), dtype=h5py.ref_dtype)
        data[:, 0] = parts
        data.attrs["MATLAB_class"] = np.bytes_("cell")
        return data.ref

    values = [put(f"v{i}", c.reshape(1, -1), "double") for i, c in enumerate(columns.values())]
    names = [put(f"n{i}", np.array([[ord(x)] for x in n], np.uint16), "char") for i, n in enumerate(columns)]
    objects = [put("rows", np.zeros((1, 1)), "double"), cell("values", values), cell("names", names)]
    mcos = file.create_dataset("#subsystem#/MCOS", (1, len(objects)), dtype=h5py.ref_dtype)
    mcos[0, :] = objects
