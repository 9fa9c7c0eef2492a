"""Publishes a bag over DDS on the loopback, as a robot would: a process of its own in the tests of `live`."""

from __future__ import annotations

import argparse
import random
import time
from pathlib import Path

from terrafusion.datasets.readers.ros import topics as known
from terrafusion.datasets.readers.ros.arriving import KINDS
from terrafusion.datasets.readers.ros.ros2 import open_container
from terrafusion.fusion.live.dds import DdsBus

LATCHED = ("/tf_static", "/datum")


def messages_of(path: Path, skipped: tuple[str, ...] = ()) -> list[tuple[int, str, str, bytes]]:
    """Time, topic, type and CDR of all messages but this library's own, in the order of the file."""
    container = open_container(path)
    out = []
    for source in container.sources:
        if source.topic.startswith("/terrafusion") or source.topic in skipped:
            continue
        for batch in container.batches([[source.id]]):
            data = batch.data.tobytes()
            for start, size, t in zip(
                batch.starts.tolist(), batch.sizes.tolist(), batch.receipt_ns.tolist(), strict=True
            ):
                out.append((t, source.topic, source.msgtype, data[start : start + size]))
    container.close()
    return sorted(out, key=lambda one: one[0])


def is_used(msgtype: str) -> bool:
    """Whether a node subscribes to topics of this type, and would lose what is sent before."""
    return any(msgtype in known.TYPES[kind] for kind in KINDS)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("bag", type=Path)
    parser.add_argument("--domain", type=int, required=True)
    parser.add_argument("--speed", type=float, default=1.0)
    parser.add_argument("--loss", type=float, default=0.0)
    parser.add_argument("--begin", type=float, default=0.0, help="s from the start of the bag")
    parser.add_argument("--end", type=float, default=1e9)
    parser.add_argument("--garbage", action="store_true", help="also send messages that are broken")
    arguments = parser.parse_args()
    chance = random.Random(1)
    found = messages_of(arguments.bag)
    first = found[0][0]
    span = first + arguments.begin * 1e9, first + arguments.end * 1e9
    found = [one for one in found if one[1] in LATCHED or span[0] <= one[0] <= span[1]]
    bus = DdsBus(arguments.domain, loopback=True)
    types = {topic: msgtype for _, topic, msgtype, _ in found}
    ends = {topic: bus.advertise(topic, msgtype, topic in LATCHED) for topic, msgtype in types.items()}
    used = [ends[topic].entity for topic, msgtype in types.items() if is_used(msgtype)]
    deadline = time.monotonic() + 30.0
    while not all(end.get_matched_subscriptions() for end in used) and time.monotonic() < deadline:
        time.sleep(0.02)
    time.sleep(0.3)  # the subscriber learns of the match a little later
    begun = time.monotonic()
    for i, (t, topic, msgtype, cdr) in enumerate(found):
        due = begun + max(0.0, t - span[0]) * 1e-9 / arguments.speed
        if (ahead := due - time.monotonic()) > 0.0:
            time.sleep(ahead)
        if topic not in LATCHED and chance.random() < arguments.loss:
            continue
        bus.publish(topic, msgtype, cdr)
        if (
            arguments.garbage and topic == "/imu/data" and i % 7 == 0 and i > 2500
        ):  # no numbers for the acceleration
            bus.publish(topic, msgtype, cdr[:-96] + b"\xff" * 24 + cdr[-72:])
    time.sleep(0.3)  # reliable: what is still on its way


if __name__ == "__main__":
    main()
