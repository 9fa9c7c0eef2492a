"""Topics of a bag as streams, the same for ROS 1 and ROS 2: messages as arrays, decoded in one pass."""

import dataclasses
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array, TimesNs
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.readers.ros import topics
from terrafusion.datasets.readers.ros.layout import Fields, MessageBlock, MessageDecoder
from terrafusion.datasets.readers.ros.raw import BagContainer, BagError, BagSource

UNKNOWN_VARIANCE = 1e6
"""By ROS custom, a variance this large marks an unknown quantity."""
SIGMAS_IN_95 = 1.96
"""Errors that a GPSFix gives are those of 95 %."""
UNSET_STATUS = -2
"""Of a NavSatFix whose driver does not set it, since ROS 2 Iron; -1 is no fix."""

TWIST_AT = {
    topics.TWIST: ("", ""),
    topics.TWIST_STAMPED: ("twist.", ""),
    topics.TWIST_COVARIANCE: ("twist.twist.", "twist.covariance."),
    topics.ODOMETRY: ("twist.twist.", "twist.covariance."),
}
"""What stands before a twist's fields, and before the entries of its covariance where it has one."""
POSE_AT = {
    topics.POSE: ("pose.", ""),
    topics.POSE_COVARIANCE: ("pose.pose.", "pose.covariance"),
    topics.ODOMETRY: ("pose.pose.", "pose.covariance"),
}
ACKERMANN_AT = {topics.ACKERMANN: "", topics.ACKERMANN_STAMPED: "drive."}
"""What stands before the fields of an AckermannDrive."""
DEFINITIONS = {
    topics.ACKERMANN: "float32 steering_angle\nfloat32 steering_angle_velocity\nfloat32 speed\n"
    "float32 acceleration\nfloat32 jerk\n"
}
DEFINITIONS[topics.ACKERMANN_STAMPED] = (
    "std_msgs/Header header\nackermann_msgs/AckermannDrive drive\n"
    f"{'=' * 80}\nMSG: ackermann_msgs/AckermannDrive\n{DEFINITIONS[topics.ACKERMANN]}"
)
DEFINITIONS[topics.GPS_FIX] = f"""std_msgs/Header header
gps_msgs/GPSStatus status
float64 latitude
float64 longitude
float64 altitude
float64 track
float64 speed
float64 climb
float64[3] pitch_roll_dip
float64 time
float64[5] dilutions
float64[3] err_horz_vert
float64 err_track
float64 err_speed
float64[5] err_climb_time_pitch_roll_dip
float64[9] position_covariance
uint8 position_covariance_type
{"=" * 80}
MSG: gps_msgs/GPSStatus
std_msgs/Header header
uint16 satellites_used
int32[] satellite_used_prn
uint16 satellites_visible
int32[] satellite_visible_prn
int32[] satellite_visible_z
int32[] satellite_visible_azimuth
int32[] satellite_visible_snr
int16 status
uint16 motion_source
uint16 orientation_source
uint16 position_source
"""
"""Types that are not part of ROS 2 itself; numbers that are not read stand in arrays, of the same bytes."""
DIAGONAL = range(0, 36, 7)
_RATE, _FORCE, _SIGMA = "angular_velocity", "linear_acceleration", "position_covariance"
FIELDS = {
    topics.IMU: (_RATE, f"{_RATE}_covariance.0", _FORCE, f"{_FORCE}_covariance.0"),
    topics.FIX: (
        "status.status", "latitude", "longitude", "altitude",
        f"{_SIGMA}_type", f"{_SIGMA}.0", f"{_SIGMA}.4", f"{_SIGMA}.8",
    ),
    topics.PRESSURE: ("fluid_pressure",),
    topics.FIELD: ("magnetic_field",),
    topics.JOINTS: ("name", "position", "velocity"),
}  # fmt: skip
FIELDS[topics.GPS_FIX] = (*FIELDS[topics.FIX], "track", "speed", "climb", "err_speed")
FIELDS[topics.GPS_FIX_1] = FIELDS[topics.GPS_FIX]
"""Paths of the fields that are read of other types."""


