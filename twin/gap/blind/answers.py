"""Trials given to a diagnosis, and its answers: one line of JSON a trial, written at once."""

from __future__ import annotations

import functools
import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
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
LANES = 160  # runs of the plant in one batch (about 5 MB each)


class Answer(Protocol):
    """Result of a diagnosis."""

    def to_json(self) -> dict[str, Any]:
        """Keeps to `diagnosis.schema.json`."""


Diagnose = Callable[..., Answer]  # diagnose(runs, references, vehicle, *, seed) -> Answer


@dataclass(frozen=True, eq=False)
class BlindCase:
    """A trial as a diagnosis gets it: nothing of the truth."""

    trial: str
    runs: tuple[Recording, ...]
    references: tuple[Recording, ...]
    vehicle: VehicleParams


def cases(trials: Sequence[Trial]) -> Iterator[BlindCase]:
    """The trials' recordings, simulated lazily."""
    from terrafusion.twin.gap.blind.plant.run import record

    vehicle = load_vehicle(VEHICLE)
    for block in _blocks(trials):
        many, names = [spec for trial in block for spec in specs(trial)], list[str]()
        for trial in block:
            names += [f"run-{i + 1}" for i in range(trial.runs)]
            names += [f"reference-{i + 1}" for i in range(trial.references)]
        recordings = iter(record(many, names=names))
        for trial in block:
            runs = tuple(next(recordings) for _ in range(trial.runs))
            references = tuple(next(recordings) for _ in range(trial.references))
            yield BlindCase(trial.trial, runs, references, vehicle)


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
    """Stored answers by trial; a truncated line does not count."""
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
    """Diagnoses the trials that have no answer yet; closes the answers when all are stored."""
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


def answer(case: BlindCase, diagnose: Diagnose, sealed: Path | None) -> dict[str, Any]:
    """One answer. An exception of the diagnosis is recorded: it counts as wrong.

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
    """Share of the gap that disappears where the diagnosis is given the true effects, by trial.

    For trials whose answer has a share, once the labels are open; `oracle.jsonl` stores the results. The
    oracle is called as the diagnosis, with `effects`, the names of the candidates.
    """
    with_share = {t for t, entry in answered(folder).items() if _share(entry)}
    done = answered(folder, ORACLE)
    asked = [t for t in trials if t.trial in with_share and t.family in ("same", "shifted")]
    effects = {t.trial: t.effects() for t in asked}
    missing = [t for t in asked if t.trial not in done]
    with open_workers("loky", jobs) as pool, (folder / ORACLE).open("a", encoding="utf-8") as file:
        questions = ((c, functools.partial(oracle, effects=effects[c.trial]), None) for c in cases(missing))
        for entry in pool.results(answer, questions):
            done[entry["trial"]] = entry
            file.write(json.dumps(entry) + "\n")
            file.flush()
    shares = {t: _share(entry) for t, entry in done.items()}
    return {t: float(share) for t, share in shares.items() if share is not None}


def _share(entry: dict[str, Any]) -> float | None:
    return ((entry["answer"] or {}).get("shrink") or {}).get("share")


def _rewrite(folder: Path, entries: dict[str, dict[str, Any]]) -> None:
    lines = "".join(json.dumps(entries[name]) + "\n" for name in sorted(entries))
    write_atomically(folder / seal.ANSWERS, lambda part: part.write_text(lines, encoding="utf-8"))
