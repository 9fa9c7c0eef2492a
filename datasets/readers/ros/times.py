"""Times of a bag's messages: header stamps or receipt stamps, and the repair of clock steps."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array, TimesNs
from terrafusion.datasets.core.clock import in_order, repair_together, set_back, sorting
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import ClockJump
from terrafusion.datasets.readers.ros.streams import Stream

Times = dict[str, TimesNs]
"""Times (N,) by channel."""

CLOCK_TOLERANCE_S = 1.0
"""Header clocks whose distance to the recorder differs by more are not one clock."""
SAME_RATE = 0.1
REPAIR = "have the clock repaired (--repair-clock)"
RECEIPT = "read with stamps='receipt' (--stamps receipt)"


@dataclass
class StreamTimes:
    """Streams in order of time and their times, both by channel; and what was done for it."""

    streams: dict[str, Stream]
    times: Times = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    jumps: tuple[ClockJump, ...] = ()


def timing_of(streams: Mapping[str, Stream], *, stamps: str, repair_clock: bool) -> StreamTimes:
    """Times of every stream on one clock; the streams are in the order of the file.

    Header stamps are used unless `stamps` is "receipt", or they are all zero or the same, or the topics'
    header clocks do not agree. Messages without a header then take their receipt time, brought
    onto the header clock when the two clocks are more than a second apart.

    Messages that arrived out of order are sorted, also by receipt where that only varies by the time on the
    way. With `repair_clock` steps of the clock are taken out.

    Raises:
        DataError: a clock that was set back, or header stamps that are zero in part.
    """
    timing = StreamTimes({kind: _in_file_order(stream) for kind, stream in streams.items()})
    receipt = {kind: stream.receipt_ns for kind, stream in timing.streams.items()}
    received_jumps: tuple[ClockJump, ...] = ()
    steady = {kind for kind, stream in timing.streams.items() if _only_delayed(stream)}
    if repair_clock:
        stepping = {kind: t_ns for kind, t_ns in receipt.items() if kind not in steady}
        repaired, received_jumps = repair_together(stepping)
        receipt = receipt | repaired
    headed = _headed(timing, stamps)
    headed, header_jumps = _on_one_clock(timing, headed, receipt, repair_clock)
    others = {kind: t for kind, t in receipt.items() if kind not in headed}
    for kind, t_ns in others.items():
        if kind in steady:
            continue
        _refuse_backwards(timing.streams[kind], t_ns, "receipt", REPAIR)
    timing.times = headed | _onto(headed, receipt, others)
    timing.jumps = (*header_jumps, *(jump for jump in received_jumps if jump.channel in others))
    _sort(timing)
    return timing


def _in_file_order(stream: Stream) -> Stream:
    """The stream, sorted by receipt where the file holds it in an order that is not that of arrival.

    Recorders write what arrives, but bags that were merged, or written by several threads, are
    shuffled in pieces: sorting them takes at most three cuts for each place where time runs back.
    Where the recorder's clock was set back, sorting would mix two stretches row by row: that is
    left to the repair of clocks.
    """
    order = in_order(stream.receipt_ns)
    if order is None:
        return stream
    header = stream.header_ns
    if header is not None and header.any() and in_order(header) is None:
        return stream
    cuts, backwards = int((np.diff(order) != 1).sum()), int((np.diff(stream.receipt_ns) < 0).sum())
    return stream.select(order) if cuts <= 3 * backwards else stream


def _only_delayed(stream: Stream) -> bool:
    """Whether receipt stamps run back only because the time on the way varies: header stamps do not, and the
    recorder's clock had no step beside them.
    """
    header = stream.header_ns
    if header is None or not header.all() or in_order(header) is not None:
        return False
    if in_order(stream.receipt_ns) is None:
        return False
    return float(np.ptp(stream.receipt_ns - header)) < CLOCK_TOLERANCE_S * 1e9


def _headed(timing: StreamTimes, stamps: str) -> Times:
    """Header stamps of the streams that have some, unless receipt stamps are asked for."""
    found = {kind: t for kind, s in timing.streams.items() if (t := s.header_ns) is not None}
    headed = {kind: t for kind, t in found.items() if t.any() and not _stand_still(t)}
    if stamps == "receipt":
        late = _latencies(timing, headed, {kind: timing.streams[kind].receipt_ns for kind in headed})
        timing.notes.append("times are receipt stamps, as asked" + (f"; {late}" if late else ""))
        return {}
    for kind in (kind for kind in found if kind not in headed):
        topic = timing.streams[kind].topic
        value = "the same" if found[kind].any() else "zero"
        timing.notes.append(f"{topic}: header stamps are all {value}; receipt stamps are used")
    if not found:
        timing.notes.append("times are receipt stamps: no message has a header")
    return headed


def _stand_still(header_ns: TimesNs) -> bool:
    """Whether a driver set its stamps once and for all; two messages of one time are a message sent again."""
    return len(header_ns) > 2 and not np.ptp(header_ns)


def _on_one_clock(
    timing: StreamTimes, headed: Times, receipt: Times, repair_clock: bool
) -> tuple[Times, tuple[ClockJump, ...]]:
    """Header stamps that can be used together, repaired where that is asked for; none where they differ."""
    if not headed:
        return {}, ()
    for kind, t_ns in headed.items():
        _refuse_zeros(timing.streams[kind], t_ns)
        if not repair_clock:
            remedy = f"{RECEIPT} or {REPAIR}" if in_order(receipt[kind]) is None else REPAIR
            _refuse_backwards(timing.streams[kind], t_ns, "header", remedy)
    jumps: tuple[ClockJump, ...] = ()
    beside = {kind: receipt[kind] for kind, t in headed.items() if _same_rate(t, receipt[kind])}
    if repair_clock:
        headed, jumps = repair_together(headed, beside=beside)
    else:
        timing.notes += _leaps(headed, beside)
    spread_s, far = _spread(headed, receipt)
    if spread_s > CLOCK_TOLERANCE_S:
        topics = (timing.streams[kind].topic for kind in (_most_frequent(headed), far))
        timing.notes.append(
            f"header clocks differ by {spread_s:.3g} s between {' and '.join(topics)}; "
            "receipt stamps used for all"
        )
        return {}, ()
    timing.notes.append(f"times are header stamps; {_latencies(timing, headed, receipt)}")
    return headed, jumps


def _leaps(headed: Times, beside: Times) -> list[str]:
    """A note on header stamps that leap ahead where the receipt stamps do not."""
    try:
        _, jumps = repair_together(headed, beside=beside)
    except DataError:
        return ["the header clock leaps ahead of the recorder's all the time"]
    if not jumps:
        return []
    return [
        f"the header clock leaps ahead by {jumps[0].step_s:.3f} s and the recorder's does not "
        f"({len(jumps)} such steps); to take that out, {REPAIR}"
    ]


def _refuse_zeros(stream: Stream, header_ns: TimesNs) -> None:
    zero = np.flatnonzero(header_ns == 0)
    if zero.size and not _starts_at_zero(header_ns, zero):
        raise DataError(
            f"{zero.size} of {len(stream)} header stamps are zero",
            channel=stream.topic,
            time_s=_since(stream, int(zero[0])),
            remedy=RECEIPT,
        )


def _starts_at_zero(header_ns: TimesNs, zero: NDArray[np.int64]) -> bool:
    """Whether stamps of zero, in these rows, are times: the first ones of a simulated clock."""
    first = zero.size == zero[-1] + 1 < len(header_ns)
    return bool(first and 0 < header_ns[zero.size] < CLOCK_TOLERANCE_S * 1e9)


def _refuse_backwards(stream: Stream, t_ns: TimesNs, which: str, remedy: str) -> None:
    """Refuse a clock that was set back. Messages that arrived out of order have correct times."""
    row = set_back(t_ns, stream.topic)
    if row is not None:
        raise DataError(
            f"{which} stamps run backwards by {(t_ns[row - 1] - t_ns[row]) * 1e-9:.6f} s",
            channel=stream.topic,
            time_s=_since(stream, row if which == "header" else row - 1),
            remedy=remedy,
        )


def _since(stream: Stream, row: int) -> float:
    return float(stream.receipt_ns[row] - stream.receipt_ns[0]) * 1e-9


def _same_rate(a_ns: TimesNs, b_ns: TimesNs) -> bool:
    if len(a_ns) < 2:
        return False
    a, b = np.median(np.diff(a_ns)), np.median(np.diff(b_ns))
    return bool(abs(a - b) <= SAME_RATE * b)


def _offset_at(headed: Times, receipt: Times, t_ns: TimesNs) -> Array:
    """How many ns the header clock was behind the recorder's at these receipt times."""
    best = _most_frequent(headed)
    order = np.argsort(receipt[best], kind="stable")
    at, offset = receipt[best][order], (receipt[best] - headed[best])[order]
    return np.asarray(
        np.interp((t_ns - at[0]).astype(float), (at - at[0]).astype(float), offset.astype(float))
    )


