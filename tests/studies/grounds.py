"""Errors in outages of adaptive over fixed weights on one robot, and whether memory knows its grounds.

Fixes of 0.1 m are simulated from the truth; outages are cut from the judge runs of `ground_split.yaml`. The
ratio is the geometric mean over outages of (error + 5 cm) over that of mode "fixed"; its interval is a
bootstrap over runs, and a group of grounds counts each ground alike. The memory is learned on the learn runs
one after another, without labels, and asked on the judge runs; a remembered ground counts as the label on
which it was met most.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from terrafusion.datasets.core.bootstrap import percentile_interval
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.yaml_file import read_yaml
from terrafusion.fusion.benchmark.outage_plan import aided_by_truth
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.grounds.memory import GroundMemory
from terrafusion.fusion.metrics.health import rolled_until_m
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.replay import replay
from terrafusion.twin.model.choose import choose_vehicle
from tests.studies.field_runs import read_runs
from tests.studies.parts import TaskWorkers, add_options, answers

SPLIT = Path(__file__).with_name("ground_split.yaml")
SLIPPING, FIRM = ("ice", "loose_sand", "gravel", "grass"), ("asphalt",)
FLOOR_M, LEAST_M, LONG_S = 0.05, 3.0, 150.0
"""Added to errors; least path of the wheels in an outage; runs this long have outages of 30 s, else 15."""
DRAWS = 2000
MODES = ("fixed", "adaptive")


@dataclass(frozen=True)
class Row:
    """One outage: errors (m) at its end by mode."""

    ground: str
    run: str
    start_s: float
    errors_m: dict[str, float]


def runs_of(robot: str, part: str, only: str = "") -> Iterator[tuple[str, str, Recording]]:
    """Ground, name and recording of the runs of a robot to "learn" from or "judge", or of one log alone."""
    for ground, names in read_yaml(SPLIT)[robot][part].items():
        for name in names:
            log, _, number = str(name).partition("#")
            if only and only.partition("#")[0] != log:
                continue
            for k, run in enumerate(read_runs(log)[0]):
                if not number or int(number) == k:
                    yield str(ground), f"{log}#{k}", aided_by_truth(run, 1)


def recognised(run: Recording, memory: GroundMemory) -> tuple[GroundMemory, Counter[str]]:
    """The memory after a run, and how many keyframes it took for each of its grounds ("" for a new one)."""
    seen: Counter[str] = Counter()

    def watch(estimator: Estimator) -> None:
        learner = estimator.weights.grounds
        assert learner is not None
        best = int(learner.memory.belief.argmax())
        seen[learner.memory.grounds[best - 1].name if best else ""] += 1

    after = replay(run, grounds=memory, watch=watch).grounds
    assert after is not None
    return after, seen


def learned(robot: str) -> tuple[GroundMemory, dict[str, str]]:
    """Memory after all learn runs of a robot, and the label on which each of its grounds was met most."""
    memory, met = GroundMemory(robot=robot), dict[str, Counter[str]]()
    for label, name, run in runs_of(robot, "learn"):
        memory, seen = recognised(run, memory)
        for ground, keyframes in seen.items():
            met.setdefault(ground, Counter())[label] += keyframes
        print(f"learned {name}: {len(memory)} grounds", flush=True)
    return memory, {ground: labels.most_common(1)[0][0] for ground, labels in met.items() if ground}


def knowledge(robot: str) -> None:
    """Print which share of the judge runs the memory takes for their label, for another, for new."""
    memory, label_of = learned(robot)
    found: dict[str, Counter[str]] = {}
    for label, _, run in runs_of(robot, "judge"):
        _, seen = recognised(run, memory)
        for ground, keyframes in seen.items():
            answer = "new" if ground not in label_of else "right" if label_of[ground] == label else "wrong"
            found.setdefault(label, Counter())[answer] += keyframes
    for label, counts in found.items():
        shares = ", ".join(
            f"{a} {100.0 * counts[a] / counts.total():.0f} %" for a in ("right", "wrong", "new")
        )
        print(f"memory on {label}: {shares}")


def passes(run: Recording) -> list[list[Outage]]:
    """Outages of a run: half of the time after a lead, the other half in a second pass for short runs."""
    duration = run.duration_s()
    lead, seconds = max(12.0, min(40.0, 0.3 * duration)), 30.0 if duration > LONG_S else 15.0
    if duration < lead + seconds + 1.0:
        seconds = 10.0
    assert run.wheels is not None
    rolled = rolled_until_m(run.wheels, choose_vehicle(run, None)[0].rig().wheel_radius_m)
    out = []
    for offset in (0.0,) if duration > LONG_S else (0.0, seconds):
        starts = np.arange(lead + offset, duration - seconds - 1.0, 2.0 * seconds).tolist()
        found = [Outage(round(s, 3), seconds) for s in starts]
        inside = [rolled[o.covers(run.wheels.t_ns, run.start_ns)] for o in found]
        out.append([o for o, r in zip(found, inside, strict=True) if len(r) and np.ptp(r) >= LEAST_M])
    return [outages for outages in out if outages]


def errors_of(run: tuple[str, str]) -> list[tuple[float, dict[str, float]]]:
    """Start and errors by mode of every outage of a run: robot and name of the run."""
    robot, name = run
    recording = next(one for _, called, one in runs_of(robot, "judge", name) if called == name)
    found = []
    for outages in passes(recording):
        errors: dict[float, dict[str, float]] = {}
        for mode in MODES:
            result = replay(recording, mode=mode, outages=outages)
            for outage, held_out in zip(outages, result.scores.outages, strict=True):
                if held_out.end_error_m is not None:
                    errors.setdefault(outage.start_s, {})[mode] = held_out.end_error_m
        found += list(errors.items())
    return found


def judged(robot: str, workers: TaskWorkers, out: Path | None) -> list[Row]:
    """Rows of all judge runs of a robot."""
    runs = [(ground, name) for ground, name, _ in runs_of(robot, "judge")]
    found = answers([(robot, name) for _, name in runs], errors_of, workers, out)
    return [
        Row(ground, name, start_s, errors)
        for (ground, name), rows in zip(runs, found, strict=True)
        for start_s, errors in rows
    ]


def ratio(rows: list[Row], grounds: tuple[str, ...]) -> tuple[float, float, float]:
    """Ratio of "adaptive" to "fixed" and its 95 % interval, each ground alike."""
    logs: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        if row.ground in grounds:
            own, fixed = (row.errors_m[m] + FLOOR_M for m in ("adaptive", "fixed"))
            logs.setdefault(row.ground, {}).setdefault(row.run, []).append(float(np.log(own / fixed)))

    def mean(drawn: dict[str, list[list[float]]]) -> float:
        return float(np.exp(np.mean([np.mean(np.concatenate(runs)) for runs in drawn.values()])))

    rng, groups = np.random.default_rng(0), {g: list(runs.values()) for g, runs in logs.items()}
    draws = [
        mean({g: [runs[i] for i in rng.integers(len(runs), size=len(runs))] for g, runs in groups.items()})
        for _ in range(DRAWS)
    ]
    low, high = percentile_interval(np.array(draws))
    return mean(groups), low, high


def report(rows: list[Row]) -> None:
    """Print a line a ground and group."""
    found = tuple(dict.fromkeys(row.ground for row in rows))
    groups = {**{g: (g,) for g in found}, "slipping": SLIPPING, "firm": FIRM, "all": found}
    for name, grounds in groups.items():
        own = [row for row in rows if row.ground in grounds]
        if not own:
            continue
        medians = ", ".join(f"{m} {np.median([r.errors_m[m] for r in own]):.2f}" for m in MODES)
        print(f"{name}: {len(own)} outages, {len({r.run for r in own})} runs; median error, m: {medians}")
        mean, low, high = ratio(rows, grounds)
        print(f"{name}, adaptive over fixed: {mean:.2f} [{low:.2f}, {high:.2f}]")


def main() -> int:
    """Judge, ask the memory, print."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.grounds", description=__doc__)
    parser.add_argument("--robot", default="warthog", help="a robot of ground_split.yaml")
    parser.add_argument("--out", type=Path, help="folder for parts; the same command continues")
    add_options(parser)
    given = parser.parse_args()
    report(judged(given.robot, TaskWorkers.of(given), given.out))
    knowledge(given.robot)
    return 0


if __name__ == "__main__":
    from tests.studies import grounds

    raise SystemExit(grounds.main())  # workers know the runs by the module's own name
