"""Whether the best explanation fits: what share of the gap it leaves beyond what references do."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from terrafusion.twin.gap.diagnose import diagnose
from terrafusion.twin.gap.infer import refit
from terrafusion.twin.gap.infer.channels import RIDGE, ChannelTable, ErrorProducts, RunProducts, run_energy
from terrafusion.twin.gap.infer.goodness_of_fit import (
    FEWEST,
    LEVEL,
    MOST_ABOVE,
    PERFECT_FIT,
    GoodnessOfFit,
    goodness_of_fit,
)
from terrafusion.twin.gap.infer.nonlinear_refit import DIVERGED
from terrafusion.twin.model.vehicle import load_vehicle
from tests.twin.gap.runs import runs

CHANNELS, ROWS, STATES, EFFECTS, RUNS, REFERENCES = 3, 300, 1, 4, 3, 14
SIGMA, WEIGHT = np.ones(STATES), np.ones(CHANNELS)
SCHEMA = json.loads((Path(__file__).parents[4] / "docs/schemas/diagnosis.schema.json").read_text("utf-8"))


def signatures(rng: np.random.Generator) -> np.ndarray:
    """Of the states and effects (C, n, N); the second effect (index 1) does nothing in channel 2."""
    J = 0.3 * rng.standard_normal((CHANNELS, ROWS, STATES + EFFECTS))
    J[2, :, STATES + 1] = 0.0
    return J


def block(J: np.ndarray, error: np.ndarray) -> RunProducts:
    gram = np.einsum("cni,cnj->cij", J, J)
    made = ErrorProducts(np.einsum("cni,cn->ci", J, error), (error**2).sum(axis=1))
    inverse = np.linalg.inv(gram + RIDGE * np.eye(J.shape[2]))
    return RunProducts(gram, inverse, made, STATES, np.full(CHANNELS, float(ROWS)))


def noise(rng: np.random.Generator) -> np.ndarray:
    return rng.standard_normal((CHANNELS, ROWS))


def judged(
    rng: np.random.Generator,
    gap: np.ndarray,
    left: np.ndarray,
    quiet: float = 1.0,
    references: int = REFERENCES,
) -> GoodnessOfFit:
    """Of runs whose gap is `gap` (C, N) times the signatures, beside noise, of which an explanation leaves
    `left` times them; channel 0 has `quiet` times the noise."""
    each = []
    for _ in range(references):
        b = block(signatures(rng), noise(rng))
        each.append(run_energy(b, b.error, SIGMA, WEIGHT))
    blocks, errors = [], []
    for _ in range(RUNS):
        J, e = signatures(rng), noise(rng)
        e[0] *= quiet
        blocks.append(block(J, e + np.einsum("cni,ci->cn", J, gap)))
        errors.append(block(J, e + np.einsum("cni,ci->cn", J, left)).error)
    floor = np.ones(CHANNELS)
    table = ChannelTable((), tuple(blocks), SIGMA, floor, floor, SIGMA, np.reshape(each, (-1, 2 * CHANNELS)))
    return goodness_of_fit(table, errors, WEIGHT)


def sizes(*values: float) -> np.ndarray:
    """The second effect, of this size in each channel."""
    out = np.zeros((CHANNELS, STATES + EFFECTS))
    out[:, STATES + 1] = values
    return out


def test_runs_like_the_references_leave_nothing() -> None:
    rng = np.random.default_rng(1)
    fits = sum(judged(rng, sizes(0, 0, 0), sizes(0, 0, 0)) == PERFECT_FIT for _ in range(200))
    assert fits >= (1.0 - 2 * LEVEL) * 200


def test_the_share_is_that_of_the_gap_however_large() -> None:
    """A rest far beyond chance is little where the gap was larger by far: half of the logarithm each time."""
    for size in (10.0, 100.0):
        rng = np.random.default_rng(2)
        good = judged(rng, sizes(size**2, size**2, size**2), sizes(size, size, size))
        assert 0.3 < good.left < 0.6
        assert good.above == MOST_ABOVE
        assert good.quieter == 0.0


def test_what_no_effect_touches_is_left_whole() -> None:
    rng = np.random.default_rng(4)
    elsewhere = np.zeros((CHANNELS, STATES + EFFECTS))
    elsewhere[2, STATES + 3] = 8.0
    assert judged(rng, elsewhere, elsewhere).left > 0.95
    also = elsewhere + sizes(40, 40, 0)
    assert 0.1 < judged(rng, also, elsewhere).left < 0.6


def test_an_explanation_that_makes_it_worse_leaves_no_more_than_all() -> None:
    assert judged(np.random.default_rng(3), sizes(8, 8, 0), sizes(40, 40, 0)).left == 1.0


def test_a_channel_that_became_quiet_is_told() -> None:
    good = judged(np.random.default_rng(5), sizes(0, 0, 0), sizes(0, 0, 0), quiet=0.6)
    assert good.quieter > -1.8 * np.log(0.6)
    assert good.left == good.above == good.misfit == 0.0


def test_without_references_nothing_is_called_left() -> None:
    assert (
        judged(np.random.default_rng(6), sizes(40, 40, 40), sizes(40, 40, 40), references=FEWEST - 1)
        == PERFECT_FIT
    )


def test_a_law_with_which_the_twin_diverges_is_told_as_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    """It stays a cause, without sigma and share, and the notes say why."""
    whole = refit.aligned_predictions

    def diverging(asks, model, candidates, jobs):  # type: ignore[no-untyped-def]
        found = whole(asks, model, candidates, jobs)
        return [None if "wheel_radius/scale" in a.effects else y for a, y in zip(asks, found, strict=True)]

    monkeypatch.setattr(refit, "aligned_predictions", diverging)
    given = runs(300, 2, {"wheel_radius/scale": 0.03})
    found = diagnose(given, runs(100, 6), load_vehicle("elevate"), effects=["wheel_radius", "track_width"])
    answer = found.to_json()
    jsonschema.validate(answer, SCHEMA)
    assert any(note.startswith("wheel_radius") and DIVERGED in note for note in found.notes)
    assert found.refits["wheel_radius"].failure == DIVERGED
    causes = {cause["effect"]: cause for cause in answer["causes"]}
    assert causes["wheel_radius"]["explained_share"] is None
    assert causes["wheel_radius"]["parameters"]["wheel_radius/scale"]["sigma"] is None
    assert causes["track_width"]["explained_share"] is not None