def _most_frequent(times: Times) -> str:
    return max(times, key=lambda kind: len(times[kind]))


def _spread(headed: Times, receipt: Times) -> tuple[float, str]:
    """Largest distance (s) of a header clock to that of the most frequent one, and whose it is."""
    far = dict.fromkeys(headed, 0.0)
    for kind in (kind for kind in headed if kind != _most_frequent(headed)):
        apart = receipt[kind] - headed[kind] - _offset_at(headed, receipt, receipt[kind])
        far[kind] = abs(float(np.median(apart))) * 1e-9
    worst = max(far, key=far.__getitem__)
    return far[worst], worst


def _onto(headed: Times, receipt: Times, others: Times) -> Times:
    """Receipt stamps of streams without usable header stamps, on the header clock where that is another."""
    out = {}
    for kind, t_ns in others.items():
        offset = _offset_at(headed, receipt, t_ns) if headed else np.zeros(len(t_ns))
        apart = abs(float(np.median(offset))) > CLOCK_TOLERANCE_S * 1e9
        out[kind] = t_ns - np.rint(offset).astype(np.int64) if apart else t_ns
    return out


def _latencies(timing: StreamTimes, headed: Times, receipt: Times) -> str:
    """What was measured of receipt against header stamps, in words."""
    parts = []
    for kind, t_ns in headed.items():
        late_s = (receipt[kind] - t_ns) * 1e-9
        median, most = np.percentile(late_s, [50, 95])
        topic = timing.streams[kind].topic
        if abs(median) > CLOCK_TOLERANCE_S:
            parts.append(f"{topic} on another clock, {median:.6g} s away")
        else:
            parts.append(f"{topic} {median * 1e3:.3g} and {most * 1e3:.3g} ms")
    return f"received later by (median, 95 %): {', '.join(parts)}" if parts else ""


def _sort(timing: StreamTimes) -> None:
    """Sort messages by time, with a note where they were not."""
    for kind, t_ns in timing.times.items():
        if (late := sorting(t_ns, kind, "messages")) is not None:
            timing.notes.append(late[1])
            timing.streams[kind] = timing.streams[kind].select(late[0])
            timing.times[kind] = t_ns[late[0]]
