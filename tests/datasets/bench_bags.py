"""How long a bag of a million messages takes to become arrays, beside rosbags message by message.

    python tests/datasets/bench_bags.py [--messages 1000000] [--folder FOLDER]

Writes bags of an IMU at 400 Hz, wheel odometry at 50 Hz and fixes at 10 Hz, and reads each in two
processes of its own: by `open_recording`, from the call to the finished Recording, and by rosbags'
`AnyReader`, every message deserialised. Times are wall clock and CPU; "first" is the first call of a
process, with what it loads, "again" the second. Memory is the growth of the largest resident size over
the first call, by message.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

T0 = 1_600_000_000_000_000_000
TOPICS = (
    ("/imu/data", "sensor_msgs/msg/Imu", 400),
    ("/odom", "nav_msgs/msg/Odometry", 50),
    ("/fix", "sensor_msgs/msg/NavSatFix", 10),
)
KINDS = ("bag", "bag lz4", "mcap", "mcap zstd", "mcap unchunked", "db3")


def store_of(kind: str) -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC if kind.startswith("bag") else Stores.ROS2_HUMBLE)


def raw_messages(kind: str) -> list[tuple[bytearray, int]]:
    """One serialised message a topic, and where its stamp is."""
    store = store_of(kind)
    new, ros1 = store.types, kind.startswith("bag")
    stamp = new["builtin_interfaces/msg/Time"](0, 0)
    header = new["std_msgs/msg/Header"](*([0] if ros1 else []), stamp, "base_link")
    status = new["sensor_msgs/msg/NavSatStatus"](0, 1)
    vector = new["geometry_msgs/msg/Vector3"](0.1, 0.2, 0.3)
    turn = new["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    pose = new["geometry_msgs/msg/Pose"](new["geometry_msgs/msg/Point"](0.0, 0.0, 0.0), turn)
    twist = new["geometry_msgs/msg/Twist"](vector, vector)
    messages = (
        new[TOPICS[0][1]](header, turn, np.zeros(9), vector, np.zeros(9), vector, np.zeros(9)),
        new[TOPICS[1][1]](
            header, "base_link", new["geometry_msgs/msg/PoseWithCovariance"](pose, np.zeros(36)),
            new["geometry_msgs/msg/TwistWithCovariance"](twist, np.zeros(36)),
        ),
        new[TOPICS[2][1]](header, status, 48.0, 11.0, 500.0, np.ones(9), 2),
    )  # fmt: skip
    serialize = store.serialize_ros1 if ros1 else store.serialize_cdr
    return [(bytearray(serialize(m, t)), 4) for m, (_, t, _) in zip(messages, TOPICS, strict=True)]


def write(kind: str, path: Path, count: int) -> None:
    """A bag of about `count` messages, in the order of receipt; stamps and noise differ in each."""
    raws = raw_messages(kind)
    seconds = count / sum(rate for *_, rate in TOPICS)
    rows = []
    for topic, (_, _, rate) in enumerate(TOPICS):
        stamps = T0 + np.arange(round(seconds * rate)) * (10**9 // rate)
        rows.append(np.stack([stamps + 1_000_000 * (topic + 1), np.full(len(stamps), topic), stamps], axis=1))
    every = np.concatenate(rows)
    noise = np.random.default_rng(0).normal(size=100_000).tobytes()
    put, close = writer_of(kind, path)
    for i, (receipt, topic, stamp) in enumerate(every[np.argsort(every[:, 0], kind="stable")].tolist()):
        raw, at = raws[topic]
        raw[at : at + 8] = np.array(divmod(stamp, 10**9), dtype="<u4").tobytes()
        raw[-24:] = noise[(i * 24) % 700_000 :][:24] if topic == 0 else raw[-24:]
        put(topic, receipt, bytes(raw))
    close()


def writer_of(kind: str, path: Path) -> tuple[Callable[[int, int, bytes], None], Callable[[], None]]:
    from rosbags import rosbag1, rosbag2

    store = store_of(kind)
    if kind == "mcap unchunked":
        return _unchunked(path, store)
    writer: Any
    if kind.startswith("bag"):
        writer = rosbag1.Writer(path)
        if kind == "bag lz4":
            writer.set_compression(rosbag1.Writer.CompressionFormat.LZ4)
    else:
        plugin = rosbag2.StoragePlugin.SQLITE3 if kind == "db3" else rosbag2.StoragePlugin.MCAP
        writer = rosbag2.Writer(path, version=8, storage_plugin=plugin)
        if kind == "mcap zstd":
            writer.set_compression(rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD)
    writer.open()
    ids = [writer.add_connection(topic, msgtype, typestore=store) for topic, msgtype, _ in TOPICS]
    return lambda topic, t, raw: writer.write(ids[topic], t, raw), writer.close


def _unchunked(path: Path, store: Any) -> tuple[Callable[[int, int, bytes], None], Callable[[], None]]:
    from mcap.writer import Writer

    writer = Writer(str(path), use_chunking=False)
    writer.start("ros2")
    ids = []
    for topic, msgtype, _ in TOPICS:
        text = store.generate_msgdef(msgtype, ros_version=2)[0].encode()
        ids.append(writer.register_channel(topic, "cdr", writer.register_schema(msgtype, "ros2msg", text)))
    return lambda topic, t, raw: writer.add_message(ids[topic], t, raw, t), writer.finish


def measure(how: str, path: Path) -> dict[str, float]:
    """Read the bag twice in this process."""
    from rosbags.highlevel import AnyReader

    from terrafusion.datasets.readers import open_recording

    def one_by_one() -> int:
        with AnyReader([path]) as reader:
            return sum(reader.deserialize(raw, c.msgtype) is not None for c, _, raw in reader.messages())

    def as_arrays() -> int:
        return sum(len(channel) for channel in open_recording(path).channels().values())

    read = one_by_one if how == "rosbags" else as_arrays
    out: dict[str, float] = {}
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for label in ("first", "again") if how == "ours" else ("first",):
        wall, cpu = time.perf_counter(), time.process_time()
        out["messages"] = read()
        out[f"{label} wall"], out[f"{label} cpu"] = time.perf_counter() - wall, time.process_time() - cpu
        if label == "first":
            out["bytes"] = (
                (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024 / out["messages"]
            )
    return out


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--messages", type=int, default=1_000_000)
    parser.add_argument("--folder", type=Path, help="where the bags are kept; a scratch folder by default")
    parser.add_argument("--measure", nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("--write", nargs=3, help=argparse.SUPPRESS)
    given = parser.parse_args()
    again = [sys.executable, __file__]
    if given.write:
        write(given.write[0], Path(given.write[1]), int(given.write[2]))
        return
    if given.measure:
        print(json.dumps(measure(given.measure[0], Path(given.measure[1]))))
        return
    with tempfile.TemporaryDirectory() as scratch:
        folder = given.folder or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        print(f"{'':16}{'rosbags':>18}{'first':>18}{'again':>18}{'memory':>12}")
        print(f"{'':16}" + f"{'wall s  (CPU s)':>18}" * 3 + f"{'B/message':>12}")
        for kind in KINDS:
            suffix = {"bag": ".bag", "bag lz4": ".bag", "mcap unchunked": ".mcap"}.get(kind, "")
            path = folder / f"{kind.replace(' ', '_')}_{given.messages}{suffix}"
            if not path.exists():
                subprocess.run([*again, "--write", kind, str(path), str(given.messages)], check=True)
            told = [f"{kind:16}"]
            for how, labels in (("rosbags", ("first",)), ("ours", ("first", "again"))):
                command = [*again, "--measure", how, str(path)]
                done = subprocess.run(command, capture_output=True, text=True, check=True)
                result = json.loads(done.stdout)
                told += [f"{result[f'{k} wall']:9.2f}  ({result[f'{k} cpu']:.2f})".rjust(18) for k in labels]
            print("".join(told) + f"{result['bytes']:12.0f}", flush=True)


if __name__ == "__main__":
    main()
