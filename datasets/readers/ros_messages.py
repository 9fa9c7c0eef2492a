"""Messages of a bag as arrays: the same for ROS 1 and ROS 2.

`Stream` holds one topic's messages with both clocks; `times_of` chooses the
clock for the whole bag, so that channels stay comparable with one another.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.errors import DataError
from terrafusion.datasets.recording import Wheels

Array = NDArray[np.float64]
TimesNs = NDArray[np.int64]

UNKNOWN_VARIANCE = 1e6
"""A variance from here on says, by ROS custom, that the quantity is not known."""

CLOCK_TOLERANCE_S = 1.0
"""Header clocks whose distance to the recorder differs by more are not one clock."""


@dataclass(frozen=True, eq=False)
class Stream:
    """The messages of one topic in the order they were recorded.

    Attributes:
        receipt_ns: (N,) when the recorder got them.
        header_ns: (N,) their header stamps, None for types without a header.
        frame_ids: (N,) of the header, without a leading slash; empty without a header.
        messages: the deserialised messages.
    """

    topic: str
    msgtype: str
    receipt_ns: TimesNs
    header_ns: TimesNs | None
    frame_ids: tuple[str, ...]
    messages: list[Any]

    def select(self, rows: NDArray[np.bool_]) -> Stream:
        """The messages of a boolean mask."""
        index = np.flatnonzero(rows).tolist()
        return Stream(
            self.topic,
            self.msgtype,
            self.receipt_ns[rows],
            None if self.header_ns is None else self.header_ns[rows],
            tuple(self.frame_ids[i] for i in index) if self.frame_ids else (),
            [self.messages[i] for i in index],
        )


def make_stream(topic: str, msgtype: str, receipt_ns: list[int], messages: list[Any]) -> Stream:
    """A stream of deserialised messages; header stamps and frames are taken out."""
    headers = [m.header for m in messages] if messages and hasattr(messages[0], "header") else []
    stamps = [h.stamp.sec * 1_000_000_000 + h.stamp.nanosec for h in headers]
    return Stream(
        topic,
        msgtype,
        np.array(receipt_ns, dtype=np.int64),
        np.array(stamps, dtype=np.int64) if headers else None,
        tuple(h.frame_id.lstrip("/") for h in headers),
        messages,
    )


def times_of(streams: Sequence[Stream], stamps: str, file: Path) -> tuple[dict[str, TimesNs], list[str]]:
    """Times of every stream on one clock, (N,) int64 by topic, and notes on the choice.

    Header stamps are used unless `stamps` is "receipt", or they are all zero, or the topics'
    header clocks do not agree. Messages without a header then take their receipt time, brought
    onto the header clock when the two clocks are more than a second apart.

    Raises:
        DataError: header stamps that run backwards or are zero in part.
    """
    receipt = {s.topic: s.receipt_ns for s in streams}
    if stamps == "receipt":
        return receipt, ["times are receipt stamps, as asked"]
    headed = [s for s in streams if s.header_ns is not None and s.header_ns.any()]
    unstamped = [s.topic for s in streams if s.header_ns is not None and not s.header_ns.any()]
    notes = [f"{topic}: header stamps are all zero; receipt stamps are used" for topic in unstamped]
    if not headed:
        return receipt, notes or ["times are receipt stamps: no message has a header"]
    for stream in headed:
        _check_stamps(stream, file)
    offsets = {s.topic: _offset_s(s) for s in headed}
    offset_s = float(np.median(list(offsets.values())))
    spread_s = max(offsets.values()) - min(offsets.values())
    if spread_s > CLOCK_TOLERANCE_S:
        far = max(offsets, key=lambda topic: abs(offsets[topic] - offset_s))
        return receipt, [
            *notes,
            f"header clocks differ by {spread_s:.3g} s between topics ({far}); receipt stamps used for all",
        ]
    shift_ns = round(offset_s * 1e9) if abs(offset_s) > CLOCK_TOLERANCE_S else 0
    times = {s.topic: s.receipt_ns - shift_ns for s in streams}
    times |= {s.topic: s.header_ns for s in headed if s.header_ns is not None}
    return times, [*notes, "times are header stamps"]


def _offset_s(stream: Stream) -> float:
    assert stream.header_ns is not None
    return float(np.median((stream.receipt_ns - stream.header_ns) * 1e-9))


def _check_stamps(stream: Stream, file: Path) -> None:
    assert stream.header_ns is not None
    zero = int((stream.header_ns == 0).sum())
    since = (stream.receipt_ns - stream.receipt_ns[0]) * 1e-9
    remedy = "read with stamps='receipt' (--stamps receipt)"
    if zero:
        at = float(since[np.flatnonzero(stream.header_ns == 0)[0]])
        raise DataError(
            f"{zero} of {len(stream.messages)} header stamps are zero",
            file=file,
            channel=stream.topic,
            time_s=at,
            remedy=remedy,
        )
    step = np.diff(stream.header_ns)
    back = np.flatnonzero(step < 0)
    if back.size:
        i = int(back[0])
        raise DataError(
            f"header stamps run backwards by {-step[i] * 1e-9:.6f} s",
            file=file,
            channel=stream.topic,
            time_s=float(since[i + 1]),
            remedy=remedy,
        )


def vectors(items: Sequence[Any]) -> Array:
    """(N, 3) of x, y, z."""
    return np.array([(v.x, v.y, v.z) for v in items], dtype=float).reshape(-1, 3)


def quaternions(items: Sequence[Any]) -> Array:
    """(N, 4) of x, y, z, w."""
    return np.array([(q.x, q.y, q.z, q.w) for q in items], dtype=float).reshape(-1, 4)


def twists(stream: Stream) -> tuple[Array, Array]:
    """Body twists (N, 6), linear then angular, and the diagonal of their covariance (N, 6).

    The diagonal is NaN for types that have none.
    """
    bodies = [m.twist if hasattr(m, "twist") else m for m in stream.messages]
    diagonal = np.full((len(bodies), 6), np.nan)
    if bodies and hasattr(bodies[0], "covariance"):
        diagonal = np.array([b.covariance[::7] for b in bodies], dtype=float).reshape(-1, 6)
        bodies = [b.twist for b in bodies]
    return np.hstack([vectors([b.linear for b in bodies]), vectors([b.angular for b in bodies])]), diagonal


def poses(stream: Stream) -> tuple[Array, Array, Array | None]:
    """Positions (N, 3), quaternions (N, 4) and covariances (N, 6, 6) or None."""
    items = [m.pose for m in stream.messages]
    covariance = None
    if items and hasattr(items[0], "covariance"):
        covariance = np.array([p.covariance for p in items], dtype=float).reshape(-1, 6, 6)
        items = [p.pose for p in items]
    return vectors([p.position for p in items]), quaternions([p.orientation for p in items]), covariance


_SIDES = {"left": "left", "l": "left", "right": "right", "r": "right"}
_ENDS = {"front": "front", "f": "front", "rear": "rear", "back": "rear", "b": "rear", "hind": "rear"}
_SHORT = {
    f"{e}{s}": (end, side)
    for e, end in (("f", "front"), ("r", "rear"), ("b", "rear"))
    for s, side in (("l", "left"), ("r", "right"))
}
_SHORT |= {f"l{e}": (end, "left") for e, end in (("f", "front"), ("r", "rear"), ("b", "rear"))}
_SHORT |= {"rf": ("front", "right"), "rb": ("rear", "right")}
_NOT_WHEELS = re.compile(r"steer|arm|flipper|gripper|pan|tilt|caster|suspension|rocker|bogie", re.IGNORECASE)


def wheel_of_joint(joint: str) -> str | None:
    """Name of the wheel (left, front_right, ...) that a joint's name tells, or None."""
    if _NOT_WHEELS.search(joint):
        return None
    spaced = re.sub(r"([a-z])([A-Z])", r"\1_\2", joint)
    words = [word for word in re.split(r"[^a-z]+", spaced.lower()) if word]
    for word in words:
        if word in _SHORT:
            return "_".join(_SHORT[word])
    side = next((_SIDES[w] for w in words if w in _SIDES), None)
    if side is None:
        return None
    end = next((_ENDS[w] for w in words if w in _ENDS), None)
    if end is None and any(w in ("middle", "mid", "center", "centre") for w in words):
        return None
    return f"{end}_{side}" if end else side


def wheel_joints(names: Sequence[str], said: dict[str, str]) -> dict[str, str]:
    """Wheel -> joint name for the best layout the joints fill; empty when none is filled."""
    found = dict(said)
    candidates = [n for n in names if "wheel" in n.lower()] or list(names)
    for joint in candidates:
        wheel = wheel_of_joint(joint)
        if wheel is not None:
            found.setdefault(wheel, joint)
    for layout in (Wheels.LAYOUTS[1], Wheels.LAYOUTS[0]):
        if all(wheel in found for wheel in layout):
            return {wheel: found[wheel] for wheel in layout}
    return {}
