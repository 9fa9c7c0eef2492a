"""Diagnoses for tests of the blind check: one that knows all, one that guesses, one that breaks."""

from __future__ import annotations

import functools
import time
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.effects.catalogue import effect_names
from terrafusion.twin.gap.blind.answers import BlindCase
from terrafusion.twin.gap.blind.plan import Trial
from terrafusion.twin.gap.blind.plant.run import record
from terrafusion.twin.gap.blind.plant.spec import RunSpec, Segment
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vehicle import load_vehicle


@dataclass(frozen=True)
class Fixed:
    """An answer that is there already."""

    content: dict[str, Any]

    def to_json(self) -> dict[str, Any]:
        return self.content


def diagnosis(
    verdict: str, ranked: Sequence[tuple[str, float]] = (), named: Sequence[str] = (), unknown: float = 0.0
) -> dict[str, Any]:
    """A full answer of the contract from what matters in it; each effect is a class of its own."""
    causes = [
        {"effect": effect, "class": [effect], "probability": p, "parameters": {}, "explained_share": None}
        for effect, p in ranked
    ]
    found = verdict != "no_gap"
    gap = {"detected": found, "statistic": 1.0, "p_value": 0.0 if found else 1.0, "significance": 0.05}
    return {
        "schema": "terrafusion.gap/1", "runs": ["run-1"], "reference_runs": [], "vehicle": "elevate",
        "seconds": 60.0, "gap": gap | {"uncalibrated": False}, "where": [], "verdict": verdict,
        "causes": causes, "named": list(named), "p_unknown": unknown, "p_null": 0.0 if found else 1.0,
        "shrink": None, "next_run": None,
    }  # fmt: skip


def perfect(trial: Trial) -> dict[str, Any]:
    """The truth."""
    truth = trial.effects()
    if trial.family == "null":
        return diagnosis("no_gap")
    if trial.family == "outside":
        return diagnosis("unknown", unknown=1.0)
    verdict = "parameters" if truth == ("soil_strength",) else "effect"
    return diagnosis(
        verdict, [(e, 1.0 / len(truth)) for e in truth], () if verdict == "parameters" else truth
    )


def guessed(trial: Trial) -> dict[str, Any]:
    """Any effect, with a confidence that is right on average."""
    names = effect_names()
    rng = np.random.default_rng(zlib.crc32(trial.trial.encode()))
    order = [names[i] for i in rng.permutation(len(names))]
    return diagnosis("effect", [(name, 1.0 / len(names)) for name in order], order[:1])


def guess(runs: Any, references: Any, vehicle: Any, *, seed: int = 0) -> Fixed:
    """A diagnosis that looks at the data's last digits only."""
    names = effect_names()
    which = int(abs(runs[0].gnss.enu_m[-1, 0]) * 1e6) % len(names)
    return Fixed(diagnosis("effect", [(names[which], 0.5)], [names[which]]))


def slow_guess(runs: Any, references: Any, vehicle: Any, *, seed: int = 0) -> Fixed:
    """The same in a tenth of a second: time to be killed in."""
    time.sleep(0.1)
    return guess(runs, references, vehicle, seed=seed)


def breaking(runs: Any, references: Any, vehicle: Any, *, seed: int = 0) -> Fixed:
    """A diagnosis that fails."""
    raise np.linalg.LinAlgError("singular")


@functools.cache
def _short_runs(seeds: tuple[int, ...]) -> tuple[Recording, ...]:
    vehicle, soil = load_vehicle("elevate"), load_soil("gravel")
    return tuple(record([RunSpec(vehicle, soil, (Segment(1.0),), seed=seed) for seed in seeds]))


def short_cases(trials: Sequence[Trial]) -> Iterator[BlindCase]:
    """In place of `answers.cases`: recordings of a second each, all of one robot."""
    runs = _short_runs(tuple(t.seed % 997 for t in trials)) if trials else ()
    vehicle = load_vehicle("elevate")
    return (BlindCase(t.trial, (run,), (), vehicle) for t, run in zip(trials, runs, strict=True))


def without_times(scores: dict[str, Any]) -> dict[str, Any]:
    """Scores without what depends on the clock."""
    figures = {name: {**some, "seconds": None} for name, some in scores["figures"].items()}
    rows = [row for row in scores["headline"] if not row["name"].startswith("CPU seconds")]
    return {**scores, "figures": figures, "headline": rows}