def wanted_fields(kind: str, msgtype: str) -> tuple[str, ...]:
    """Paths of the fields that a channel takes from messages of a type; () for all of them."""
    fields = [*FIELDS.get(msgtype, ())]
    if msgtype in ACKERMANN_AT:
        fields += [f"{ACKERMANN_AT[msgtype]}{name}" for name in ("steering_angle", "speed")]
    if msgtype in TWIST_AT:
        twist, variance = TWIST_AT[msgtype]
        fields += [f"{twist}linear", f"{twist}angular"]
        fields += [f"{variance}{i}" for i in DIAGONAL if variance]
    if msgtype in POSE_AT:
        pose, covariance = POSE_AT[msgtype]
        fields += [f"{pose}position", f"{pose}orientation", "child_frame_id"]
        fields += [covariance] if kind == "truth" and covariance else []
    return ("header.stamp", "header.frame_id", *fields) if fields else ()


@dataclass(frozen=True, eq=False)
class Stream:
    """The messages of one topic.

    Attributes:
        receipt_ns: (N,) when the recorder got them.
        blocks: the messages as columns; one block unless their lists differ in length.
    """

    topic: str
    msgtype: str
    receipt_ns: TimesNs
    blocks: tuple[MessageBlock, ...]

    def __len__(self) -> int:
        return len(self.receipt_ns)

    def has(self, path: str) -> bool:
        """Whether all messages have this field, in one shape."""
        shapes = {b.columns[path].shape[1:] if path in b.columns else None for b in self.blocks}
        return len(shapes) == 1 and None not in shapes

    def column(self, path: str) -> NDArray[Any]:
        """Values (N, ...) of a field; a BagError where the messages' definition has none."""
        if not self.has(path):
            raise BagError(f"its messages have no '{path}', as {self.msgtype} should", self.topic)
        first = self.blocks[0].columns[path]
        if self._in_one_block:
            return first
        out = np.empty((len(self), *first.shape[1:]), dtype=first.dtype)
        for block in self.blocks:
            out[block.rows] = block.columns[path]
        return out

    @cached_property
    def _in_one_block(self) -> bool:
        return len(self.blocks) == 1 and bool((np.diff(self.blocks[0].rows) == 1).all())

    def vectors(self, path: str, axes: str = "xyz") -> Array:
        """(N, k) of a field's x, y, z (and w)."""
        return np.stack([self.column(f"{path}.{axis}").astype(float) for axis in axes], axis=1)

    @cached_property
    def header_ns(self) -> TimesNs | None:
        """(N,) header stamps, None for types without a header."""
        if not self.has("header.stamp.sec"):
            return None
        seconds = self.column("header.stamp.sec").astype(np.int64)
        return np.asarray(seconds * 1_000_000_000 + self.column("header.stamp.nanosec").astype(np.int64))

    @cached_property
    def frame_ids(self) -> NDArray[Any]:
        """(N,) names of the header's frame without a leading slash; empty without a header."""
        if not self.has("header.frame_id"):
            return np.empty(0, dtype=object)
        names = self.column("header.frame_id")
        for name in set(names.tolist()):
            if name.startswith("/"):
                names = np.where(names == name, name.lstrip("/"), names)
        return names

    def select(self, rows: NDArray[Any]) -> "Stream":
        """The messages of a boolean mask, or in the order of an index array."""
        index = np.flatnonzero(rows) if rows.dtype == bool else rows
        new = np.full(len(self), -1, dtype=np.int64)
        new[index] = np.arange(len(index))
        blocks = []
        for block in self.blocks:
            order = np.argsort(new[block.rows], kind="stable")
            order = order[new[block.rows][order] >= 0]
            if order.size:
                columns = {path: column[order] for path, column in block.columns.items()}
                blocks.append(MessageBlock(new[block.rows[order]], columns))
        return Stream(self.topic, self.msgtype, self.receipt_ns[index], tuple(blocks))


def has_fix(status: NDArray[Any]) -> NDArray[np.bool_]:
    """Mask (N,) of the statuses of NavSatFix that do not say that there is none."""
    return np.asarray((status >= 0) | (status == UNSET_STATUS))


