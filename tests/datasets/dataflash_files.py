"""A small DataFlash log, as ArduPilot's rovers write them."""

import struct

import numpy as np

RADIUS_M, TRACK_M = 0.1, 0.5
TYPES = {
    "PARM": (1, "QNff", "TimeUS,Name,Value,Default"),
    "IMU": (2, "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
    "GPS": (3, "QBBIHBCLLefff", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ"),
    "GPA": (4, "QBCCCC", "TimeUS,I,VDop,HAcc,VAcc,SAcc"),
    "WENC": (5, "Qfbfb", "TimeUS,Dist0,Qual0,Dist1,Qual1"),
    "MSG": (6, "QZ", "TimeUS,Message"),
}
STRUCTS = {"C": "H", "L": "i", "e": "i", "N": "16s", "Z": "64s"}


def described(name: str, form: str = "", fields: str = "") -> bytes:
    """The message that describes a type, as `TYPES` has it where nothing is given."""
    kind, own_form, own_fields = TYPES[name]
    size = struct.calcsize("<" + "".join(STRUCTS.get(code, code) for code in own_form)) + 3
    texts = name.encode(), (form or own_form).encode(), (fields or own_fields).encode()
    return b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", kind, size, *texts)


def message(name: str, *values: object) -> bytes:
    kind, form, _ = TYPES[name]
    packed = struct.pack("<" + "".join(STRUCTS.get(code, code) for code in form), *values)
    return b"\xa3\x95" + bytes([kind]) + packed


def log(first_side: str = "left", seconds: int = 10) -> bytes:
    """A drive to the north-east at 1 m/s, the clock 5 s old at its begin; IMU at 50 Hz, the others at 10 Hz.

    The right wheel turns twice as far as the left one.
    """
    y = -TRACK_M / 2 if first_side == "left" else TRACK_M / 2
    parts = [
        b"\xa3\x95\x80"
        + struct.pack("<BB4s16s64s", 128, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")
    ]
    parts += [described(name) for name in TYPES]
    parameters = {"WENC_RADIUS": RADIUS_M, "WENC2_RADIUS": RADIUS_M, "WENC_POS_Y": y, "WENC2_POS_Y": -y}
    parts += [message("PARM", 1000, name.encode(), value, 0.0) for name, value in parameters.items()]
    parts.append(message("MSG", 1000, b"ArduRover V4.5.7"))
    for k in range(50 * seconds):
        us, way = 5_000_000 + 20_000 * k, 0.02 * k
        for sensor in (0, 1):
            parts.append(message("IMU", us, sensor, 0.1, 0.2, 0.3 + sensor, 1.0, 2.0, -9.8))
        if k % 5:
            continue
        north = round(1e7 * np.degrees(way * np.sqrt(0.5) / 6.37e6))
        status = 1 if k < 50 else 6
        place = 480_000_000 + north, 110_000_000, 50_000, 1.0, 45.0, -0.25
        parts.append(message("GPS", us, 0, status, 302_418_000 + 20 * k, 2312, 20, 80, *place))
        parts.append(message("GPA", us, 0, 100, 2, 4, 10))
        left, right = way, 2.0 * way
        parts.append(
            message(
                "WENC", us, *((left, 100, right, 100) if first_side == "left" else (right, 100, left, 100))
            )
        )
    return b"".join(parts)
