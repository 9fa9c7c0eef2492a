"""`run_blind_check`: plan, seal, answer, open, score; resumed where it was stopped.

from terrafusion.twin.gap.blind.check import run_blind_check
scores = run_blind_check("out", diagnose, quick=True)
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.files import write_atomically
from terrafusion.twin.gap.blind import seal
from terrafusion.twin.gap.blind.answers import Diagnose, answer_all, answered, ask_oracle
from terrafusion.twin.gap.blind.pin import plant_sha256
from terrafusion.twin.gap.blind.plan import FULL, QUICK, CheckSize, Trial, from_text, plan, to_text
from terrafusion.twin.gap.blind.score import score

RESULT = "blind.json"


def run_blind_check(
    out: Path | str,
    diagnose: Diagnose,
    *,
    quick: bool = False,
    scale: CheckSize | None = None,
    seed: int = 0,
    jobs: int = 1,
    progress: Callable[[float], None] | None = None,
    oracle: Diagnose | None = None,
) -> dict[str, Any]:
    """Scores of a diagnosis on sealed trials; `blind.json` in the folder `out` holds them too.

    Args:
        diagnose: the diagnosis to check, see `answers.Diagnose`.
        quick: a small subset of all families.
        scale: in place of the full or quick one.
        oracle: the diagnosis once more, given the true `effects`: how far the gap could shrink.

    Raises:
        ConfigError: the folder holds a check of another seed, scale or plant.
        DataError: answers or labels were changed, see `seal.unseal`.
        TerrafusionError: the folder cannot be written, or the workers died.
    """
    folder, scale = Path(out), scale or (QUICK if quick else FULL)
    trials = plan(seed, scale)
    public = {
        "seed": seed,
        "scale": _scale_json(scale),
        "trials": len(trials),
        "plant_sha256": plant_sha256(),
    }
    _sealed(folder, trials, public)
    if not (folder / seal.CLOSED).is_file():
        answer_all(folder, trials, diagnose, jobs, progress)
    return scored(folder, public, oracle, jobs)


def scored(
    folder: Path, public: Mapping[str, Any], oracle: Diagnose | None = None, jobs: int = 1
) -> dict[str, Any]:
    """Opens the labels, scores the closed answers, writes `blind.json`.

    Raises:
        DataError: see `seal.unseal`.
    """
    trials = from_text(seal.unseal(folder))
    best = {} if oracle is None else ask_oracle(folder, trials, oracle, jobs)
    scores = {**score(trials, answered(folder), best), **public}
    text = json.dumps(scores, indent=1, allow_nan=False)
    write_atomically(folder / RESULT, lambda part: part.write_text(text + "\n", encoding="utf-8"))
    return scores


def _sealed(folder: Path, trials: list[Trial], public: Mapping[str, Any]) -> None:
    """Seals the labels, unless they are; then they must be of the same check."""
    before = seal.commitment(folder)
    if before is None:
        folder.mkdir(parents=True, exist_ok=True)
        seal.seal(folder, to_text(trials), public)
    elif {name: before.get(name) for name in public} != dict(public):
        raise ConfigError(
            "holds a blind check of another seed or size, or of another version of the plant",
            file=folder,
            remedy="give another folder to --out",
        )


def _scale_json(scale: CheckSize) -> dict[str, Any]:
    return {**dataclasses.asdict(scale), "severities": list(scale.severities)}
