"""The weighting methods that a benchmark compares: one estimator, different noise and ground labels."""

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
from terrafusion.fusion.terrain.external import true_grounds

DATA_SHEET_NOISE = {
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
"""IMU and receiver as specified, wheels without slip. Odometry good to 2 % of the distance (0.01 m/s, 1 % to
the side) is assumed: no data sheet of an encoder states it. Other noise is the policy's for all grounds."""
SHUFFLE_S = 10.0
"""How long a shuffled label lasts."""


@dataclass(frozen=True)
class Method:
    """One weighting method.

    Attributes:
        about: its description in tables.
        sheet: the noise for all grounds is `DATA_SHEET_NOISE`, untuned.
        labels: ground labels given to the estimator: "" (none), "true", "shuffled" or "adversarial".
    """

    name: str
    mode: str
    about: str
    sheet: bool = False
    labels: str = ""


METHODS = (
    Method("data sheet", "fixed", "noise from data sheets, the same on all grounds", sheet=True),
    Method("fixed", "fixed", "the same noise on all grounds, tuned on the training runs"),
    Method("robust", "robust", "that noise under a Cauchy loss, its scales tuned"),
    Method("innovation", "innovation", "that noise, adapted to the innovations (variational)"),
    Method("adaptive", "adaptive", "the policy's noise of the detected ground"),
    Method("oracle", "adaptive", "the policy's noise of the true ground", labels="true"),
    Method(
        "shuffled", "adaptive", "noise of grounds drawn at random, a new one every 10 s", labels="shuffled"
    ),
    Method("adversarial", "adaptive", "noise of the ground least like the true one", labels="adversarial"),
)
ADAPTIVE, BASELINE, ORACLE = "adaptive", "fixed", "oracle"
"""The method under test, its baseline, and the best that true labels can do."""


def replay_options(method: Method, labels: GroundLabels | None, seed: int) -> dict[str, Any] | None:
    """Arguments of `replay` for a method, or None where it needs labels and there are none.

    Args:
        labels: the true ground of the run; a ground that the policy does not know counts as "unknown" for
            the oracle, and there is no adversarial label of it.
        seed: of shuffled labels.
    """
    policy = load_policy()
    if method.sheet:
        fixed = dataclasses.replace(policy.fixed, **DATA_SHEET_NOISE)
        policy = dataclasses.replace(policy, fixed=fixed)
        return {"mode": method.mode, "policy": policy, "settings": {"tuning": ModeTuning()}}
    if not method.labels:
        return {"mode": method.mode}
    if labels is None or (method.labels == "adversarial" and known_labels(labels) is None):
        return None
    given = {
        "true": labels,
        "shuffled": shuffled(labels, policy, seed),
        "adversarial": wrong_labels(labels, policy),
    }
    return {"mode": method.mode, "settings": {"labels": given[method.labels]}}


def true_labels(recording: Recording) -> GroundLabels | None:
    """The true ground of a recording, or None."""
    grounds = true_grounds(recording)
    return GroundLabels(*zip(*grounds, strict=True)) if grounds else None


def known_labels(labels: GroundLabels | None) -> GroundLabels | None:
    """The labels if the policy knows at least one of them, else None."""
    known = set(load_policy().names()) - {UNKNOWN}
    return labels if labels is not None and known & set(labels.names) else None


def shuffled(labels: GroundLabels, policy: Policy, seed: int) -> GroundLabels:
    """Random labels for an hour from the first true one on, a new class every `SHUFFLE_S`."""
    known = [name for name in policy.names() if name != UNKNOWN]
    count = math.ceil(3600.0 / SHUFFLE_S)
    drawn = np.random.default_rng(seed).integers(len(known), size=count)
    times = tuple(labels.t_ns[0] + k * round(SHUFFLE_S * 1e9) for k in range(count))
    return GroundLabels(times, tuple(known[i] for i in drawn))


def wrong_labels(labels: GroundLabels, policy: Policy) -> GroundLabels:
    """Each ground labelled as the class `most_different_class` to it."""
    worst = {name: most_different_class(name, policy) for name in set(labels.names)}
    return GroundLabels(labels.t_ns, tuple(worst[name] for name in labels.names))


def most_different_class(name: str, policy: Policy) -> str:
    """The class whose slip has the largest divergence from that of `name`; "unknown" for an unknown ground.

    Kullback-Leibler divergence of the true slip from the class's, both Gaussian (Kullback and Leibler 1951).
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
