"""ROS 2 messages over DDS without ROS: its names of topics and types, and messages as CDR bytes.

A topic `/imu/data` of ROS 2 is the DDS topic `rt/imu/data`, and the type `sensor_msgs/msg/Imu` is
`sensor_msgs::msg::dds_::Imu_`. Needs the `cyclonedds` package (extra `live`).
"""

import functools
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.readers.ros.arriving import live_types
from terrafusion.datasets.readers.ros.topics import IMU

PREFIX = "rt/"
DEPTH = 2000
"""Messages that a reader holds: two seconds of a robot's sensors while the machine is busy."""
MOST_DOMAIN = 232
LOOPBACK = (
    "<CycloneDDS><Domain><General><AllowMulticast>false</AllowMulticast><Interfaces>"
    '<NetworkInterface address="127.0.0.1"/></Interfaces></General><Discovery>'
    "<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>60</MaxAutoParticipantIndex>"
    '<Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>'
)
"""Configuration of Cyclone DDS that leaves the machine by no network, as ROS_LOCALHOST_ONLY does."""
NUMBERS = {
    "bool": "bool", "byte": "byte", "char": "uint8", "octet": "byte",
    **{name: name for name in (
        "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64"
    )},
}  # fmt: skip

Receive = Callable[[str, str, bytes, int], None]
"""Takes topic, type, message (CDR) and time of receipt, ns."""


def dds_type(msgtype: str) -> str:
    """Name in DDS of a type such as "sensor_msgs/msg/Imu"."""
    package, kind, name = msgtype.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def ros_type(name: str) -> str | None:
    """The type that a name in DDS stands for; None where it is not a message of ROS."""
    parts = name.split("::")
    if len(parts) != 4 or parts[1:3] != ["msg", "dds_"]:
        return None
    return f"{parts[0]}/msg/{parts[3].removesuffix('_')}"


@functools.cache
def raw_type(msgtype: str) -> Any:
    """A type of DDS whose samples hold their message as CDR bytes: `sample.cdr`.

    Its fields, which others compare with theirs, are those of ROS 2 Humble.
    """
    from cyclonedds.idl import IdlStruct, make_idl_struct

    class Raw(IdlStruct):
        """Keeps bytes as they are."""

        cdr: bytes

        def serialize(self, *_: Any, **__: Any) -> bytes:
            return self.cdr

        @classmethod
        def deserialize(cls, data: bytes, *_: Any, **__: Any) -> Any:
            sample = cls.__new__(cls)
            sample.cdr = bytes(data)
            return sample

        deserialize_key = deserialize  # of a publisher that leaves

    Raw.__annotations__.clear()
    return make_idl_struct(
        msgtype.rsplit("/", 1)[1], dds_type(msgtype).replace("::", "."), _fields(msgtype),
        dataclassify=False, bases=(Raw,),
    )  # fmt: skip


@functools.cache
def _struct(msgtype: str) -> Any:
    from cyclonedds.idl import make_idl_struct

    name = msgtype.rsplit("/", 1)[1]
    return make_idl_struct(name, dds_type(msgtype).replace("::", "."), _fields(msgtype))


def _fields(msgtype: str) -> dict[str, Any]:
    return {name: _field(desc) for name, desc in live_types(msgtype)[msgtype]}


def _field(desc: tuple[Any, Any]) -> Any:
    from cyclonedds.idl import types

    kind, inner = desc
    if kind.name == "NAME":
        return _struct(inner)
    if kind.name == "BASE":
        return str if inner[0] == "string" else _number(inner[0])
    of, count = inner
    return types.array[_field(of), count] if kind.name == "ARRAY" else types.sequence[_field(of)]


def _number(name: str) -> Any:
    from cyclonedds.idl import types

    return bool if name == "bool" else getattr(types, NUMBERS[name])


@dataclass
class _Endpoint:
    topic: str
    msgtype: str
    entity: Any
    arrival: Any = None


