"""What ROS 1 and ROS 2 bags share: choose topics, read them, build the recording."""

import functools
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from terrafusion.datasets.core.errors import DataError, errors_of
from terrafusion.datasets.core.recording import Overrides, Recording
from terrafusion.datasets.core.sensors import Rig
from terrafusion.datasets.readers.formats import Request
from terrafusion.datasets.readers.log_folder import truth_contents
from terrafusion.datasets.readers.ros.channels import ChannelBuilder
from terrafusion.datasets.readers.ros.exact import META, restore
from terrafusion.datasets.readers.ros.joints import (
    joined,
    joint_names,
    steering_joints,
    wheel_joints,
    wheels_apart,
)
from terrafusion.datasets.readers.ros.mapped import MappedChannels, numbers_in
from terrafusion.datasets.readers.ros.raw import BagContainer, BagError
from terrafusion.datasets.readers.ros.static_frames import (
    STATIC,
    Mounting,
    StaticFrames,
    antenna_is_known,
    mounting_note,
    with_mountings,
)
from terrafusion.datasets.readers.ros.streams import (
    Key,
    Stream,
    broken_bag_on_error,
    has_fix,
    read_streams,
    twists,
    wanted_fields,
)
from terrafusion.datasets.readers.ros.times import StreamTimes, timing_of
from terrafusion.datasets.readers.ros.topics import (
    IMU,
    JOINTS,
    ODOMETRY,
    TYPES,
    BagTopic,
    choose_topics,
    joints_given,
    unread_receivers,
    wheel_advice,
)

LOOK_AT_MESSAGES = 20
"""Enough messages of a JointState to learn its joints."""
MOST_TEXT = 300
"""Of what a parser says: it may quote the whole definition of a message."""


@contextmanager
def opened_bag(
    path: Path, open_container: Callable[[Path], BagContainer], remedy: str
) -> Iterator[BagContainer]:
    """A bag of either ROS, opened by `open_container`; `remedy` is for one that does not open, or breaks off.

    Raises:
        DataError: a broken bag, also where that shows only while it is read.
    """
    with errors_of(path):
        try:
            with broken_bag_on_error():
                container = open_container(path)
            with closing(container):
                if container.cut and not any(source.count for source in container.sources):
                    raise BagError(f"{container.cut}, and no message is there")
                yield container
        except BagError as error:
            what = f"cannot be read as a ROS bag: {str(error)[:MOST_TEXT]}"
            raise DataError(what, channel=error.topic, remedy=remedy) from None


def chosen_topics(
    container: BagContainer,
    request: Request,
    decide: Callable[[str, list[BagTopic]], BagTopic] | None = None,
    mapped: Sequence[str] = (),
) -> tuple[dict[str, BagTopic], list[str]]:
    """The topic of each channel, and notes; raises as `choose_topics` does.

    `decide` is asked about several sensors of one kind with data; without it they are an error. Channels that
    a column map describes, `mapped`, get none.
    """
    rig, joints = request.rig, joints_given(request.topics)

    def one_of(kind: str, found: list[BagTopic]) -> BagTopic:
        return found[0] if kind in mapped else _one_sensor(container, rig, decide, kind, found)

    with errors_of(request.path):
        chosen, notes = choose_topics(
            topics_of(container),
            user=request.topics,
            usual=rig.topics if rig else None,
            is_wheel_joints=lambda topic: bool(wheel_joints(_joints(container, topic), joints)),
            one_of=one_of,
            is_steering_joints=lambda topic: bool(steering_joints(_joints(container, topic))),
        )
        notes = [note for note in notes if note.partition(":")[0] not in mapped]
        chosen = {kind: topic for kind, topic in chosen.items() if kind not in mapped}
        if "wheels" not in (*chosen, *mapped):
            found = wheels_apart(topics_of(container), functools.partial(_joints, container), joints)
            if found is not None:
                chosen["wheels"] = found
                notes.append(f"wheels: those of {', '.join(found.names)} together")
        return chosen, notes


def recording_of(container: BagContainer, request: Request) -> Recording:
    """The recording that an open bag holds.

    Raises:
        DataError, BagError: no usable topic, or what the channels refuse.
    """
    with errors_of(request.path):
        recording = _recording(container, request)
    if not container.cut:
        return recording
    end = f"its data end at t = {recording.duration_s():.3f} s"
    return recording.with_notes(f"{request.path.name} is cut off ({container.cut}): {end}")


