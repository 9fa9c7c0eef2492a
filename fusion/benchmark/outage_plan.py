"""Simulated GNSS outages, and simulated fixes for runs with a truth but no receiver.

The plan depends on the recording alone, so all modes lose the same fixes.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.channels import Fix, Gnss
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.metrics.scores import Outage

LEAD_S, LEAD_SHARE = 40.0, 0.2
"""Aiding before an outage, or its share of a short log: heading and slip must be observable first."""
TAIL_S = 1.0
"""Time after an outage, so that its last reference lies in the log."""
AID_HZ, AID_SIGMA_M, AID_SIGMA_UP_M = 2.0, 0.1, 0.2
"""Simulated fixes: rate and white noise; assumed, between RTK and differential GNSS."""


def plan_outages(earliest: float, last_s: float, seconds: float, most: int) -> tuple[Outage, ...]:
    """Outages of one length that start at `earliest` or later and end before `last_s`, evenly spread.

    At most `most`, starting at least half an outage apart; they are replayed one by one, so they may overlap.
    () if the span is too short.
    """
    latest = last_s - TAIL_S - seconds
    if latest < earliest or most < 1:
        return ()
    count = min(most, 1 + int((latest - earliest) / (0.5 * seconds)))
    starts = np.linspace(earliest, latest, count) if count > 1 else [0.5 * (earliest + latest)]
    return tuple(Outage(round(float(s), 3), seconds) for s in starts)


def aided_by_truth(recording: Recording, seed: int) -> Recording:
    """The recording with fixes simulated from its truth: at most `AID_HZ`, with white noise of `seed`.

    For a truth of the body the antenna is at the body origin, so that no lever arm maps heading errors of the
    truth into the fixes.

    Raises:
        DataError: the truth holds no positions.
    """
    truth = recording.truth
    if truth is None or not recording.truth_holds("position"):
        raise DataError("the truth holds no positions to simulate fixes from", channel="truth")
    known = np.flatnonzero(np.isfinite(truth.position_m[:, :2]).all(axis=1))
    rows = known[_thinned(truth.t_ns[known], 1.0 / AID_HZ)]
    sigma = np.array([AID_SIGMA_M, AID_SIGMA_M, AID_SIGMA_UP_M])
    noise = np.random.default_rng(seed).normal(size=(len(rows), 3)) * sigma
    n = len(rows)
    gnss = Gnss(
        truth.t_ns[rows],
        truth.position_m[rows] + noise,
        np.tile(sigma, (n, 1)),
        np.full(n, Fix.FIXED, dtype=np.uint8),
    )
    overrides = recording.overrides
    if recording.truth_frame == "base":
        overrides = dataclasses.replace(overrides, antenna_m=(0.0, 0.0, 0.0))
    note = f"fixes simulated from the truth, {AID_HZ:g} Hz, sigma {AID_SIGMA_M:g} m, seed {seed}"
    return dataclasses.replace(recording, gnss=gnss, overrides=overrides).with_notes(note)


def until(recording: Recording, seconds: float) -> Recording:
    """The recording up to `seconds` after its start."""
    end_ns = recording.start_ns + round(seconds * 1e9)
    cut = {name: channel.between(-(2**62), end_ns) for name, channel in recording.channels().items()}
    truth = recording.truth
    if truth is not None:
        truth = truth.select(truth.t_ns < end_ns)
    return dataclasses.replace(recording, truth=truth, **cut)  # type: ignore[arg-type]


def _thinned(t_ns: NDArray[np.int64], step_s: float) -> list[int]:
    """Indices of times (N,) at least `step_s` apart, from the first on."""
    kept: list[int] = []
    for i, t in enumerate(t_ns.tolist()):
        if not kept or t - int(t_ns[kept[-1]]) >= step_s * 1e9 - 1e6:
            kept.append(i)
    return kept
