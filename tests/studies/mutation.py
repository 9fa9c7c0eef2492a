"""Do the tests notice when a number or an operator of the core is changed?

    python -m tests.studies.mutation --mutants 40 --out OUT

A mutant is a module with one change: a comparison, an operator, a sign or a number. They are drawn at random
with a seed; each is imported in a child process in place of the module, and the tests of that module are run
until one fails. A mutant that none notices survives, and is printed with its line.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import importlib
import importlib.abc
import importlib.util
import io
import json
import os
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from tests.datasets.fuzz import cpu_s

ROOT = Path(__file__).parents[2]
GRAPH = ("tests/fusion/graph/test_chain.py", "tests/fusion/graph/test_batch.py")
PHYSICS = ("tests/twin/physics/test_wheel.py", "tests/twin/physics/test_terramechanics.py")
WEIGHTS = ("tests/fusion/weighting/test_weights.py",)
MODES = "tests/fusion/weighting/test_modes.py::"
TARGETS = {
    "fusion/graph/wheel_factor.py": (*GRAPH, "tests/fusion/graph/test_wheel_factor.py"),
    "fusion/graph/gnss_factor.py": (*GRAPH, "tests/fusion/graph/test_gnss_factor.py"),
    "fusion/graph/slow_states.py": (*GRAPH, "tests/fusion/graph/test_slow_states.py"),
    "fusion/graph/chain.py": GRAPH,
    "twin/physics/wheel.py": PHYSICS,
    "twin/physics/terramechanics.py": PHYSICS,
    "fusion/metrics/consistency.py": ("tests/fusion/metrics/test_consistency.py",),
    "fusion/metrics/error_series.py": ("tests/fusion/metrics/test_scores.py",),
    "fusion/metrics/scores.py": ("tests/fusion/metrics/test_scores.py",),
    "fusion/metrics/verdict.py": ("tests/fusion/metrics/test_verdict.py",),
    "fusion/metrics/verdict_of_numbers.py": ("tests/fusion/metrics/test_verdict.py",),
    "fusion/weighting/weighting.py": WEIGHTS,
    "fusion/weighting/innovation.py": WEIGHTS,
    "fusion/weighting/robust.py": WEIGHTS,
    "fusion/weighting/driven_slip.py": ("tests/fusion/weighting/test_driven_slip.py",),
    "fusion/weighting/adaptive.py": (
        "tests/fusion/weighting/test_terrain_noise.py",
        f"{MODES}test_a_robot_the_model_does_not_know_has_the_pooled_noise_until_evidence_comes",
        f"{MODES}test_a_label_of_a_ground_is_taken_as_it_is_on_any_robot",
    ),
    "fusion/calibration/online.py": ("tests/fusion/calibration/test_online.py",),
    "fusion/estimator/skid.py": ("tests/fusion/estimator/test_skid_rules.py",),
    "datasets/checks/delays.py": (
        "tests/datasets/checks/test_delay_rules.py",
        "tests/datasets/checks/test_timing.py",
    ),
    "datasets/checks/scale.py": (
        "tests/datasets/checks/test_scale_rules.py",
        "tests/datasets/checks/test_physical_faults.py",
    ),
    "fusion/calibration/slip.py": ("tests/fusion/calibration/test_slip.py",),
    "fusion/estimator/learned_numbers.py": (
        "tests/fusion/estimator/test_learned_doubt.py",
        "tests/fusion/outputs/test_learned_numbers.py",
    ),
    "fusion/inputs/validation.py": ("tests/fusion/inputs/test_validation.py",),
    "fusion/inputs/time_jumps.py": ("tests/fusion/inputs/test_time_jumps.py",),
    "fusion/inputs/gyro_unit.py": ("tests/fusion/inputs/test_gyro_unit.py",),
    "twin/gap/infer/single_effects.py": ("tests/twin/gap/infer/test_single_effects.py",),
    "twin/gap/infer/predictive.py": ("tests/twin/gap/infer/test_predictive.py",),
    "twin/gap/infer/detection.py": ("tests/twin/gap/infer/test_other_drives.py",),
    "twin/gap/infer/other_drives.py": ("tests/twin/gap/infer/test_other_drives.py",),
}  # fmt: skip
LONGEST_CPU_S, LONGEST_S = 120.0, 900.0
HEAVY = ("gtsam", "scipy.stats", "scipy.optimize", "hypothesis")
"""What tests import beside the library; it is in memory before the first child starts."""
PAIRS = (
    (ast.Add, ast.Sub), (ast.Mult, ast.Div), (ast.Lt, ast.GtE), (ast.LtE, ast.Gt), (ast.Eq, ast.NotEq),
    (ast.And, ast.Or), (ast.Is, ast.IsNot),
)  # fmt: skip
SWAPPED: dict[type, type] = {a: b for pair in PAIRS for a, b in (pair, pair[::-1])}


def places(tree: ast.AST) -> Iterator[tuple[ast.AST, str]]:
    """Nodes that can be changed, and which change."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Compare) and type(node.ops[0]) in SWAPPED:
            yield node, "comparison"
        elif isinstance(node, (ast.BinOp, ast.BoolOp)) and type(node.op) in SWAPPED:
            yield node, "operator"
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.USub, ast.Not)):
            yield node, "sign"
        elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
            yield node, "number"