def _recording(container: BagContainer, request: Request) -> Recording:
    path, rig = request.path, request.rig
    there = {(source.topic, source.msgtype) for source in container.sources if source.count}
    mapped = MappedChannels(request)
    if META in there and not (request.topics or mapped.kinds) and request.stamps == "header":
        return restore(functools.partial(read_streams, container), there, path)
    chosen, notes = chosen_topics(container, request, mapped=mapped.kinds)
    streams = _streams(container, chosen) | mapped.streams(container, topics_of(container))
    if META in there:
        notes.append(f"{META[0].rpartition('/')[0]} is not used: topics or stamps were asked for")
    notes += [
        f"{kind}: {topic.name} is empty after all" for kind, topic in chosen.items() if kind not in streams
    ]
    if "gnss" not in streams:
        streams.pop("gnss_velocity", None)
    if not set(streams) - {"datum", "gnss_velocity"}:
        seen = ", ".join(f"{t.name} ({t.msgtype})" for t in topics_of(container)) or "none"
        others = {source.encoding[:20] for source in container.sources} - {"cdr", "ros1"}
        what = f"no topic of a type this library uses; topics here: {seen}"
        if others:
            remedy = f"messages in {', '.join(sorted(others))} are not read: export them as tables (.csv)"
            raise DataError(what, remedy=remedy)
        raise DataError(what, remedy="name one with --topic, such as --topic imu=/imu/data")
    if "wheels" not in streams:
        taken = [topic.name for kind, topic in chosen.items() if kind not in ("command", "steering")]
        looks = functools.partial(_joints, container), functools.partial(numbers_in, container)
        notes.append(wheel_advice(topics_of(container), taken, *looks))
    if "gnss" not in streams:
        notes += unread_receivers(topics_of(container))
    datum = streams.pop("datum", None)
    timing = timing_of(streams, stamps=request.stamps, repair_clock=request.repair_clock)
    start_ns = min(int(t[0]) for t in timing.times.values())
    joints = joints_given(request.topics)
    notes += timing.notes
    frames = StaticFrames() if request.sha256 else _static_frames(container, notes)
    builder = ChannelBuilder(path, rig, request.conventions, start_ns, joints, notes, frames=frames)
    return mapped.applied(_build(builder, mapped, timing, datum))


def _build(
    builder: ChannelBuilder, mapped: MappedChannels, timing: StreamTimes, datum_stream: Stream | None
) -> Recording:
    """One channel after the other; the order matters where one looks at another."""
    streams = timing.streams

    def built(kind: str, *beside: Any) -> Any:
        """What the builder, or the column map, makes of the messages of a kind; None without any."""
        if kind in streams and kind in mapped.kinds:
            return mapped.channel(kind, streams[kind], timing.times[kind], builder.start_ns)
        return getattr(builder, kind)(streams[kind], timing.times[kind], *beside) if kind in streams else None

    imu = built("imu")
    wheels, track = built("wheels", imu) or (None, None)
    datum = builder.datum(datum_stream) if datum_stream is not None else None
    gnss, datum = built("gnss", datum) or (None, datum)
    if gnss is not None and "gnss_velocity" in streams:
        gnss = builder.gnss_velocity(gnss, streams["gnss_velocity"], timing.times["gnss_velocity"])
    others = {kind: built(kind) for kind in ("barometer", "magnetometer")}
    mounted = _mounted(builder, streams)
    imu_frame = _usual_frame(streams["imu"]) if imu is not None else ""
    truth, frame = built("truth") or (None, "base")
    others |= {kind: built(kind) for kind in ("command", "terrain", "steering", "motor")}
    return Recording(
        name=builder.file.stem,
        start_ns=builder.start_ns,
        wheels=wheels,
        imu=imu,
        gnss=gnss,
        **others,
        truth=truth,
        datum=datum,
        truth_channels=truth_contents(truth),
        truth_frame=frame,
        overrides=with_mountings(Overrides(track_m=track), mounted, builder.rig),
        source="topics: " + ", ".join(f"{kind} {stream.topic}" for kind, stream in streams.items()),
        notes=tuple(builder.notes),
        clock_jumps=timing.jumps,
        imu_frame_id=imu_frame,
        unturned=tuple(name for name, frame in builder.unturned.items() if frame == imu_frame),
    )


def _static_frames(container: BagContainer, notes: list[str]) -> StaticFrames:
    """Where the sensors of a robot are, as far as the bag tells; the catalogue knows its own bags."""
    frames, (plain, msgtype) = StaticFrames(), STATIC
    there = {s.topic for s in container.sources if s.count and s.msgtype == msgtype}
    named = sorted(topic for topic in there if topic.endswith(plain))  # of a namespace: /robot/tf_static
    chosen = [plain] if plain in there else named
    if len(chosen) > 1:
        notes.append(f"{', '.join(chosen)} are not used: several robots may name their frames alike")
    elif chosen:
        try:
            frames.add(read_streams(container, {(chosen[0], msgtype): ()})[chosen[0], msgtype])
        except BagError as error:
            notes.append(f"{chosen[0]} is not used: {str(error)[:MOST_TEXT]}")
    return frames


