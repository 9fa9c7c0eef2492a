"""What a log's own source of terrain probabilities becomes before it reaches the estimator."""

from __future__ import annotations

import dataclasses
import types
from typing import Any

import numpy as np
import pytest

from terrafusion.datasets.core.channels import Terrain
from terrafusion.fusion.benchmark.outage_plan import until
from terrafusion.fusion.estimator.messages import arguments_of
from terrafusion.fusion.replay import replay
from terrafusion.twin.simulate import simulate

KNOWN = ("asphalt", "mud", "unknown")


def camera(rows: list[list[float]], source: str = "camera") -> Terrain:
    t_ns = np.arange(len(rows), dtype=np.int64) * 10**9
    return Terrain(t_ns, np.array(["mud"] * len(rows)), source, ("mud", "lava", "asphalt"), np.array(rows))


def taken(terrain: Terrain) -> list[tuple[int, dict[str, float]]]:
    """What an estimator whose policy has the classes `KNOWN` is given of the messages."""
    config: Any = types.SimpleNamespace(policy=types.SimpleNamespace(names=lambda: KNOWN))
    rows = [(message.t_ns, arguments_of(message, config)) for message in terrain.samples()]
    return [(t_ns, *row[1]) for t_ns, row in rows if row is not None]


def test_classes_the_policy_lacks_are_unknown_ground() -> None:
    rows = taken(camera([[0.2, 0.5, 0.3], [1.0, 0.0, 0.0]]))
    assert rows[0] == (0, {"asphalt": 0.3, "mud": 0.2, "unknown": 0.5})
    assert rows[1] == (10**9, {"asphalt": 0.0, "mud": 1.0, "unknown": 0.0})


def test_what_is_no_probability_is_left_out() -> None:
    odd = [[np.nan, 0.5, 0.5], [-1.0, 1.0, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    assert [t for t, _ in taken(camera(odd))] == [3 * 10**9]


@pytest.mark.parametrize("source", ["annotation", "simulation"])
def test_the_truth_is_not_shown_to_the_estimator(source: str) -> None:
    assert taken(camera([[1.0, 0.0, 0.0]], source)) == []


def test_a_camera_in_the_log_reaches_the_weights() -> None:
    recording = until(simulate("figure_eight", vehicle="husky", terrain="asphalt", seed=5), 40.0)
    t_ns = recording.start_ns + np.arange(10, dtype=np.int64) * 10**9
    seen = Terrain(t_ns, np.array(["mud"] * 10), "camera", ("mud",), np.ones((10, 1)))
    estimate = replay(dataclasses.replace(recording, terrain=seen)).estimate
    names = [c.reason for c in estimate.changes]
    assert any("external source" in reason and "mud" in reason for reason in names)
    assert not any("external" in c.reason for c in replay(recording).estimate.changes)
