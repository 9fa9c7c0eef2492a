"""`run_blind_check`: plan, commit, answer, open, score; continued where it was stopped.

from terrafusion.twin.gap.blind.check import run_blind_check
scores = run_blind_check("out", diagnose, scale=QUICK)
"""

import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.files import write_atomically
from terrafusion.twin.gap.blind import seal
from terrafusion.twin.gap.blind.answers import (
    DIAGNOSIS,
    OPPONENT,
    Diagnose,
    Pool,
    answer_all,
    answered,
    ask_oracle,
)
from terrafusion.twin.gap.blind.pin import plant_sha256, trials_sha256
from terrafusion.twin.gap.blind.plan import FULL, CheckSize, plan, to_text
from terrafusion.twin.gap.blind.score import score

RESULT = "blind.json"


def run_blind_check(
    out: Path | str,
    diagnose: Diagnose,
    *,
    scale: CheckSize = FULL,
    seed: int = 0,
    pool: Pool | None = None,
    progress: Callable[[float], None] | None = None,
    oracle: Diagnose | None = None,
    opponent: Diagnose | None = None,
    minutes: float = math.inf,
) -> dict[str, Any]:
    """Scores of a diagnosis on blind trials; `blind.json` in the folder `out` holds them too.

    Args:
        diagnose: the diagnosis to check, see `answers.Diagnose`.
        scale: how many trials.
        pool: where the trials are answered; by default in this process.
        oracle: the diagnosis once more, given the true `effects`: how far the gap could shrink.
        opponent: another diagnosis on the same trials.
        minutes: after which no trial is begun: those that are answered by then are scored. Their order is
            random.

    Raises:
        ConfigError: the folder holds a check of another seed, scale, plant or set of methods.
        DataError: answers or labels were changed, see `seal.open_labels`.
        TerrafusionError: the folder cannot be written, or the workers died.
    """
    folder, pool = Path(out), pool or Pool()
    methods = {DIAGNOSIS: diagnose} | ({} if opponent is None else {OPPONENT: opponent})
    trials = plan(seed, scale)
    public = {
        "seed": seed,
        "scale": dataclasses.asdict(scale),
        "plant_sha256": plant_sha256(),
        "trials_sha256": trials_sha256(),
        "methods": list(methods),
    }
    labels, before = to_text(trials), seal.commitment(folder)
    if before is None:
        seal.commit(folder, labels, public)
    elif {name: before.get(name) for name in public} != public:
        raise ConfigError(
            "holds a blind check of another seed or size, or of another version of the plant",
            file=folder,
            remedy="give another folder to --out",
        )
    if not seal.opened(folder):
        answer_all(folder, trials, methods, pool, progress, minutes)
    seal.open_labels(folder, labels)
    answers = answered(folder)
    opened = [trial for trial in trials if trial.trial in answers]
    best = {} if oracle is None else ask_oracle(folder, opened, oracle, pool)
    scores = {**score(opened, answers, best, list(methods)), **public, "planned": len(trials)}
    text = json.dumps(scores, indent=1, allow_nan=False)
    write_atomically(folder / RESULT, lambda part: part.write_text(text + "\n", encoding="utf-8"))
    return scores