def _mounted(builder: ChannelBuilder, streams: Mapping[str, Stream]) -> dict[str, Mounting]:
    """The mounting of IMU and antenna, where the bag's fixed transforms lead from the body to them."""
    mounted = {}
    for kind in ("imu", "gnss"):
        frame = _usual_frame(streams[kind]) if kind in streams else ""
        found = builder.mounting(frame)
        if found is not None:
            mounted[kind] = found
            if kind == "gnss" and not antenna_is_known(builder.rig):
                builder.notes.append(mounting_note(kind, frame, found))
    return mounted


def _usual_frame(stream: Stream) -> str:
    """The frame of most messages."""
    names = Counter(stream.frame_ids.tolist())
    return str(names.most_common(1)[0][0]) if names else ""


def topics_of(container: BagContainer) -> list[BagTopic]:
    """The topics with messages, by name."""
    counts: Counter[tuple[str, str]] = Counter()
    for source in container.sources:
        counts[source.topic, source.msgtype] += source.count
    return [BagTopic(name, msgtype, count) for (name, msgtype), count in sorted(counts.items()) if count]


def _joints(container: BagContainer, topic: str) -> list[str]:
    """Joints that the first messages of a JointState topic name."""
    key = topic, JOINTS
    stream = read_streams(container, {key: wanted_fields("wheels", JOINTS)}, LOOK_AT_MESSAGES)[key]
    return joint_names(stream)


def _one_sensor(
    container: BagContainer,
    rig: Rig | None,
    decide: Callable[[str, list[BagTopic]], BagTopic] | None,
    kind: str,
    candidates: list[BagTopic],
) -> BagTopic:
    """The topic of a sensor among several of one type: the one with data, else that in the robot's frame.

    A DataError where both are there names them and the option to choose.
    """
    keys = {topic.name: (topic.name, topic.msgtype) for topic in candidates}
    streams = read_streams(container, {key: wanted_fields(kind, key[1]) for key in keys.values()})
    found = [topic for topic in candidates if _holds_data(streams[keys[topic.name]])]
    if len(found) > 1 and kind == "imu" and rig is not None:
        frame = rig.sensors.imu.frame_id.lstrip("/")
        mounted = [topic for topic in found if _usual_frame(streams[keys[topic.name]]).lstrip("/") == frame]
        found = mounted if len(mounted) == 1 else found
    if len(found) == 1:
        return found[0]
    if decide is not None and found:
        return decide(kind, found)
    listed = ", ".join(f"{topic.name} ({_rate(streams[keys[topic.name]])})" for topic in candidates)
    options = " or ".join(f"--topic {kind}={topic.name}" for topic in candidates)
    raise DataError(
        f"{len(candidates)} sensors of one kind: {listed}",
        channel=kind,
        remedy=f"choose with {options} (or topics={{'{kind}': ...}} in Python)",
    )


def _holds_data(stream: Stream) -> bool:
    """Whether a sensor's messages hold anything: a fix, or a number that is not zero."""
    if stream.msgtype in TYPES["gnss"]:
        return bool(has_fix(stream.column("status.status")).any())
    if stream.msgtype == IMU:
        values = np.hstack([stream.vectors("angular_velocity"), stream.vectors("linear_acceleration")])
    elif stream.msgtype == ODOMETRY:
        values = twists(stream)[0]
    else:
        return True
    return bool(np.nan_to_num(values).any())


def _rate(stream: Stream) -> str:
    times = stream.receipt_ns if stream.header_ns is None else stream.header_ns
    span_s = float(times.max() - times.min()) * 1e-9
    count = f"{len(stream)} messages"
    return f"{count}, {(len(stream) - 1) / span_s:.3g} Hz" if span_s > 0.0 else count


def _streams(container: BagContainer, chosen: Mapping[str, BagTopic]) -> dict[str, Stream]:
    """The streams of the chosen topics that do hold messages, by channel."""
    asked: dict[Key, tuple[str, ...]] = {}
    for kind, topic in chosen.items():
        for name in topic.names:
            key, fields = (name, topic.msgtype), wanted_fields(kind, topic.msgtype)
            asked[key] = (*asked.get(key, ()), *fields)
    streams = read_streams(container, asked)
    found = {}
    for kind, topic in chosen.items():
        parts = [streams[name, topic.msgtype] for name in topic.names]
        found[kind] = joined(parts) if topic.beside else parts[0]
    return {kind: stream for kind, stream in found.items() if len(stream)}
