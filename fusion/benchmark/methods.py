"""The weightings that are compared: the estimator is the same, only its noise and what it is told differ."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.noise.labels import GroundLabels
from terrafusion.fusion.noise.modes import ModeTuning
from terrafusion.fusion.noise.policy import Policy, SensorNoise, load_policy
from terrafusion.fusion.terrain.classifier import UNKNOWN
from terrafusion.fusion.terrain.external import TRUE_SOURCES

SHEET = {
    "slip_mean": 0.0,
    "slip_per_grade": 0.0,
    "slip_sigma": 0.02,
    "slip_time_s": 10.0,
    "wheel_sigma_mps": 0.01,
    "side_slip_sigma": 0.01,
    "gyro_inflation": 1.0,
    "gyro_yaw_inflation": 1.0,
    "accel_inflation": 1.0,
    "gnss_inflation": 1.0,
}
"""What data sheets say: IMU and receiver as specified, wheels that roll. Odometry good to 2 % of the way
(0.01 m/s, 1 % to the side) is assumed: no data sheet of a wheel encoder knows the ground. What is not
named, such as how a skid-steered robot turns, stays as in the policy's fixed row."""
SHUFFLE_S = 10.0
"""How long a shuffled label lasts."""


@dataclass(frozen=True)
class Method:
    """One way to weight.

    Attributes:
        mode: of the estimator.
        about: for tables.
        sheet: the fixed row is `SHEET`, untuned.
        labels: what it is told of the ground: "" nothing, "true", "shuffled" or "adversarial".
    """

    name: str
    mode: str
    about: str
    sheet: bool = False
    labels: str = ""


METHODS = (
    Method("data sheet", "fixed", "one row, from data sheets", sheet=True),
    Method("fixed", "fixed", "one row for all grounds, tuned on the training drives"),
    Method("robust", "robust", "that row under a Cauchy loss, its scales tuned"),
    Method("innovation", "innovation", "that row, followed by the innovations (variational)"),
    Method("adaptive", "adaptive", "the policy's rows by the detected ground"),
    Method("oracle", "adaptive", "the policy's rows by the true ground", labels="true"),
    Method("shuffled", "adaptive", "rows of grounds drawn at random, a new one each 10 s", labels="shuffled"),
    Method("adversarial", "adaptive", "the row most foreign to the true ground", labels="adversarial"),
)
ADAPTIVE, BASELINE, ORACLE = "adaptive", "fixed", "oracle"
"""The arm that is judged, the one it is judged against, and the best labels can do."""


def replay_options(arm: Method, labels: GroundLabels | None, seed: int) -> dict[str, Any] | None:
    """Arguments of `replay` for an arm, or None where it needs labels and there are none.

    Of ground that the policy does not know the oracle says "unknown", and an adversary has nothing to say.

    Args:
        labels: the true ground of the drive.
        seed: of shuffled labels.
    """
    policy = load_policy()
    if arm.sheet:
        return {
            "mode": arm.mode,
            "policy": dataclasses.replace(policy, fixed=dataclasses.replace(policy.fixed, **SHEET)),
            "settings": {"tuning": ModeTuning()},
        }
    if not arm.labels:
        return {"mode": arm.mode}
    if labels is None or (arm.labels == "adversarial" and known_labels(labels) is None):
        return None
    told = {
        "true": labels,
        "shuffled": shuffled(labels, policy, seed),
        "adversarial": misleading(labels, policy),
    }
    return {"mode": arm.mode, "settings": {"labels": told[arm.labels]}}


def true_labels(recording: Recording) -> GroundLabels | None:
    """The ground as the recording knows it for sure, or None.

    From its terrain channel if a person or the simulation wrote it, else from its own name of the terrain.
    """
    terrain = recording.terrain
    if terrain is not None and len(terrain) and terrain.source in TRUE_SOURCES:
        label = terrain.label.astype(str)
        first = np.flatnonzero(np.concatenate([[True], label[1:] != label[:-1]]))
        times, names = tuple(terrain.t_ns[first].tolist()), tuple(label[first].tolist())
        return GroundLabels(times, names)
    return GroundLabels((recording.start_ns,), (recording.terrain_name,)) if recording.terrain_name else None


def known_labels(labels: GroundLabels | None) -> GroundLabels | None:
    """The labels where the policy knows one of them, else None: a log's own words are of all kinds."""
    known = set(load_policy().names()) - {UNKNOWN}
    return labels if labels is not None and known & set(labels.names) else None


def shuffled(labels: GroundLabels, policy: Policy, seed: int, seconds: float = 3600.0) -> GroundLabels:
    """Labels that know nothing: from the first true one on, a class drawn at random every `SHUFFLE_S`."""
    known = [name for name in policy.names() if name != UNKNOWN]
    count = math.ceil(seconds / SHUFFLE_S)
    drawn = np.random.default_rng(seed).integers(len(known), size=count)
    times = tuple(labels.t_ns[0] + k * round(SHUFFLE_S * 1e9) for k in range(count))
    return GroundLabels(times, tuple(known[i] for i in drawn))


def misleading(labels: GroundLabels, policy: Policy) -> GroundLabels:
    """Labels that mislead: each ground is called by the class most foreign to it; unknown ones "unknown"."""
    worst = {name: most_foreign(name, policy) for name in set(labels.names)}
    return GroundLabels(labels.t_ns, tuple(worst[name] for name in labels.names))


def most_foreign(name: str, policy: Policy) -> str:
    """The class whose slip is least like that of `name`, and which is sure of it.

    It has the largest Kullback-Leibler divergence of the true slip from the class's own, both taken as
    Gaussians (Kullback and Leibler 1951): firm ground for a slipping one, and the other way round.
    """
    if name not in policy.classes:
        return UNKNOWN
    true = policy.classes[name]
    others = [other for other in policy.names() if other not in (name, UNKNOWN)]
    return max(others, key=lambda other: _divergence(true, policy.classes[other]))


def _divergence(true: SensorNoise, other: SensorNoise) -> float:
    ratio = true.slip_sigma / other.slip_sigma
    apart = (true.slip_mean - other.slip_mean) / other.slip_sigma
    return 0.5 * (ratio**2 + apart**2 - 1.0) - math.log(ratio)
