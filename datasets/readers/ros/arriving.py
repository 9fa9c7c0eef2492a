"""Messages of ROS 2 one by one, as a robot sends them: gathered like a bag, then turned into samples.

Both ways go through the decoder and the `ChannelBuilder` of bags: a message gives the same numbers live as
from a bag.
"""

from collections import Counter, deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.channels import Gnss
from terrafusion.datasets.core.errors import errors_of
from terrafusion.datasets.core.frames import turned_by
from terrafusion.datasets.core.messages import Message, WheelSample
from terrafusion.datasets.core.wrapped_angles import TurnCounter
from terrafusion.datasets.readers.formats import Request
from terrafusion.datasets.readers.ros import topics
from terrafusion.datasets.readers.ros.arriving_joints import ArrivingJoints
from terrafusion.datasets.readers.ros.channels import ChannelBuilder
from terrafusion.datasets.readers.ros.joints import joined, joint_names, steering_joints
from terrafusion.datasets.readers.ros.layout import Fields, MessageDecoder
from terrafusion.datasets.readers.ros.raw import BagSource, Groups, MessageBatch, batches_of
from terrafusion.datasets.readers.ros.streams import Stream, broken_bag_on_error, types_of, wanted_fields
from terrafusion.datasets.readers.ros.topics import joints_given
from terrafusion.datasets.readers.text.fixes import Datum

LIVE = Path("live")
"""Stands in errors where a bag has its path."""
KINDS = ("imu", "wheels", "gnss", "gnss_velocity", "command", "barometer", "steering", "datum")
"""Channels that an estimator takes live."""
VELOCITY_APART_NS = 50_000_000
"""A velocity belongs to a fix of the same time, within this."""
MOST_GATHERED = 50_000


def live_types(msgtype: str) -> Mapping[str, Fields]:
    """Fields of a type and of those it is made of, as ROS 2 Humble has them."""
    return types_of(BagSource(0, "", msgtype, "", "msg", "cdr", 0))


@dataclass(frozen=True)
class RawMessage:
    """A message as it came: topic, type, CDR, and when it was received."""

    topic: str
    msgtype: str
    cdr: bytes
    receipt_ns: int

    def stream(self, fields: tuple[str, ...]) -> Stream:
        """The fields of this message as a stream of one; a BagError where it does not fit its definition."""
        with broken_bag_on_error(self.topic):
            decoder = MessageDecoder(self.msgtype, live_types(self.msgtype), fields, True, self.topic)
            return _decoded(decoder, self)


def _decoded(decoder: MessageDecoder, message: RawMessage) -> Stream:
    """A message, by a decoder that may know its layout already."""
    for batch in batches_of([(0, message.receipt_ns, message.cdr)], [[0]]):
        decoder.add(batch)
    receipt_ns, blocks = decoder.result()
    return Stream(message.topic, message.msgtype, receipt_ns, blocks)


class GatheredMessages:
    """The newest messages of some topics, as an open bag."""

    cut = ""

    def __init__(self) -> None:
        self.messages: deque[RawMessage] = deque(maxlen=MOST_GATHERED)

    @property
    def sources(self) -> list[BagSource]:
        """The topics that have messages."""
        counts = Counter((message.topic, message.msgtype) for message in self.messages)
        return [
            BagSource(i, topic, msgtype, "", "msg", "cdr", count)
            for i, ((topic, msgtype), count) in enumerate(counts.items())
        ]

    def batches(self, wanted: Groups) -> Iterator[MessageBatch]:
        """The messages of the wanted groups of sources."""
        ids = {(source.topic, source.msgtype): source.id for source in self.sources}
        messages = [(ids[m.topic, m.msgtype], m.receipt_ns, m.cdr) for m in self.messages]
        return batches_of(messages, wanted) if messages else iter(())

    def forget(self, before_ns: int) -> None:
        """Drop what was received earlier, but the only message of a topic: it may have been sent once."""
        counts = Counter(message.topic for message in self.messages)
        held = [m for m in self.messages if m.receipt_ns >= before_ns or counts[m.topic] == 1]
        self.messages = deque(held, maxlen=MOST_GATHERED)

    def close(self) -> None:
        """Nothing is open."""


