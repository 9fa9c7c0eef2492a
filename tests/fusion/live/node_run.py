"""A node that is fed with messages of a bag, and what came of it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.estimator.history import History
from terrafusion.fusion.live.node import LiveNode
from terrafusion.fusion.live.options import LiveOptions
from tests.fusion.live.conftest import VEHICLE

BagMessage = tuple[int, str, str, bytes]
STORE = get_typestore(Stores.ROS2_HUMBLE)


class Run:
    """A node, what it said and published, and its states."""

    def __init__(self, **options: Any) -> None:
        self.said: list[str] = []
        self.published: list[tuple[str, str, bytes]] = []
        self.history = History()
        self.node = LiveNode(
            LiveOptions(**{"vehicle": VEHICLE, **options}),
            lambda *message: self.published.append(message),
            self.said.append,
            self.history,
        )

    def feed(self, messages: Iterable[BagMessage], close: bool = True) -> Run:
        """The messages at the pace of their times."""
        first = None
        for t, topic, msgtype, cdr in messages:
            first = t if first is None else first
            if self.node.wants(topic, msgtype):
                self.node.receive(topic, msgtype, cdr, t)
            self.now_s = self.begun_s + (t - first) * 1e-9
            self.node.tick(self.now_s)
        self.begun_s = self.now_s
        if close:
            self.node.close()
        return self

    begun_s = now_s = 1e6

    def decoded(self, topic: str) -> list[Any]:
        """What was published on a topic, by the decoder of rosbags."""
        return [STORE.deserialize_cdr(cdr, kind) for name, kind, cdr in self.published if name == topic]


def error_m(history: History, recording: Recording) -> float:
    """Root mean square of the horizontal errors of the states with fixes."""
    states = [state for state in history.states if state.status == "running"]
    assert len(states) > 30
    assert recording.truth is not None
    truth = recording.truth.positions_at(np.array([state.t_ns for state in states]))
    off = np.array([state.position_m for state in states]) - truth
    return float(np.sqrt((off[:, :2] ** 2).sum(axis=1).mean()))
