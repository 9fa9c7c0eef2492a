"""Topics of a bag as streams: the messages of a container, decoded in one pass over the file."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache

import numpy as np

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.readers.ros.layout import Fields, MessageBlock, MessageDecoder
from terrafusion.datasets.readers.ros.messages import Stream
from terrafusion.datasets.readers.ros.raw import BagContainer, BagError, BagSource

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
        raise BagError(str(error).rstrip(".") or type(error).__name__, topic) from None


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
    """The streams of topics, in one go over the file.

    Args:
        asked: paths of the wanted fields by topic and type.
        enough: stop when one topic has so many messages.
    """
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
    return _released(source.encoding) | (_parsed(source) if source.definition else {})


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