@dataclass
class ArrivingMessages:
    """Turns messages of chosen topics into samples, one at a time.

    Attributes:
        request: vehicle, topics and stamps, as for a bag.
        chosen: type and topic by channel.
        datum: origin of ENU, deg and m; the first fix where it is None.
        imu_turn: (3, 3) from the IMU's frame to the body, where the robot publishes it.
    """

    request: Request
    chosen: dict[str, topics.BagTopic]
    datum: Datum | None = None
    imu_turn: NDArray[np.float64] | None = None
    notes: list[str] = field(default_factory=list)
    _decoders: dict[str, MessageDecoder] = field(default_factory=dict)
    _velocities: deque[tuple[int, Stream]] = field(default_factory=lambda: deque(maxlen=50))
    _turns: TurnCounter = field(default_factory=TurnCounter)
    _header_ns: int = 0

    def __post_init__(self) -> None:
        self._joints = ArrivingJoints(joints_given(self.request.topics))

    def samples(self, message: RawMessage) -> list[tuple[int, str, Any]]:
        """Time, channel and sample of what the message gives; a fix waits for `with_velocity`.

        Raises:
            DataError, BagError: the message is of no use.
        """
        found: list[tuple[int, str, Any]] = []
        for kind, topic in self.chosen.items():
            if message.topic in topic.names and topic.msgtype == message.msgtype:
                stream = self._stream(kind, message)
                with errors_of(LIVE), broken_bag_on_error(message.topic):
                    for sample in self._samples(kind, stream, self._time_of(stream)):
                        t_ns = sample.t_ns[0] if isinstance(sample, Gnss) else sample.t_ns
                        found.append((int(t_ns), kind, sample))
        return found

    def join(self, topic: str, msgtype: str) -> str | None:
        """Choose a topic that appears later for a channel that has none yet; returns the channel."""
        chosen = dict(self.chosen)
        asked = {kind: one.name for kind, one in chosen.items()}
        new = topics.BagTopic(topic, msgtype, 1)
        found, _ = topics.choose_topics([*chosen.values(), new], user=asked)
        for kind, one in found.items():
            if kind in ("gnss", "gnss_velocity", "command", "barometer") and kind not in chosen:
                self.chosen[kind] = one
                return kind
        return None

    def with_velocity(self, gnss: Gnss) -> Message:
        """The fix as a sample, with the velocity of its time where a topic of velocities has one."""
        near = min(self._velocities, key=lambda one: abs(one[0] - int(gnss.t_ns[0])), default=None)
        if near is not None and abs(near[0] - int(gnss.t_ns[0])) <= VELOCITY_APART_NS:
            gnss = self._builder().gnss_velocity(gnss, near[1], np.array([near[0]]))
        return next(iter(gnss.samples()))

    def _samples(self, kind: str, stream: Stream, t_ns: NDArray[np.int64]) -> Iterator[Any]:
        builder = self._builder()
        if kind == "gnss":
            gnss, datum = builder.gnss(stream, t_ns, self.datum)
            if gnss is not None and not self._is_nowhere(stream):
                self.datum = datum
                yield gnss
        elif kind == "gnss_velocity":
            self._velocities.append((int(t_ns[0]), stream))
        elif kind == "datum":
            self.datum = self.datum or builder.datum(stream)
        elif kind == "wheels":
            yield from self._wheels(stream, t_ns)
        elif stream.msgtype == topics.JOINTS and not steering_joints(joint_names(stream)):
            return  # of other joints
        else:
            channel = getattr(builder, kind)(stream, t_ns)
            for sample in () if channel is None else channel.samples():
                if kind == "imu" and self.imu_turn is not None:
                    both = np.stack([sample.gyro_radps, sample.accel_mps2])
                    sample = type(sample)(sample.t_ns, *turned_by(self.imu_turn, both))
                yield sample

    def _wheels(self, stream: Stream, t_ns: NDArray[np.int64]) -> Iterator[Message]:
        """Wheel speeds, of joints with whole turns; see `ArrivingJoints`."""
        if stream.msgtype == topics.JOINTS:
            if self.chosen["wheels"].beside:
                stream = joined([stream])
            if not self._joints.are_whole(stream):
                yield from self._joints.samples(stream, int(t_ns[0]))
                return
        wheels, _ = self._builder().wheels(stream, t_ns, None)
        for sample in [] if wheels is None else list(wheels.samples())[-1:]:
            assert isinstance(sample, WheelSample)
            angle = sample.angle_rad
            yield (
                sample
                if angle is None
                else sample._replace(angle_rad=self._turns.counted(angle, sample.t_ns))
            )

    def _is_nowhere(self, stream: Stream) -> bool:
        """Latitude and longitude 0, which receivers report that know none, unless the datum is there."""
        at_zero = not stream.column("latitude")[0] and not stream.column("longitude")[0]
        return at_zero and (self.datum is None or max(map(abs, self.datum[:2])) > 0.1)

    def _stream(self, kind: str, message: RawMessage) -> Stream:
        """A message, by a decoder that knows its layout already."""
        topic, msgtype = message.topic, message.msgtype
        decoder = self._decoders.pop(kind, None)
        with broken_bag_on_error(topic):
            if decoder is None:
                fields = wanted_fields(kind, msgtype)
                decoder = MessageDecoder(msgtype, live_types(msgtype), fields, True, topic)
            stream = _decoded(decoder, message)
        self._decoders[kind] = decoder
        return stream

    def _time_of(self, stream: Stream) -> NDArray[np.int64]:
        """Time (1,) of a message: its stamp; without one that of receipt, on the clock of the stamps."""
        header_ns = stream.header_ns
        if self.request.stamps == "header" and header_ns is not None and header_ns[0]:
            self._header_ns = max(self._header_ns, int(header_ns[0]))
            return header_ns
        receipt_ns = stream.receipt_ns
        apart_ns = abs(int(receipt_ns[0]) - self._header_ns)
        if self._header_ns and self.request.stamps == "header" and apart_ns > 1_000_000_000:
            return np.array([self._header_ns])
        return receipt_ns

    def _builder(self) -> ChannelBuilder:
        self.notes.clear()
        joints = joints_given(self.request.topics)
        return ChannelBuilder(LIVE, self.request.rig, self.request.conventions, 0, joints, self.notes)
