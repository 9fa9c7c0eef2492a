"""All estimators of the study by name: opponents with their noise, and terrafusion's modes."""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.studies.opponents import ekf, ins, smoother
from tests.studies.opponents.inertial import Inertial
from tests.studies.opponents.protocol import Row, scored

TUNED = Path(__file__).with_name("tuned.json")
"""Noise of each opponent, as `tuning` found it on the tuning half of the logs."""
PLAIN_EKF = "EKF"
"""With the weights as first written, not tuned."""
TUNED_OPPONENTS = ("EKF tuned", "GTSAM smoother", "INS")
OPPONENTS = (PLAIN_EKF, *TUNED_OPPONENTS)
NOISE: dict[str, type] = {
    PLAIN_EKF: ekf.Noise,
    "EKF tuned": ekf.Noise,
    "GTSAM smoother": smoother.Noise,
    "INS": ins.Noise,
}
GRIDS: dict[str, dict[str, tuple[float, ...]]] = {
    "EKF tuned": {
        "speed_share": (0.05, 0.15, 0.3), "yaw_radpsqrts": (0.003, 0.01, 0.03), "yaw_share": (0.03, 0.1),
        "fix_factor": (1.0, 3.0),
    },
    "GTSAM smoother": {"along": (0.1, 0.3), "gyro": (1e-3, 1e-2), "fix_factor": (1.0,)},
    "INS": {"wheels_mps": (0.1, 0.3), "gyro": (3e-3, 1e-2), "fix_factor": (1.0,)},
}  # fmt: skip
"""What a competent user would try; the slow ones take the reported sigma of fixes as it is."""
MODES = ("fixed", "adaptive")


def grid(name: str) -> Iterator[dict[str, float]]:
    """All combinations of an opponent's noise."""
    axes = GRIDS[name]
    for values in itertools.product(*axes.values()):
        yield dict(zip(axes, values, strict=True))


def noise_of(name: str, values: dict[str, float] | None = None) -> Any:
    """Noise of an opponent: values given, else tuned, else as written."""
    if values is None and name != PLAIN_EKF and TUNED.is_file():
        values = json.loads(TUNED.read_text(encoding="utf-8"))["opponents"][name]["noise"]
    return dataclasses.replace(NOISE[name](), **(values or {}))


def rows_of(name: str, inputs: Inertial, seconds: float, noise: Any) -> list[Row]:
    """Outages of one length with an opponent; one that breaks down has the whole distance as error."""
    try:
        if NOISE[name] is ekf.Noise:
            return scored(inputs.streams, seconds, lambda blocked: ekf.run(inputs.streams, blocked, noise))
        runner: Any = {"GTSAM smoother": smoother.run, "INS": ins.run}[name]
        return scored(inputs.streams, seconds, lambda blocked: runner(inputs, blocked, noise))
    except (RuntimeError, ArithmeticError, ValueError):
        streams = inputs.streams
        starts = [a for part in streams.passes(seconds) for a in part]
        return [Row(a, streams.driven_m(a, seconds), streams.driven_m(a, seconds)) for a in starts]
