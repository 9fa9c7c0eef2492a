"""Trials given to a diagnosis and its opponent, and their answers: one file a trial."""

import dataclasses
import functools
import json
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from terrafusion.datasets.core.files import write_atomically
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.executors import open_workers
from terrafusion.twin.gap.blind import seal
from terrafusion.twin.gap.blind.plan import RUNS, VEHICLE, Trial, specs
from terrafusion.twin.model.vehicle import VehicleParams, load_vehicle

ORACLE = "oracle"
DIAGNOSIS, OPPONENT = "diagnosis", "opponent"
LANES = 160  # runs of the plant in one batch (about 5 MB each)


Diagnose = Callable[..., Any]
"""diagnose(runs, references, vehicle, *, seed): its `to_json` keeps to `diagnosis.schema.json`."""


@dataclass(frozen=True)
class Pool:
    """Where answers are computed: `backend` and `address` as for `executors.open_workers`; `jobs` trials at
    once."""

    jobs: int = 1
    backend: str = "loky"
    address: str | None = None


@dataclass(frozen=True, eq=False)
class BlindCase:
    """A trial as a diagnosis gets it: nothing of the truth."""

    trial: str
    runs: tuple[Recording, ...]
    references: tuple[Recording, ...]
    vehicle: VehicleParams


def cases(trials: Sequence[Trial]) -> Iterator[BlindCase]:
    """The trials' recordings, simulated lazily."""
    vehicle, block = load_vehicle(VEHICLE), list[Trial]()
    for trial in trials:
        if sum(RUNS + t.references for t in (*block, trial)) > LANES:
            yield from _simulated(block, vehicle)
            block = []
        block.append(trial)
    yield from _simulated(block, vehicle)


def _simulated(block: Sequence[Trial], vehicle: VehicleParams) -> Iterator[BlindCase]:
    """Trials whose runs are computed together, those of equal length in one batch."""
    from terrafusion.twin.gap.blind.plant.run import record

    wanted = [spec for trial in block for spec in specs(trial)]
    names = [f"run-{i + 1}" for i in range(RUNS)]
    names = [n for t in block for n in (*names, *(f"reference-{i + 1}" for i in range(t.references)))]
    made: dict[int, Recording] = {}
    for seconds in dict.fromkeys(spec.duration_s() for spec in wanted):
        some = [i for i, spec in enumerate(wanted) if spec.duration_s() == seconds]
        made |= zip(some, record([wanted[i] for i in some], names=[names[i] for i in some]), strict=True)
    first = 0
    for trial in block:
        split, end = first + RUNS, first + RUNS + trial.references
        runs, references = (
            tuple(made.pop(i) for i in range(*ends)) for ends in ((first, split), (split, end))
        )
        yield BlindCase(trial.trial, runs, references, vehicle)
        first = end


def answered(folder: Path, name: str = seal.ANSWERS) -> dict[str, dict[str, Any]]:
    """Stored answers by trial."""
    return {path.stem: json.loads(path.read_text("utf-8")) for path in sorted((folder / name).glob("*.json"))}


def answer_all(
    folder: Path,
    trials: Sequence[Trial],
    methods: Mapping[str, Diagnose],
    pool: Pool,
    progress: Callable[[float], None] | None = None,
    minutes: float = math.inf,
) -> None:
    """Answers of all `methods` to the trials that have none yet, until all are stored, or for so many
    minutes.

    Raises:
        DataError: an answer cannot be written.
    """
    until_s, done = time.monotonic() + 60.0 * minutes, {*answered(folder)}
    questions = ((case, methods) for case in cases([t for t in trials if t.trial not in done]))
    for entry in _stored(folder / seal.ANSWERS, questions, pool):
        done.add(entry["trial"])
        if progress is not None:
            progress(len(done) / len(trials))
        if time.monotonic() > until_s:
            break


def _stored(folder: Path, questions: Iterator[tuple[Any, ...]], pool: Pool) -> Iterator[dict[str, Any]]:
    """Entries as they come, each written to the folder."""
    with open_workers(pool.backend, pool.jobs, pool.address) as found:
        # Recordings are large: no more of them at once than are worked on soon.
        workers = dataclasses.replace(found, at_once=found.at_once or 2 * pool.jobs)
        for entry in workers.results(answer, questions):
            write = functools.partial(Path.write_text, data=json.dumps(entry))
            write_atomically(folder / f"{entry['trial']}.json", write)
            yield entry


def answer(case: BlindCase, methods: Mapping[str, Diagnose]) -> dict[str, Any]:
    """Answers of all methods: {"trial", method: {"seconds", "error", "answer"}}. An exception is recorded: it
    counts as wrong."""
    return {"trial": case.trial, **{name: _answer(case, method) for name, method in methods.items()}}


def _answer(case: BlindCase, method: Diagnose) -> dict[str, Any]:
    begun = time.process_time()
    try:
        given = method(case.runs, case.references, case.vehicle, seed=0).to_json()
        json.dumps(given, allow_nan=False)
        error = None
    except Exception as problem:
        given, error = None, f"{type(problem).__name__}: {problem}"
    return {"seconds": round(time.process_time() - begun, 3), "error": error, "answer": given}


def ask_oracle(folder: Path, trials: Sequence[Trial], oracle: Diagnose, pool: Pool) -> dict[str, float]:
    """Share of the gap that disappears where the diagnosis is given the true effects, by trial.

    For single effects whose answer has a share, once the labels are open; the folder `oracle` stores them.
    The oracle is called as the diagnosis, with `effects`, the names of the candidates.
    """
    with_share = {t for t, entry in answered(folder).items() if _share(entry) is not None}
    asked = {t.trial: t for t in trials if t.trial in with_share and t.family in ("same", "shifted")}
    missing = [t for name, t in asked.items() if name not in answered(folder, ORACLE)]
    questions = (
        (case, {DIAGNOSIS: functools.partial(oracle, effects=asked[case.trial].effects())})
        for case in cases(missing)
    )
    for _ in _stored(folder / ORACLE, questions, pool):
        pass
    shares = {t: _share(entry) for t, entry in answered(folder, ORACLE).items()}
    return {t: float(share) for t, share in shares.items() if share is not None}


def _share(entry: Mapping[str, Any]) -> float | None:
    return ((entry[DIAGNOSIS]["answer"] or {}).get("shrink") or {}).get("share")
