"""Trials put to a diagnosis, and what it answers: one line of JSON a trial, written as soon as it is
there."""

from __future__ import annotations

import functools
import json
import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from terrafusion.datasets.core.files import write_atomically
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.executors import open_workers
from terrafusion.twin.gap.blind import seal
from terrafusion.twin.gap.blind.plan import VEHICLE, Trial, specs
from terrafusion.twin.model.vehicle import VehicleParams, load_vehicle

ORACLE = "oracle.jsonl"
LANES = 160
"""Runs of the plant computed side by side (memory: about 5 MB each)."""


class Answer(Protocol):
    """What a diagnosis gives back."""

    def to_json(self) -> dict[str, Any]:
        """Keeps to `diagnosis.schema.json`."""


Diagnose = Callable[..., Answer]
"""diagnose(runs, references, vehicle, *, seed) -> Answer"""


@dataclass(frozen=True, eq=False)
class Case:
    """What a diagnosis is given of a trial: nothing of the truth."""

    trial: str
    runs: tuple[Recording, ...]
    references: tuple[Recording, ...]
    vehicle: VehicleParams


def cases(trials: Sequence[Trial]) -> Iterator[Case]:
    """The trials' recordings, made as they are asked for."""
    from terrafusion.twin.gap.blind.plant.run import record

    vehicle = load_vehicle(VEHICLE)
    for block in _blocks(trials):
        many = [specs(trial) for trial in block]
        names = [f"{kind}-{i + 1}" for trial in block for kind, i in _names(trial)]
        recordings = iter(record([spec for own in many for spec in own], names=names))
        for trial in block:
            runs = tuple(next(recordings) for _ in range(trial.runs))
            yield Case(trial.trial, runs, tuple(next(recordings) for _ in range(trial.references)), vehicle)


def _names(trial: Trial) -> list[tuple[str, int]]:
    return [*(("run", i) for i in range(trial.runs)), *(("reference", i) for i in range(trial.references))]


def _blocks(trials: Sequence[Trial]) -> Iterator[list[Trial]]:
    """Trials whose runs are computed together."""
    block: list[Trial] = []
    for trial in trials:
        if block and sum(t.runs + t.references for t in (*block, trial)) > LANES:
            yield block
            block = []
        block.append(trial)
    if block:
        yield block


def answered(folder: Path, name: str = seal.ANSWERS) -> dict[str, dict[str, Any]]:
    """Answers that are there, by trial; a line that was cut off does not count."""
    path = folder / name
    found = {}
    for line in path.read_text(encoding="utf-8").splitlines() if path.is_file() else ():
        try:
            entry = json.loads(line)
        except json.JSONDecodeError:
            continue
        found[entry["trial"]] = entry
    return found


def answer_all(
    folder: Path,
    trials: Sequence[Trial],
    diagnose: Diagnose,
    jobs: int,
    progress: Callable[[float], None] | None = None,
) -> None:
    """Puts the trials that have no answer yet to the diagnosis; closes the answers when all are there."""
    done = answered(folder)
    _rewrite(folder, done)  # without a line that was cut off
    missing = [trial for trial in trials if trial.trial not in done]
    seal.forbid(folder)
    try:
        with open_workers("loky", jobs) as pool, (folder / seal.ANSWERS).open("a", encoding="utf-8") as file:
            questions = ((case, diagnose, folder) for case in cases(missing))
            for entry in pool.results(answer, questions):
                file.write(json.dumps(entry) + "\n")
                file.flush()
                os.fsync(file.fileno())
                done[entry["trial"]] = entry
                if progress is not None:
                    progress(len(done) / len(trials))
    finally:
        seal.permit(folder)
    _rewrite(folder, done)
    seal.close(folder)


def answer(case: Case, diagnose: Diagnose, sealed: Path | None) -> dict[str, Any]:
    """One answer. What the diagnosis raises is noted as the answer: it counts as wrong.

    The process cannot open the labels in the folder `sealed`.
    """
    if sealed is not None:
        seal.forbid(sealed)
    begun = time.perf_counter()
    try:
        given = diagnose(case.runs, case.references, case.vehicle, seed=0).to_json()
        json.dumps(given, allow_nan=False)
        error = None
    except Exception as problem:
        given, error = None, f"{type(problem).__name__}: {problem}"
    seconds = round(time.perf_counter() - begun, 3)
    return {"trial": case.trial, "seconds": seconds, "error": error, "answer": given}


def ask_oracle(folder: Path, trials: Sequence[Trial], oracle: Diagnose, jobs: int) -> dict[str, float]:
    """Share of the gap that goes away where the diagnosis is told the true effects, by trial.

    Asked for trials whose answer tells a share itself, once the labels are open; `oracle.jsonl` keeps what
    is done. The oracle is called as the diagnosis, with `effects`, the names of the candidates.
    """
    told = {
        t
        for t, entry in answered(folder).items()
        if ((entry["answer"] or {}).get("shrink") or {}).get("share")
    }
    done = answered(folder, ORACLE)
    asked = [t for t in trials if t.trial in told and t.family in ("same", "shifted")]
    effects = {t.trial: t.effects() for t in asked}
    missing = [t for t in asked if t.trial not in done]
    with open_workers("loky", jobs) as pool, (folder / ORACLE).open("a", encoding="utf-8") as file:
        questions = ((c, functools.partial(oracle, effects=effects[c.trial]), None) for c in cases(missing))
        for entry in pool.results(answer, questions):
            done[entry["trial"]] = entry
            file.write(json.dumps(entry) + "\n")
            file.flush()
    shares = {t: ((entry["answer"] or {}).get("shrink") or {}).get("share") for t, entry in done.items()}
    return {t: float(share) for t, share in shares.items() if share is not None}


def _rewrite(folder: Path, entries: dict[str, dict[str, Any]]) -> None:
    lines = _lines(entries[name] for name in sorted(entries))
    write_atomically(folder / seal.ANSWERS, lambda part: part.write_text(lines, encoding="utf-8"))


def _lines(entries: Iterable[dict[str, Any]]) -> str:
    return "".join(json.dumps(entry) + "\n" for entry in entries)