class DdsBus:
    """Topics of ROS 2 on a domain of DDS.

    Args:
        domain: number of the domain, 0 to 232, as ROS_DOMAIN_ID.
        loopback: speak on 127.0.0.1 only.
        reliable: ask for lost messages again, of publishers that offer it; else as sensor data.

    Raises:
        ConfigError: cyclonedds is not installed, or the domain cannot be used.
    """

    def __init__(self, domain: int = 0, *, loopback: bool = False, reliable: bool = False) -> None:
        try:
            from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
            from cyclonedds.core import DDSException, WaitSet
            from cyclonedds.domain import Domain, DomainParticipant
        except ImportError:
            raise ConfigError(
                "DDS needs the package cyclonedds",
                remedy="pip install 'terrafusion[live]' (Python 3.11 to 3.13)",
            ) from None
        if not 0 <= domain <= MOST_DOMAIN:
            raise ConfigError(f"there is no DDS domain {domain}", remedy=f"give 0 to {MOST_DOMAIN}")
        try:
            self._domain = Domain(domain, LOOPBACK) if loopback else None
            self._participant = DomainParticipant(domain)
        except DDSException as error:
            raise ConfigError(
                f"DDS domain {domain} cannot be joined: {error.msg}",
                remedy="check CYCLONEDDS_URI and the network, or stay on this machine (--loopback)",
            ) from None
        self._reliable = reliable
        self._found = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
        self._readers: list[_Endpoint] = []
        self._writers: dict[str, _Endpoint] = {}
        self._arrivals = WaitSet(self._participant)

    def discovered(self) -> Iterator[tuple[str, str, bool]]:
        """Topic, type, and whether it is latched, of publishers that were found and are not received yet."""
        from cyclonedds.core import Policy

        for endpoint in self._found.take(N=DEPTH):
            name = getattr(endpoint, "topic_name", None) or ""  # none: a publisher that leaves
            msgtype = ros_type(getattr(endpoint, "type_name", None) or "")
            topic = name.removeprefix(PREFIX.rstrip("/"))
            if name.startswith(PREFIX) and msgtype and all(topic != end.topic for end in self._readers):
                yield topic, msgtype, endpoint.qos[Policy.Durability] == Policy.Durability.TransientLocal

    def subscribe(self, topic: str, msgtype: str, latched: bool = False) -> None:
        """Receive a topic; `latched` also what was published before (transient local)."""
        from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState
        from cyclonedds.sub import DataReader

        reader = DataReader(
            self._participant, self._topic(topic, msgtype), self._qos(latched, self._reliable or latched)
        )
        arrival = ReadCondition(reader, SampleState.NotRead | ViewState.Any | InstanceState.Any)
        self._arrivals.attach(arrival)
        self._readers.append(_Endpoint(topic, msgtype, reader, arrival))
        self._readers.sort(key=lambda end: end.msgtype != IMU)

    def poll(self, receive: Receive, wait_s: float = 0.0) -> int:
        """Give what arrives to `receive`, the IMU first, waiting up to `wait_s`; returns how many.

        What was sent before a sample of the IMU has arrived when that sample has: whoever waits for the IMU
        to be ahead misses nothing.
        """
        if wait_s and self._readers:
            self._arrivals.wait(round(wait_s * 1e9))
        count = 0
        for end in self._readers:
            for sample in end.entity.take(N=DEPTH):
                cdr = getattr(sample, "cdr", None)
                if cdr is not None:
                    receive(end.topic, end.msgtype, cdr, time.time_ns())
                    count += 1
        return count

    def publish(self, topic: str, msgtype: str, cdr: bytes) -> None:
        """Send a message; publishers are reliable, which serves both kinds of subscribers."""
        end = self._writers.get(topic) or self.advertise(topic, msgtype)
        sample = raw_type(msgtype).__new__(raw_type(msgtype))
        sample.cdr = cdr
        end.entity.write(sample)

    def advertise(self, topic: str, msgtype: str, latched: bool = False) -> _Endpoint:
        """Announce a topic before its first message."""
        from cyclonedds.pub import DataWriter

        writer = DataWriter(self._participant, self._topic(topic, msgtype), self._qos(latched, True))
        self._writers[topic] = _Endpoint(topic, msgtype, writer)
        return self._writers[topic]

    def close(self) -> None:
        """Leave the domain."""
        self._readers.clear()
        self._writers.clear()
        del self._arrivals, self._found, self._participant, self._domain

    def _topic(self, topic: str, msgtype: str) -> Any:
        from cyclonedds.topic import Topic

        return Topic(self._participant, PREFIX + topic.lstrip("/"), raw_type(msgtype))

    def _qos(self, latched: bool, reliable: bool) -> Any:
        from cyclonedds.core import Policy, Qos
        from cyclonedds.util import duration

        durability = Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile
        kind = Policy.Reliability.Reliable(duration(seconds=1))
        return Qos(
            kind if reliable else Policy.Reliability.BestEffort,
            durability,
            Policy.History.KeepLast(100 if latched else DEPTH),
            Policy.DataRepresentation(use_cdrv0_representation=True),
        )