def fix_sigmas(stream: Stream) -> Array:
    """Sigmas (N, 3) m of fixes, NaN where the receiver gives no covariance."""
    variance = np.stack([stream.column(f"{_SIGMA}.{i}").astype(float) for i in (0, 4, 8)], axis=1)
    variance[stream.column(f"{_SIGMA}_type") == 0] = np.nan
    variance[variance >= UNKNOWN_VARIANCE] = np.nan
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(variance))


def fix_velocities(stream: Stream) -> tuple[Array | None, Array | None]:
    """ENU velocities (N, 3) m/s of a receiver's twists or GPSFix, and their sigmas (N,).

    NaN where the driver of a GPSFix leaves the speed at zero; None where all are, and of other fixes.
    """
    if stream.msgtype in TWIST_AT:
        twist, variance = twists(stream)
        twist[:, 2][variance[:, 2] >= UNKNOWN_VARIANCE] = np.nan
        with np.errstate(invalid="ignore"):
            return twist[:, :3], np.sqrt(np.where(variance[:, 0] > 0, variance[:, 0], np.nan))
    speed = stream.column("speed").astype(float) if stream.has("speed") else np.zeros(0)
    if not np.nan_to_num(speed).any():
        return None, None
    track, climb, within = (stream.column(name).astype(float) for name in ("track", "climb", "err_speed"))
    east, north = speed * np.sin(np.radians(track)), speed * np.cos(np.radians(track))
    up = climb if np.nan_to_num(climb).any() else np.full(len(climb), np.nan)
    sigma = np.where(within > 0.0, within, np.nan) / SIGMAS_IN_95
    velocity = np.where(speed[:, None] != 0.0, np.stack([east, north, up], axis=1), np.nan)
    return velocity, None if np.isnan(sigma).all() else sigma


def twists(stream: Stream) -> tuple[Array, Array]:
    """Body twists (N, 6), linear then angular, and the diagonal of their covariance (N, 6).

    The diagonal is NaN for types that have none.
    """
    at, variance = TWIST_AT[stream.msgtype]
    diagonal = np.full((len(stream), 6), np.nan)
    if variance:
        diagonal = np.stack([stream.column(f"{variance}{i}").astype(float) for i in DIAGONAL], axis=1)
    return np.hstack([stream.vectors(f"{at}linear"), stream.vectors(f"{at}angular")]), diagonal


def poses(stream: Stream) -> tuple[Array, Array, Array | None]:
    """Positions (N, 3), quaternions (N, 4) and covariances (N, 6, 6), None where not read or not there."""
    at, path = POSE_AT[stream.msgtype]
    covariance = None
    if path and stream.has(path):
        covariance = stream.column(path).astype(float).reshape(-1, 6, 6)
    return stream.vectors(f"{at}position"), stream.vectors(f"{at}orientation", "xyzw"), covariance


Key = tuple[str, str]
"""Name and type of a topic."""
_RULE = "=" * 80 + "\n"
Held = tuple[tuple[str, ...], Stream]
"""Fields, () for all, and the stream that has them."""
_DECODED: ContextVar[dict[tuple[tuple[BagSource, ...], Key], Held] | None]
_DECODED = ContextVar("streams decoded once", default=None)
"""By bag, known by its sources, and topic."""


@contextmanager
def broken_bag_on_error(topic: str | None = None) -> Iterator[None]:
    """Around parsers: the bytes are of unknown origin, so whatever they raise, the bag is broken."""
    try:
        yield
    except DataError:  # a limit, which names the file
        raise
    except Exception as error:
        raise BagError(str(error).rstrip(".") or "it breaks off inside a record", topic) from None


@contextmanager
def decoded_once() -> Iterator[None]:
    """Within it the fields of a topic are decoded once, however often its bag is opened."""
    token = _DECODED.set({})
    try:
        yield
    finally:
        _DECODED.reset(token)


