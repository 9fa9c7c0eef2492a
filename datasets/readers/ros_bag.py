"""What ROS 1 and ROS 2 bags share: choose topics, read them, build the recording."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from terrafusion.datasets.errors import DataError, TerrafusionError
from terrafusion.datasets.readers.log_folder import truth_contents
from terrafusion.datasets.readers.ros_channels import Builder
from terrafusion.datasets.readers.ros_messages import Stream, make_stream, times_of, wheel_joints
from terrafusion.datasets.readers.ros_topics import TYPES, Topic, choose_topics, joint_names
from terrafusion.datasets.recording import Overrides, Recording

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys.store import Typestore

    from terrafusion.datasets.readers.formats import Request


def read_bag(request: Request, *, typestore: Typestore | None, remedy: str) -> Recording:
    """Read a bag through rosbags' `AnyReader`.

    Args:
        request: the bag, the robot, topics and stamps.
        typestore: message definitions for bags that do not carry their own.
        remedy: what to do about a bag that does not open.

    Raises:
        DataError: a broken bag, no usable topic, or what the channels refuse.
    """
    from rosbags.highlevel import AnyReader

    path = request.path
    # Any exception of the parser means a broken bag: it reads bytes of unknown origin.
    try:
        reader = AnyReader([path], default_typestore=typestore)
        reader.open()
    except Exception as error:
        raise DataError(f"cannot be read as a ROS bag: {_reason(error)}", file=path, remedy=remedy) from None
    try:
        return _assemble(reader, request)
    except TerrafusionError:
        raise
    except _ParseError as error:
        raise DataError(
            f"the bag breaks off: {error}", file=path, channel=error.topic, remedy=remedy
        ) from None
    finally:
        reader.close()


class _ParseError(Exception):
    """A message that the parser could not read."""

    def __init__(self, topic: str | None, error: Exception) -> None:
        super().__init__(_reason(error))
        self.topic = topic


def _reason(error: Exception) -> str:
    return f"{type(error).__name__}: {error}" if not str(error) else str(error).rstrip(".")


def _assemble(reader: AnyReader, request: Request) -> Recording:
    path, rig, topics = request.path, request.rig, request.topics
    joints = joint_names(topics)
    bag = _topics_of(reader)
    chosen, notes = choose_topics(
        bag,
        file=path,
        user=topics,
        usual=rig.topics if rig else None,
        is_wheel_joints=lambda topic: _has_wheels(reader, topic, joints),
    )
    if "gnss" not in chosen:
        chosen.pop("gnss_velocity", None)
    if not set(chosen) - {"datum", "gnss_velocity"}:
        seen = ", ".join(f"{t.name} ({t.msgtype})" for t in bag) or "none"
        raise DataError(
            f"no topic of a type this library uses; topics here: {seen}",
            file=path,
            remedy="name one with --topic, such as --topic imu=/imu/data",
        )
    streams = _streams(reader, {topic.name for topic in chosen.values()})
    by_kind = {kind: streams[topic.name] for kind, topic in chosen.items()}
    times, clock = times_of([s for kind, s in by_kind.items() if kind != "datum"], request.stamps, path)
    start_ns = min(int(t[0]) for t in times.values())
    builder = Builder(path, rig, request.conventions, start_ns, joints, [*notes, *clock])
    return _build(builder, by_kind, times)


def _build(builder: Builder, streams: dict[str, Stream], times: Mapping[str, Any]) -> Recording:
    """One channel after the other; the order matters where one looks at another."""
    t = {kind: times[stream.topic] for kind, stream in streams.items() if kind != "datum"}
    imu = builder.imu(streams["imu"], t["imu"]) if "imu" in streams else None
    wheels, track = None, None
    if "wheels" in streams:
        wheels, track = builder.wheels(streams["wheels"], t["wheels"], imu)
    gnss, datum = None, None
    if "datum" in streams:
        datum = builder.datum(streams["datum"])
    if "gnss" in streams:
        gnss, datum = builder.gnss(streams["gnss"], t["gnss"], datum)
        if gnss is not None and "gnss_velocity" in streams:
            gnss = builder.gnss_velocity(gnss, streams["gnss_velocity"], t["gnss_velocity"])
    truth, frame = None, "base"
    if "truth" in streams:
        truth, frame = builder.truth(streams["truth"], t["truth"])
    topics = ", ".join(f"{kind} {stream.topic}" for kind, stream in streams.items())
    return Recording(
        name=builder.file.stem,
        start_ns=builder.start_ns,
        command=builder.command(streams["command"], t["command"]) if "command" in streams else None,
        wheels=wheels,
        imu=imu,
        gnss=gnss,
        terrain=builder.terrain(streams["terrain"], t["terrain"]) if "terrain" in streams else None,
        truth=truth,
        datum=datum,
        truth_channels=truth_contents(truth) if truth is not None else (),
        truth_frame=frame,
        overrides=Overrides(track_m=track),
        source=f"topics: {topics}",
        notes=tuple(builder.notes),
    )


def _topics_of(reader: AnyReader) -> list[Topic]:
    counts: dict[tuple[str, str], int] = {}
    for connection in reader.connections:
        key = (connection.topic, connection.msgtype)
        counts[key] = counts.get(key, 0) + connection.msgcount
    return [Topic(name, msgtype, count) for (name, msgtype), count in sorted(counts.items()) if count]


def _has_wheels(reader: AnyReader, topic: str, joints: dict[str, str]) -> bool:
    """Whether the first messages of a JointState topic name wheels."""
    connections = [c for c in reader.connections if c.topic == topic]
    names: list[str] = []
    for seen, (connection, _, raw) in enumerate(_raw_messages(reader, connections)):
        names += list(_decode(reader, connection, raw).name)
        if seen >= 20:
            break
    return bool(wheel_joints(names, joints))


def _streams(reader: AnyReader, topics: set[str]) -> dict[str, Stream]:
    known = {msgtype for types in TYPES.values() for msgtype in types}
    connections = [c for c in reader.connections if c.topic in topics and c.msgtype in known]
    receipts: dict[str, list[int]] = {topic: [] for topic in topics}
    messages: dict[str, list[Any]] = {topic: [] for topic in topics}
    for connection, receipt_ns, raw in _raw_messages(reader, connections):
        receipts[connection.topic].append(receipt_ns)
        messages[connection.topic].append(_decode(reader, connection, raw))
    types = {c.topic: c.msgtype for c in connections}
    return {t: make_stream(t, types[t], receipts[t], messages[t]) for t in sorted(topics)}


def _raw_messages(reader: AnyReader, connections: list[Any]) -> Any:
    iterator = reader.messages(connections=connections)
    while True:
        try:
            item = next(iterator)
        except StopIteration:
            return
        except Exception as error:
            raise _ParseError(None, error) from None
        yield item


def _decode(reader: AnyReader, connection: Any, raw: bytes) -> Any:
    try:
        return reader.deserialize(raw, connection.msgtype)
    except Exception as error:
        raise _ParseError(connection.topic, error) from None
