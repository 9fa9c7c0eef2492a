"""Places of a gap: p-values of one judged run among a few references, with and without a gap."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from terrafusion.twin.gap.answer import cells, where
from terrafusion.twin.gap.answer.cells import REGIMES, SLOW_S, RunCells
from terrafusion.twin.gap.blind.rates import Rate
from terrafusion.twin.gap.infer.other_drives import learn_offsets
from terrafusion.twin.gap.null.score import Score
from terrafusion.twin.gap.rollout.nuisance import CHANNEL_NAMES
from terrafusion.twin.gap.rollout.residuals import WhitenedRun

CHANNELS, SAMPLES, TRIALS = ("yaw_rate_radps", "accel_x_mps2"), 400, 100
NAMES = [CHANNEL_NAMES[name] for name in CHANNELS]
SIGMA = np.ones(1)


@pytest.fixture(autouse=True)
def two_regimes(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first half of a run, and the second."""
    monkeypatch.setattr(cells, "regimes", lambda run, _: (run.time_s > 20.0).astype(np.int64))


def run(
    rng: np.random.Generator, robot: np.ndarray, drive: float, louder: float = 1.0, patchy: float = 0.0
) -> WhitenedRun:
    """A run whose columns are larger on another drive; its second channel is louder in the second half, and
    each sixth of a channel by a `patchy` random factor of its own."""
    n, P = len(CHANNELS) * SAMPLES, len(robot)
    channel, time_s = np.repeat([0, 1], SAMPLES), np.tile(np.linspace(0.0, 40.0, SAMPLES), 2)
    waves = np.sin(np.outer(time_s, 0.2 * (1 + np.arange(P))) + channel[:, None])
    columns = np.column_stack([np.ones(n), drive * waves])
    noise = rng.standard_normal(n) * np.exp(0.1 * rng.standard_normal())
    noise[(channel == 1) & (time_s > 20.0)] *= louder
    if patchy:
        noise *= np.exp(patchy * rng.standard_normal(12))[6 * channel + sixth(time_s)]
    error = columns @ np.append(rng.standard_normal(), robot + 0.15 * rng.standard_normal(P)) + noise
    rows, none = np.column_stack([columns, error]), np.zeros((n, 0))
    residuals: Any = SimpleNamespace(
        log=SimpleNamespace(observed=[SimpleNamespace(channel=name) for name in CHANNELS])
    )
    return WhitenedRun(
        residuals, rows.T @ rows, rows.astype(np.float32), none, none, channel, time_s,
        np.zeros(n, dtype=np.int64), 1, np.zeros((0, n)), np.full(2, np.inf),
    )  # fmt: skip


def sixth(time_s: np.ndarray) -> np.ndarray:
    """Of a run, 0 to 5."""
    return np.minimum(6.0 * time_s / 40.0, 5.0).astype(np.int64)


def p_values(
    seed: int, drive: float, louder: float = 1.0, references: int = 8, patchy: float = 0.0
) -> np.ndarray:
    """Of the cells of one judged run, beside some references."""
    rng = np.random.default_rng(seed)
    robot = 0.3 * rng.standard_normal(4)
    every = [run(rng, robot, drive, louder, patchy)]
    every += [run(rng, robot, 1.0, 1.0, patchy) for _ in range(references)]
    scores = [Score(r.gram[1:-1, -1], r.gram[1:-1, 1:-1]) for r in every[1:]]
    offsets = learn_offsets(scores, 4)
    evidence: Any = SimpleNamespace(runs=every[:1], references=every[1:])
    of = [RunCells.of(r, evidence, NAMES) for r in every]
    errors = where.out_of_sample(every[:1], every[1:], SIGMA, offsets)
    square = np.array([c.squares(e[:, None])[:, 0] for c, e in zip(of, errors, strict=True)])
    kept = np.flatnonzero(of[0].count >= 1.0)
    assert len(kept) in (8, 24)
    return where._p_values(evidence, SIGMA, offsets, of, square, kept, rng)


@pytest.mark.parametrize(("drive", "references"), [(1.0, 4), (1.0, 8), (3.0, 8)])
def test_without_a_gap_places_are_seldom_significant(drive: float, references: int) -> None:
    """On drives of the references, few or more, and on one that shows more of what these leave unknown."""
    found = [p_values(seed, drive, references=references).min() for seed in range(TRIALS)]
    alarms = Rate(sum(p <= 0.05 for p in found), TRIALS)
    assert alarms.interval()[0] <= 0.05


def test_cells_that_scatter_by_themselves_are_seldom_significant(monkeypatch: pytest.MonkeyPatch) -> None:
    """The greatest of 24 cells, the spread of each of which five references show."""
    monkeypatch.setattr(cells, "regimes", lambda run, _: sixth(run.time_s))
    found = [p_values(seed, 1.0, references=5, patchy=0.4).min() for seed in range(TRIALS)]
    assert Rate(sum(p <= 0.05 for p in found), TRIALS).interval()[0] <= 0.05


def test_the_place_of_a_gap_is_found_in_one_run() -> None:
    found = np.array([p_values(seed, 1.0, 2.0) for seed in range(20)])
    assert np.mean(found[:, -1] <= 0.05) > 0.9  # second channel, second half, above 0.5 Hz


def test_squares_of_cells_add_up_to_those_of_the_run() -> None:
    rng = np.random.default_rng(1)
    one = run(rng, np.zeros(4), 1.0)
    of = RunCells.of(one, SimpleNamespace(), NAMES)  # type: ignore[arg-type]
    errors = rng.standard_normal((len(one.time_s), 3))
    found = of.squares(errors).reshape(len(NAMES), len(REGIMES), 2, 3)
    np.testing.assert_allclose(found.sum(axis=(0, 1, 2)), np.square(errors).sum(axis=0))
    assert of.count.sum() == len(errors)
    first = (one.channel == 0) & (one.time_s <= 20.0)
    slow = [
        e.mean(axis=0) ** 2 * len(e)
        for k in range(11)
        if len(e := errors[first & (np.floor(one.time_s / SLOW_S) == k)])
    ]
    np.testing.assert_allclose(found[0, 0, 0], np.sum(slow, axis=0))