def read_streams(
    container: BagContainer, asked: Mapping[Key, tuple[str, ...]], enough: int | None = None
) -> dict[Key, Stream]:
    """As `decode_streams`, which is not called for what is held `decoded_once`."""
    held = _DECODED.get()
    if held is None:
        return decode_streams(container, asked, enough)
    bag = tuple(container.sources)
    missing = {key: fields for key, fields in asked.items() if not _holds(held.get((bag, key)), fields)}
    if missing and enough is not None:
        return decode_streams(container, asked, enough)
    for key, stream in decode_streams(container, missing).items() if missing else ():
        held[bag, key] = (missing[key], stream)
    return {key: held[bag, key][1] for key in asked}


def _holds(held: Held | None, fields: tuple[str, ...]) -> bool:
    """Whether these fields, () for all, are among those decoded."""
    return held is not None and (not held[0] or (bool(fields) and set(fields) <= set(held[0])))


def decode_streams(
    container: BagContainer, asked: Mapping[Key, tuple[str, ...]], enough: int | None = None
) -> dict[Key, Stream]:
    """The streams of topics (fields by topic and type) in one go; stops once one has `enough` messages."""
    decoders: list[tuple[Key, MessageDecoder]] = []
    groups: list[list[int]] = []
    for key, fields in asked.items():
        alike: dict[tuple[str, str, str], list[BagSource]] = {}
        for source in container.sources:
            if (source.topic, source.msgtype) == key:
                alike.setdefault((source.definition, source.language, source.encoding), []).append(source)
        for sources in alike.values():
            with broken_bag_on_error(key[0]):
                cdr = _is_cdr(sources[0])
                decoders.append((key, MessageDecoder(key[1], types_of(sources[0]), fields, cdr, key[0])))
            groups.append([source.id for source in sources])
    batches = container.batches(groups)
    while True:
        with broken_bag_on_error():
            batch = next(batches, None)
        if batch is None:
            break
        key, decoder = decoders[batch.group]
        with broken_bag_on_error(key[0]):
            decoder.add(batch)
        if enough is not None and decoder.count >= enough:
            break
    return {key: _stream(key, [decoder for other, decoder in decoders if other == key]) for key in asked}


def _is_cdr(source: BagSource) -> bool:
    if source.encoding not in ("ros1", "cdr"):
        raise BagError(f"its messages are encoded as '{source.encoding[:20]}', which is not supported")
    return source.encoding == "cdr"


def _stream(key: Key, decoders: list[MessageDecoder]) -> Stream:
    """What the decoders of one topic gathered; there are several where its definition changes."""
    receipts, blocks = [], []
    count = 0
    for decoder in decoders:
        receipt_ns, found = decoder.result()
        receipts.append(receipt_ns)
        blocks += [MessageBlock(block.rows + count, block.columns) for block in found]
        count += len(receipt_ns)
    stream = Stream(*key, np.concatenate(receipts), tuple(blocks))
    return stream if len(decoders) == 1 else stream.select(np.argsort(stream.receipt_ns, kind="stable"))


def types_of(source: BagSource) -> Mapping[str, Fields]:
    """Fields of a source's type and of those it is made of.

    What the bag does not define is taken from ROS 1 Noetic or ROS 2 Humble: SQLite bags before
    ROS 2 Iron carry no definitions.
    """
    definition = source.definition or DEFINITIONS.get(source.msgtype, "")
    own = _parsed(dataclasses.replace(source, definition=definition)) if definition else {}
    return _released(source.encoding) | own


@cache
def _released(encoding: str) -> dict[str, Fields]:
    from rosbags.typesys import Stores, get_typestore

    release = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)
    return {name: fields for name, (_, fields) in release.fielddefs.items()}


def _parsed(source: BagSource) -> dict[str, Fields]:
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    if source.language == "msg":
        found = dict(get_types_from_msg(source.definition, source.msgtype))
    elif source.definition.startswith(f"{_RULE}IDL: "):
        found = {}
        for part in source.definition.split(_RULE)[1:]:
            found |= get_types_from_idl(part.split("\n", 1)[1])
    else:
        found = dict(get_types_from_idl(source.definition))
    return {name: fields for name, (_, fields) in found.items()}
