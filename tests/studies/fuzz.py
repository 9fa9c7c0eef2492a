"""Fuzzing of readers, YAML files, the live API and the command line: does anything end in a defect?

    python -m tests.studies.fuzz --readers 4000 --yaml 2000 --live 2000 --cli 2000 --out OUT

Case i of a kind is the same in every run. Cases run one after the other in child processes, each with 10 s
of processor time and 1 GB of memory beyond what the child has. A case may work or be refused by a known error
in one line; "crash", "hang" and "memory" are defects: they are tried again in a child of their own, and what
they read is kept in OUT. A run goes on where one was stopped.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.datasets import fuzz as readers
from tests.datasets.fuzz_samples import write_samples

KINDS = ("readers", "yaml", "live", "cli")
HANG_S, WAITS_S, BATCH = 10.0, 120.0, 25
"""Processor time, and time in all, after which a case hangs: a busy machine makes nothing slow."""
OUTCOMES = {0: "worked", 1: "refused", 2: "crash", 3: "memory"}
DEFECTS = ("crash", "hang", "memory")

Task = Callable[[], bool]
"""Does one case; False where it is refused."""


def status_of(task: Task) -> int:
    """Exit status of a case: a key of `OUTCOMES`."""
    warnings.simplefilter("ignore")
    readers.limit_memory()
    try:
        return 0 if task() else 1
    except MemoryError:
        return 3
    except BaseException:
        traceback.print_exc()
        return 2


# --- YAML ------------------------------------------------------------------------------------------------

ODD_YAML = (
    b"<<: [*m, *m]", b"&a [*a]", b"!!python/object/apply:os.system [id]", b"{" * 500, b"- " * 500,
    b"? ", b"\t",
    b"x: &x {y: *x}", b"1e999", b".nan", b"-.inf", b"9" * 20_000, b"\xff\xfe", b"\x1b[31m", b"null", b"[]",
    b"{}",
    b"'", b"|", b"---\n---", b"0x7fffffffffffffff", b"2024-01-01", b"yes", b"\xed\xa0\x80",
    b"%TAG ! x", b": :",
)  # fmt: skip


def mangled_yaml(rng: np.random.Generator, data: bytes) -> bytes:
    """A YAML text with odd values, keys and lines in it."""
    lines = data.split(b"\n")
    for _ in range(int(rng.integers(1, 4))):
        at, odd = int(rng.integers(len(lines))), ODD_YAML[int(rng.integers(len(ODD_YAML)))]
        kind = rng.integers(5)
        if kind == 0 and b":" in lines[at]:
            lines[at] = lines[at].split(b":")[0] + b": " + odd
        elif kind == 1:
            lines.insert(at, odd)
        elif kind == 2:
            lines[at] = b"    " + lines[at]
        elif kind == 3:
            lines[at : at + 1] = [lines[at]] * 2
        else:
            kinds = readers.TEXT
            return kinds[int(rng.integers(len(kinds)))](rng, b"\n".join(lines))
    return b"\n".join(lines)


def yaml_case(rng: np.random.Generator, scratch: Path) -> Task:
    """A shipped vehicle, soil, scenario, policy or terrain model, mangled."""
    from terrafusion.datasets.core.errors import TerrafusionError
    from terrafusion.fusion.noise.policy import load_policy
    from terrafusion.twin.model.vehicle import load_vehicle
    from terrafusion.twin.scenario.file import load_scenario

    root = Path(__file__).parents[2]
    kinds: list[tuple[str, Callable[[Path], object]]] = [
        ("twin/params/vehicles", load_vehicle),
        ("twin/params/scenarios", load_scenario),
        ("fusion/noise", load_policy),
    ]
    folder, load = kinds[int(rng.integers(len(kinds)))]
    files = sorted((root / folder).glob("*.yaml"))
    source = files[int(rng.integers(len(files)))]
    target = scratch / source.name
    target.write_bytes(mangled_yaml(rng, source.read_bytes()))

    def task() -> bool:
        refused = ""
        try:
            load(target)
        except TerrafusionError as error:
            refused = str(error)
        assert max(map(len, refused.split("\n"))) < 1500, "not a short line"
        return not refused

    return task


# --- live API --------------------------------------------------------------------------------------------


def live_batch(seed: int, runs: int) -> Task:
    """Some runs of the rule-based machine."""
    from hypothesis import HealthCheck, Phase, settings
    from hypothesis import seed as seeded
    from hypothesis.stateful import run_state_machine_as_test

    from tests.fusion.estimator.live_machine import LiveMachine

    def task() -> bool:
        run_state_machine_as_test(
            seeded(seed)(LiveMachine),
            settings=settings(
                max_examples=runs, stateful_step_count=10, deadline=None, database=None,
                derandomize=False, phases=[Phase.generate], suppress_health_check=list(HealthCheck),
            ),
        )  # fmt: skip
        return True

    return task


# --- command line ----------------------------------------------------------------------------------------

COMMANDS = (
    "inspect",
    "replay",
    "convert",
    "calibrate",
    "simulate",
    "fetch",
    "gap",
    "sweep",
    "policy",
    "init",
)
WORDS = (
    "--out", "--mode", "--vehicle", "--batch", "--gnss-outage", "--seed", "--terrain", "--slope-deg",
    "--help",
    "--payload-kg", "--reference", "--jobs", "--repair-clock", "--apply-fixes", "--topic", "--nonsense", "--",
    "adaptive", "fixed", "5:10", "-5:nan", "1e999:1", "husky", "straight", "mud", "nan", "-1", "1e308", "",
    "/dev/null", "/nowhere/x", "\x1b[31m", "\udcff", "a" * 5000, "..", ".", "*", "%s", "{x}", "\n", "café",
)  # fmt: skip


def cli_case(rng: np.random.Generator, sample: Path, scratch: Path) -> Task:
    """A command with words in any order, mostly on a mutated log."""
    from terrafusion.fusion.cli.main import main

    log = readers.mutated(rng, sample, scratch)
    command = (
        str(rng.choice(["inspect", "replay", "convert"])) if rng.random() < 0.6 else str(rng.choice(COMMANDS))
    )
    words = [WORDS[int(rng.integers(len(WORDS)))] for _ in range(int(rng.integers(0, 5)))]
    if rng.random() < 0.8:
        words.insert(0, str(log))
    if command in ("replay", "simulate", "convert") and rng.random() < 0.7:
        words = (
            [str(log), "--out", str(scratch / "out")]
            if command != "convert"
            else [str(log), str(scratch / "o")]
        )

    def task() -> bool:
        os.chdir(scratch)
        sys.argv = ["terrafusion", command, *words]
        out, err, status = io.StringIO(), io.StringIO(), 0
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            try:
                main()
            except SystemExit as end:
                status = int(end.code or 0)
        assert status in (0, 1, 2), (command, words, status)
        assert "Traceback" not in err.getvalue(), (command, words, err.getvalue()[-2000:])
        assert "\x1b[31m" not in out.getvalue() + err.getvalue(), (command, words)
        if status == 1:
            assert err.getvalue().startswith("error: "), (command, words, err.getvalue()[:300])
        return status == 0

    return task


# --- the run ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Fuzzer:
    """Cases of all kinds, by a seed."""

    seed: int
    scratch: Path
    samples: list[Path]

    def status(self, kind: str, i: int) -> int:
        """The outcome of a case, in this process."""
        rng, folder = np.random.default_rng([self.seed, i]), self.folder(kind, i)
        folder.mkdir(parents=True, exist_ok=True)
        sample = self.samples[i % len(self.samples)]
        if kind == "live":
            return status_of(live_batch(self.seed * 100_000 + i, 1))
        if kind == "yaml":
            return status_of(yaml_case(rng, folder))
        if kind == "cli":
            return status_of(cli_case(rng, sample, folder))
        readers.limit_memory()
        path = readers.mutated(rng, sample, folder)
        return readers.examined(path, repair_clock=bool(rng.random() < 0.5))

    def folder(self, kind: str, i: int) -> Path:
        """Where a case keeps its files."""
        return self.scratch / f"{kind}-{i:05d}"

    def outcomes(self, kind: str, cases: list[int]) -> dict[int, str]:
        """Outcomes of cases; those of defects by themselves."""
        found: dict[int, str] = {}
        while rest := [i for i in cases if i not in found]:
            found |= self._in_one_child(kind, rest)
        for i, outcome in found.items():
            if outcome in DEFECTS and len(cases) > 1:
                found[i] = self.outcomes(kind, [i])[i]
        return found

    def _in_one_child(self, kind: str, cases: list[int]) -> dict[int, str]:
        """Outcomes of the first cases, up to the end of all, or to one that ends the child or hangs."""
        told = self.scratch / "told"
        told.write_bytes(b"")
        child = os.fork()
        if child == 0:
            for i in cases:
                status = self.status(kind, i)
                with told.open("ab") as file:
                    file.write(bytes([status]))
            os._exit(0)
        count, since, since_cpu_s, ended = 0, time.monotonic(), 0.0, False
        while not ended:
            ended, cpu_s = bool(os.waitpid(child, os.WNOHANG)[0]), readers.cpu_s(child)
            if (size := told.stat().st_size) > count:
                count, since, since_cpu_s = size, time.monotonic(), cpu_s
            if cpu_s > since_cpu_s + HANG_S or time.monotonic() > since + WAITS_S:
                break
            time.sleep(0.005)
        if not ended:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
        found = {i: OUTCOMES[status] for i, status in zip(cases, told.read_bytes(), strict=False)}
        if len(found) < len(cases):
            found[cases[len(found)]] = "crash" if ended else "hang"
        return found


def run(fuzzer: Fuzzer, kind: str, count: int, kept: Path, until: float) -> Counter[str]:
    """Outcomes of `count` cases of one kind, as far as time allows; what is in `kept` is not done again."""
    file, total = kept / "outcomes.jsonl", Counter[str]()
    rows = [json.loads(line) for line in file.read_text().splitlines()] if file.is_file() else []
    done = {
        row["first"]: row["outcomes"] for row in rows if (row["kind"], row["seed"]) == (kind, fuzzer.seed)
    }
    for first in range(0, count, BATCH):
        if first not in done and time.monotonic() < until:
            found = fuzzer.outcomes(kind, list(range(first, min(first + BATCH, count))))
            for i, outcome in found.items():
                if outcome in DEFECTS:
                    print(f"{kind} {i}: {outcome}", file=sys.stderr, flush=True)
                    shutil.copytree(fuzzer.folder(kind, i), kept / f"{kind}-{i:05d}", dirs_exist_ok=True)
                shutil.rmtree(fuzzer.folder(kind, i), ignore_errors=True)
            done[first] = Counter(found.values())
            with file.open("a") as out:
                row = {"kind": kind, "seed": fuzzer.seed, "first": first, "outcomes": done[first]}
                out.write(json.dumps(row) + "\n")
        total.update(done.get(first, {}))
    return total


def main() -> int:
    """Run and print one line a kind."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    for name in KINDS:
        parser.add_argument(f"--{name}", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=7200.0, help="stop after so long")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    scratch, until = Path(tempfile.mkdtemp(prefix="fuzz-")), time.monotonic() + given.seconds
    sys.path.insert(0, str(Path(readers.__file__).parent))  # as the samples import their neighbours
    samples = write_samples(scratch / "samples")
    for sample in samples:  # in this process, so that every child starts with the parsers in memory
        readers.open_and_examine(sample / (sample / ".open").read_text(), repair_clock=False)
    fuzzer, cases, defects = Fuzzer(given.seed, scratch, samples), 0, 0
    for name in KINDS:
        found = run(fuzzer, name, getattr(given, name), given.out.absolute(), until)
        cases, defects = cases + sum(found.values()), defects + sum(found[outcome] for outcome in DEFECTS)
        told = ", ".join(f"{outcome} {found[outcome]}" for outcome in (*OUTCOMES.values(), "hang"))
        print(f"{name:8s} {sum(found.values()):5d} cases: {told}", flush=True)
    print(f"all {cases} cases, defects {defects}")
    shutil.rmtree(scratch, ignore_errors=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
