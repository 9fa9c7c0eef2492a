"""Fuzzing of readers, YAML files, the live API and the command line: does anything end in a defect?

    python -m tests.studies.fuzz --readers 4000 --yaml 2000 --live 2000 --cli 2000

Each case runs in a child process of its own, with 10 s and 1 GB of memory beyond what the parent has (the
live API: twenty cases a child). It may work or be refused by a known error in one line; "crash", "hang" and
"memory" are defects.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import resource
import shutil
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tests.datasets import fuzz as readers
from tests.datasets.fuzz_samples import write_samples

HANG_S, MEMORY_BYTES = 10, 1 << 30
OUTCOMES = {0: "worked", 1: "refused", 2: "crash", 3: "memory"}
DEFECTS = ("crash", "hang", "memory")
LIVE_BATCH = 20

Task = Callable[[], bool]
"""Does one case; False where it is refused."""


def outcome_of(task: Task, seconds: float = HANG_S) -> str:
    """A task in a child, limited in time and memory."""
    return readers.outcome_in_child(lambda: _in_child(task), seconds, OUTCOMES)


def _in_child(task: Task) -> int:
    now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (now + MEMORY_BYTES, now + MEMORY_BYTES))
    warnings.simplefilter("ignore")
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


def live_batch(seed: int) -> Task:
    """Some runs of the rule-based machine."""
    from hypothesis import HealthCheck, Phase, settings
    from hypothesis import seed as seeded
    from hypothesis.stateful import run_state_machine_as_test

    from tests.fusion.estimator.live_machine import LiveMachine

    def task() -> bool:
        run_state_machine_as_test(
            seeded(seed)(LiveMachine),
            settings=settings(
                max_examples=LIVE_BATCH, stateful_step_count=10, deadline=None, database=None,
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


def run(name: str, count: int, seed: int, scratch: Path, samples: list[Path]) -> Counter[str]:
    """Outcomes of `count` cases of one kind; defects are told as they come."""
    found: Counter[str] = Counter()
    step = LIVE_BATCH if name == "live" else 1
    for i in range(0, count, step):
        rng = np.random.default_rng([seed, i])
        folder = Path(tempfile.mkdtemp(dir=scratch, prefix=f"{name}-{i:05d}-"))
        if name == "live":
            outcome = outcome_of(live_batch(seed * 100_000 + i), HANG_S * LIVE_BATCH)
        elif name == "readers":
            path = readers.mutated(rng, samples[i % len(samples)], folder)
            outcome = readers.outcome_of(path, repair_clock=bool(rng.random() < 0.5))
            outcome = "worked" if outcome == "read" else outcome
        elif name == "yaml":
            outcome = outcome_of(yaml_case(rng, folder))
        else:
            outcome = outcome_of(cli_case(rng, samples[i % len(samples)], folder))
        found[outcome] += step
        if outcome in DEFECTS:
            print(f"{name} {i}: {outcome}", file=sys.stderr)
        else:
            shutil.rmtree(folder, ignore_errors=True)
    return found


def main() -> int:
    """Run and print one line a kind."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    for name in ("readers", "yaml", "live", "cli"):
        parser.add_argument(f"--{name}", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    scratch = Path(tempfile.mkdtemp(prefix="fuzz-"))
    sys.path.insert(0, str(Path(readers.__file__).parent))  # as the samples import their neighbours
    samples = write_samples(scratch / "samples")
    for sample in samples:  # in this process, so that every child starts with the parsers in memory
        readers.open_and_examine(sample / (sample / ".open").read_text(), repair_clock=False)
    cases = defects = 0
    for name in ("readers", "yaml", "live", "cli"):
        found = run(name, getattr(given, name), given.seed, scratch, samples)
        bad = sum(found[outcome] for outcome in DEFECTS)
        cases, defects = cases + sum(found.values()), defects + bad
        told = ", ".join(f"{outcome} {found[outcome]}" for outcome in (*OUTCOMES.values(), "hang"))
        print(f"{name:8s} {sum(found.values()):5d} cases: {told}", flush=True)
    print(f"all {cases} cases, defects {defects}")
    shutil.rmtree(scratch, ignore_errors=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
