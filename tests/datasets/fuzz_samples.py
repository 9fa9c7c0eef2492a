"""One small valid log of every format, for the fuzzer: a folder each, whose `.open` names what to open.

Pickles are left out: damaged ones are refused by their hash.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

START_NS = 1_700_000_000_000_000_000
RADIUS_M, TRACK_M, SECONDS = 0.165, 0.55, 20.0


def _drive(rate_hz: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Times (s), speed, yaw rate and position (N, 2) of a winding drive."""
    t = np.arange(0.0, SECONDS, 1.0 / rate_hz)
    v, rate = 1.0 + 0.3 * np.sin(0.5 * t), 0.3 * np.sin(0.4 * t)
    yaw = np.cumsum(rate) / rate_hz
    place = np.cumsum(np.stack([v * np.cos(yaw), v * np.sin(yaw)], axis=1), axis=0) / rate_hz
    return t, v, rate, place


def _ns(t_s: np.ndarray) -> np.ndarray:
    return START_NS + np.rint(t_s * 1e9).astype(np.int64)


def _inertial(rate_hz: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    t, _, rate, _ = _drive(rate_hz)
    gyro = rng.normal(0.0, 0.01, (len(t), 3)) + np.outer(rate, (0.0, 0.0, 1.0))
    return t, gyro, rng.normal((0.0, 0.0, 9.81), 0.2, (len(t), 3))


def _sides(v: np.ndarray, rate: np.ndarray) -> np.ndarray:
    return np.stack([v - rate * TRACK_M / 2, v + rate * TRACK_M / 2], axis=1)


def _recording() -> Any:
    from terrafusion.datasets.core.channels import Command, Gnss, Imu, Motor, Terrain, Wheels
    from terrafusion.datasets.core.frames import rpy_to_quaternion
    from terrafusion.datasets.core.recording import Overrides, Recording
    from terrafusion.datasets.core.trajectory import Trajectory

    t_imu, gyro, accel = _inertial(50)
    t, v, rate, place = _drive(10)
    t_ns, flat = _ns(t), np.hstack([place, np.zeros((len(t), 1))])
    yaw = np.cumsum(rate) / 10
    truth = Trajectory(t_ns, flat, rpy_to_quaternion(np.stack([0 * yaw, 0 * yaw, yaw], axis=1)))
    fix = np.full(len(t), 1, dtype=np.uint8)
    return Recording(
        "sample", START_NS, vehicle="husky",
        command=Command(t_ns, v, rate),
        wheels=Wheels(t_ns, _sides(v, rate) / RADIUS_M, ("left", "right"), "radps"),
        imu=Imu(_ns(t_imu), gyro, accel),
        gnss=Gnss(t_ns, flat, np.full((len(t), 3), 0.1), fix),
        motor=Motor(t_ns, np.full((len(t), 2), 3.0)),
        terrain=Terrain(t_ns[:1], np.array(["gravel"], dtype=object)),
        truth=truth, truth_channels=("position", "yaw"), datum=(46.8, -71.2, 90.0),
        overrides=Overrides(RADIUS_M, TRACK_M),
    )  # fmt: skip


def write_samples(folder: Path) -> list[Path]:
    """Write all samples into `folder`; returns their folders, sorted."""
    for write in (
        _log_folder,
        _bags,
        _matlab,
        _umich,
        _borealtc,
        _comma,
        _tum,
        _xsens,
        _pos,
        _nmea,
        _dataflash,
        _tables,
    ):
        write(folder)
    return sorted(path for path in folder.iterdir())


def _sample(folder: Path, name: str, opened: str) -> Path:
    """The folder of a sample, made; `opened` is what of it is to be opened ("" for itself)."""
    sample = folder / name
    sample.mkdir(parents=True)
    (sample / ".open").write_text(opened)
    return sample


def _log_folder(folder: Path) -> None:
    from terrafusion.datasets.writers import write_log_folder

    write_log_folder(_recording(), _sample(folder, "log_folder", "log") / "log")


def _bags(folder: Path) -> None:
    from rosbags.convert.converter import convert
    from rosbags.typesys import Stores, get_typestore

    from terrafusion.datasets.writers import write_mcap

    mcap = _sample(folder, "mcap", "drive.mcap") / "drive.mcap"
    write_mcap(_recording(), mcap)
    everything: tuple[list[str], ...] = ([], [], [], [])
    ros1, ros2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
    bag = _sample(folder, "ros1", "drive.bag") / "drive.bag"
    convert([mcap], bag, "", 0, None, "", ros2, ros1, *everything)
    database = _sample(folder, "db3", "drive/drive.db3") / "drive"
    convert([mcap], database, "sqlite3", 8, None, "", ros2, ros2, *everything)


def _matlab(folder: Path) -> None:
    import h5py

    t, v, rate, place = _drive(10)
    t_imu, gyro, accel = _inertial(100)
    sides = _sides(v, rate) / 0.11
    wheels = {
        "frontLeft": -sides[:, 0],
        "rearLeft": -sides[:, 0],
        "frontRight": sides[:, 1],
        "rearRight": sides[:, 1],
    }
    llh = np.stack([0.69 + place[:, 1] / 6.37e6, -1.39 + place[:, 0] / 4.9e6, 300.0 + 0 * t], axis=1)
    down = (1, -1, -1)
    rows: dict[str, Any] = {
        "tTimu": START_NS * 1e-9 + t_imu, "tTodom": START_NS * 1e-9 + t, "tTGPS": START_NS * 1e-9 + t,
        **{f"{name}Vel": w for name, w in wheels.items()},
        **{f"{name}Pos": np.cumsum(w) / 10 for name, w in wheels.items()},
        **{f"A{axis}": accel[:, k] * down[k] for k, axis in enumerate("xyz")},
        **{f"G{axis}": gyro[:, k] * down[k] for k, axis in enumerate("xyz")},
        "lin_x": v, "lin_y": 0 * v, "ang_z": rate, "Pos_x": place[:, 0], "Pos_y": place[:, 1],
        "LatSigma": 0 * t + 2.0, "LonSigma": 0 * t + 2.0, "HeightSigma": 0 * t + 4.0,
    }  # fmt: skip
    with h5py.File(_sample(folder, "matlab73", "run.mat") / "run.mat", "w", userblock_size=512) as file:
        for name, values in rows.items():
            file[name] = np.asarray(values)[None, :]
        file["llhGPS"] = llh
        file["ENUGPS"] = np.stack([place[:, 0], place[:, 1], 0 * t], axis=1)


def _text(path: Path, table: np.ndarray, mark: str = " ", header: str = "") -> None:
    lines = [mark.join(repr(float(x)) for x in row) for row in table]
    path.write_text("\n".join([header, *lines] if header else lines) + "\n")


def _umich(folder: Path) -> None:
    sample = _sample(folder, "umich", "trial9_wheel_imu.txt")
    t, gyro, accel = _inertial(50)
    origin = START_NS * 1e-9
    _text(sample / "trial9_wheel_imu.txt", np.column_stack([origin + t, gyro, accel]))
    t, v, rate, place = _drive(10)
    _text(sample / "trial9_wheel_vel.txt", np.column_stack([origin + t, v, 0 * v, 0 * v]))
    _text(sample / "trial9_oval_center.txt", _poses(origin + t, place, np.cumsum(rate) / 10))


def _poses(t: np.ndarray, place: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    zero = 0 * t
    return np.column_stack([t, place, zero, zero, zero, np.sin(yaw / 2), np.cos(yaw / 2)])


def _borealtc(folder: Path) -> None:
    sample = _sample(folder, "borealtc", "SNOW/imu_00.csv")
    (sample / "SNOW").mkdir()
    t, gyro, accel = _inertial(100)
    _text(sample / "SNOW" / "imu_00.csv", np.column_stack([t, gyro, accel]), ",", "time,wx,wy,wz,ax,ay,az")
    t, v, rate, _ = _drive(6.5)
    table = np.column_stack([t, 3 + 0 * t, 3 + 0 * t, _sides(v, rate)])
    _text(sample / "SNOW" / "pro_00.csv", table, ",", "time,curL,curR,velL,velR")


def _comma(folder: Path) -> None:
    from comma_files import write_segment  # type: ignore[import-not-found]

    write_segment(_sample(folder, "comma", "segment") / "segment")


def _tum(folder: Path) -> None:
    sample = _sample(folder, "tum", "poses.tum")
    t, _, rate, place = _drive(10)
    _text(sample / "poses.tum", _poses(START_NS * 1e-9 + t, place, np.cumsum(rate) / 10))


def _degrees(place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Latitude and longitude of places about 46.8 N, 71.2 W."""
    return 46.8 + place[:, 1] / 111_170.0, -71.2 + place[:, 0] / 76_300.0


def _xsens(folder: Path) -> None:
    t, gyro, accel = _inertial(100)
    latitude, longitude = _degrees(_drive(100)[3])
    vectors = [f"{name}_{axis}" for name in ("Acc", "Gyr") for axis in "XYZ"]
    names = "\t".join(["PacketCounter", "SampleTimeFine", *vectors, "Latitude", "Longitude", "Altitude"])
    lines = ["// Device ID: 0380ABCD", "// Update Rate: 100.0Hz", names]
    for k in range(len(t)):
        fix = (f"{latitude[k]:.9f}", f"{longitude[k]:.9f}", "90.0") if k % 20 == 0 else ("", "", "")
        cells = (k, round(t[k] * 1e4), *accel[k].round(6), *gyro[k].round(6), *fix)
        lines.append("\t".join(map(str, cells)))
    path = _sample(folder, "xsens", "MT_0380ABCD-000.txt") / "MT_0380ABCD-000.txt"
    path.write_text("\n".join(lines) + "\n")


def _pos(folder: Path) -> None:
    t, _, _, place = _drive(5)
    lines = [
        "% program   : RTKLIB",
        "% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp)",
        "%  GPST                  latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)"
        "  sdne(m)  sdeu(m)  sdun(m) age(s)  ratio",
    ]
    for at, latitude, longitude in zip(t, *_degrees(place), strict=True):
        whole, rest = divmod(round(at * 1000), 1000)
        lines.append(
            f"2023/11/14 22:13:{20 + whole:02d}.{rest:03d}  {latitude:.9f}  {longitude:.9f}  90.0000   1  12"
            "   0.0100   0.0100   0.0200   0.0   0.0   0.0   0.00    9.9"
        )
    (_sample(folder, "rtklib", "rover.pos") / "rover.pos").write_text("\n".join(lines) + "\n")


def _nmea(folder: Path) -> None:
    t, v, _, place = _drive(5)
    lines = []
    for at, latitude, longitude, speed in zip(t, *_degrees(place), v, strict=True):
        clock = f"2213{20 + at:05.2f}"
        north = f"46{(latitude - 46) * 60:09.6f},N"
        west = f"071{(-longitude - 71) * 60:09.6f},W"
        for body in (
            f"GNGGA,{clock},{north},{west},4,12,0.8,90.0,M,-30.0,M,1.0,0000",
            f"GNRMC,{clock},A,{north},{west},{speed / 0.514444:.3f},45.0,141123,,,R",
            f"GNGST,{clock},0.02,0.01,0.01,0.0,0.01,0.01,0.02",
        ):
            total = 0
            for letter in body.encode():
                total ^= letter
            lines.append(f"${body}*{total:02X}")
    (_sample(folder, "nmea", "receiver.nmea") / "receiver.nmea").write_text("\r\n".join(lines) + "\r\n")


MAP = """
time: {column: stamp, unit: s, epoch: unix}
track_m: 0.55
channels:
  imu:
    gyro_z_radps: {column: gz, unit: deg/s}
    accel_z_mps2: {column: az, unit: g}
  wheels: {left_mps: vl, right_mps: vr}
  gnss: {latitude_deg: lat, longitude_deg: lon}
"""


def _tables(folder: Path) -> None:
    import pandas as pd

    t, gyro, accel = _inertial(50)
    _, v, rate, place = _drive(50)
    latitude, longitude = _degrees(place)
    table = pd.DataFrame(
        {
            "stamp": START_NS * 1e-9 + t, "gz": np.degrees(gyro[:, 2]), "az": accel[:, 2] / 9.80665,
            "vl": _sides(v, rate)[:, 0], "vr": _sides(v, rate)[:, 1], "lat": latitude, "lon": longitude,
        }
    )  # fmt: skip
    text = _sample(folder, "table", "drive.csv")
    table.to_csv(text / "drive.csv", index=False)
    (text / "drive.csv.columns.yaml").write_text(MAP)
    packed = _sample(folder, "parquet", "drive.parquet")
    table.to_parquet(packed / "drive.parquet", index=False)
    (packed / "drive.parquet.columns.yaml").write_text(MAP)


def _dataflash(folder: Path) -> None:
    from tests.datasets.dataflash_files import log

    (_sample(folder, "dataflash", "rover.bin") / "rover.bin").write_bytes(log())