def mutant(source: str, number: int) -> tuple[str, int, str]:
    """The source with its change `number`, the line, and the line as it becomes."""
    tree = ast.parse(source)
    node, kind = list(places(tree))[number]
    if kind == "comparison":
        assert isinstance(node, ast.Compare)
        node.ops[0] = SWAPPED[type(node.ops[0])]()
    elif kind == "operator":
        assert isinstance(node, (ast.BinOp, ast.BoolOp))
        node.op = SWAPPED[type(node.op)]()  # type: ignore[assignment]
    elif kind == "sign":
        assert isinstance(node, ast.UnaryOp)
        node.op = ast.UAdd() if isinstance(node.op, ast.USub) else ast.Not()
        if isinstance(node.op, ast.Not):
            node.operand = ast.UnaryOp(ast.Not(), node.operand)
    else:
        assert isinstance(node, ast.Constant)
        node.value = node.value + 1 if type(node.value) is int else node.value * 2.0 + 0.1
    ast.fix_missing_locations(tree)
    return ast.unparse(tree), node.lineno, ast.unparse(node)  # type: ignore[attr-defined]


class _Mutated(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports one module from another source."""

    def __init__(self, name: str, source: str, file: Path) -> None:
        self.name, self.source, self.file = name, source, file

    def find_spec(self, name: str, path: object, target: object = None) -> object:
        if name != self.name:
            return None
        return importlib.util.spec_from_loader(name, self, origin=str(self.file))

    def exec_module(self, module: ModuleType) -> None:
        module.__file__ = str(self.file)
        exec(compile(self.source, str(self.file), "exec"), module.__dict__)


def outcome(target: str, source: str, tests: Sequence[str]) -> str:
    """ "killed", "survived" or "hangs" (which is noticed, too).

    A mutated twin is compiled for itself: the cache takes its library for that of the sources on the disk.
    """
    with tempfile.TemporaryDirectory() as cache:
        return _outcome(target, source, tests, cache if target.startswith("twin/") else None)


def _outcome(target: str, source: str, tests: Sequence[str], cache: str | None) -> str:
    child = os.fork()
    if child == 0:
        status = 70
        try:
            if cache is not None:
                os.environ["TERRAFUSION_CACHE"] = cache
            name = "terrafusion." + target.removesuffix(".py").replace("/", ".")
            for loaded in [one for one in sys.modules if one.startswith(("terrafusion.", "tests."))]:
                del sys.modules[loaded]
            sys.meta_path.insert(0, _Mutated(name, source, ROOT / target))
            with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
                quiet = ["-W", "ignore::pytest.PytestAssertRewriteWarning", "-p", "no:cacheprovider"]
                arguments = ["-q", "-x", *quiet, *(str(ROOT / test) for test in tests)]
                status = int(pytest.main(arguments))
        finally:
            os._exit(status)
    until = time.monotonic() + LONGEST_S
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            code = os.waitstatus_to_exitcode(status)
            if code > 2:  # neither tests that fail nor modules that cannot be imported
                raise RuntimeError(f"{target}: pytest ended with {code}")
            return "survived" if code == 0 else "killed"
        if cpu_s(child) > LONGEST_CPU_S or time.monotonic() > until:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return "hangs"
        time.sleep(0.02)


def run(count: int, seed: int, out: Path, targets: Sequence[str], seconds: float) -> list[dict[str, object]]:
    """Try `count` mutants of each target, as far as time allows; what is in `out` is not done again."""
    until = time.monotonic() + seconds
    out.mkdir(parents=True, exist_ok=True)
    file = out / "mutants.jsonl"
    rows = [json.loads(line) for line in file.read_text().splitlines()] if file.is_file() else []
    done = {(row["target"], row["number"]) for row in rows}
    # One of each target, then the next of each: a run that is stopped has tried all targets alike.
    drawn = [
        (target, i, number) for target in targets for i, number in enumerate(sample(target, count, seed))
    ]
    for target, _, number in sorted(drawn, key=lambda one: one[1]):
        if (target, number) in done or time.monotonic() > until:
            continue
        changed, line, becomes = mutant((ROOT / target).read_text(encoding="utf-8"), number)
        row = {"target": target, "number": number, "line": line, "becomes": becomes}
        row["outcome"] = outcome(target, changed, TARGETS[target])
        rows.append(row)
        with file.open("a", encoding="utf-8") as kept:
            kept.write(json.dumps(row) + "\n")
    return rows


def sample(target: str, count: int, seed: int) -> list[int]:
    """Numbers of the mutants of a target that are tried."""
    total = len(list(places(ast.parse((ROOT / target).read_text(encoding="utf-8")))))
    found: list[int] = np.random.default_rng(seed).permutation(total)[:count].tolist()
    return found


def main() -> None:
    """Print the score of each module, and what survived."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--mutants", type=int, default=40, help="of each module")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=7200.0, help="stop after so long")
    parser.add_argument("--targets", nargs="*", default=list(TARGETS))
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    os.environ.setdefault("MPLBACKEND", "Agg")
    for name in HEAVY:
        importlib.import_module(name)
    rows = run(given.mutants, given.seed, given.out, given.targets, given.seconds)
    print("| module | mutants | noticed | survived |\n| --- | --- | --- | --- |")
    for target in given.targets:
        count = Counter(row["outcome"] for row in rows if row["target"] == target)
        alive = count["survived"]
        print(f"| {target} | {count.total()} | {count.total() - alive} | {alive} |")
    survived = [row for row in rows if row["outcome"] == "survived"]
    print(f"\nmutants {len(rows)}, noticed {len(rows) - len(survived)}, seed {given.seed}\n")
    for row in survived:
        print(f"- {row['target']}:{row['line']} becomes `{row['becomes']}`")


if __name__ == "__main__":
    main()
