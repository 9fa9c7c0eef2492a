"""Errors in outages with ground memory, learned on some runs of a robot and judged on others.

Fixes of 0.1 m are simulated from the truth. Memory is learned on the learn runs of
`ground_split.yaml` one after another, without labels; outages are cut from the judge runs. The ratio is the
geometric mean over outages of (error + 5 cm) over that of mode "fixed"; its interval is a bootstrap over
runs, and a group of grounds counts each ground alike.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from terrafusion.datasets.core.bootstrap import percentile_interval
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.yaml_file import read_yaml
from terrafusion.fusion.benchmark.field_logs import read_runs
from terrafusion.fusion.benchmark.outage_plan import aided_by_truth
from terrafusion.fusion.grounds.file import load_grounds, save_grounds
from terrafusion.fusion.grounds.memory import GroundMemory
from terrafusion.fusion.metrics.health import rolled_until_m
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.replay import replay
from terrafusion.twin.model.choose import choose_vehicle

SPLIT = Path(__file__).with_name("ground_split.yaml")
SLIPPING, FIRM = ("ice", "loose_sand", "gravel", "grass"), ("asphalt",)
FLOOR_M, LEAST_M, LONG_S = 0.05, 3.0, 150.0
"""Added to errors; least path of the wheels in an outage; runs this long have outages of 30 s, else 15."""
DRAWS = 2000
METHODS = ("fixed", "no memory", "memory", "shuffled")


@dataclass(frozen=True)
class Row:
    """One outage: errors (m) at its end by method."""

    ground: str
    run: str
    start_s: float
    errors_m: dict[str, float]


def runs_of(robot: str, part: str) -> Iterator[tuple[str, str, Recording]]:
    """Ground, name and recording of the runs of a robot to "learn" from or to "judge"."""
    for ground, names in read_yaml(SPLIT)[robot][part].items():
        for name in names:
            log, _, number = str(name).partition("#")
            for k, run in enumerate(read_runs(log)[0]):
                if not number or int(number) == k:
                    yield str(ground), f"{log}#{k}", aided_by_truth(run, 1)


def learned(robot: str) -> GroundMemory:
    """Memory after all learn runs of a robot."""
    memory = GroundMemory(robot=robot)
    for _, name, run in runs_of(robot, "learn"):
        found = replay(run, grounds=memory).grounds
        assert found is not None
        memory = found
        print(f"learned {name}: {len(memory)} grounds", flush=True)
    return memory


def shuffled(memory: GroundMemory) -> GroundMemory:
    """The memory with what it knows of slip and friction moved on to the next signature."""
    moved = [*memory.grounds[1:], *memory.grounds[:1]]
    return GroundMemory(
        [
            dataclasses.replace(g, motion=o.motion, friction=o.friction, friction_windows=o.friction_windows)
            for g, o in zip(memory.grounds, moved, strict=True)
        ],
        memory.robot,
    )


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


def judged(robot: str, memory: GroundMemory) -> Iterator[Row]:
    """Rows of all judge runs of a robot."""
    given = {"memory": memory, "shuffled": shuffled(memory)}
    for ground, name, run in runs_of(robot, "judge"):
        for outages in passes(run):
            errors: dict[float, dict[str, float]] = {}
            for method in METHODS:
                mode = "fixed" if method == "fixed" else "adaptive"
                result = replay(run, mode=mode, outages=outages, grounds=given.get(method))
                for outage, found in zip(outages, result.scores.outages, strict=True):
                    if found.end_error_m is not None:
                        errors.setdefault(outage.start_s, {})[method] = found.end_error_m
            yield from (Row(ground, name, start, found) for start, found in errors.items())
        print(f"judged {name}", flush=True)


def ratio(rows: list[Row], method: str, grounds: tuple[str, ...]) -> tuple[float, float, float]:
    """Ratio of a method to "fixed" and its 95 % interval, each ground alike."""
    logs: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        if row.ground in grounds:
            own, fixed = (row.errors_m[m] + FLOOR_M for m in (method, "fixed"))
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
        medians = ", ".join(f"{m} {np.median([r.errors_m[m] for r in own]):.2f}" for m in METHODS)
        print(f"{name}: {len(own)} outages, {len({r.run for r in own})} runs; median error, m: {medians}")
        for method in METHODS[1:]:
            mean, low, high = ratio(rows, method, grounds)
            print(f"{name}, {method} over fixed: {mean:.2f} [{low:.2f}, {high:.2f}]")


def main() -> int:
    """Learn, judge, print."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.grounds", description=__doc__)
    parser.add_argument("--robot", default="warthog", help="a robot of ground_split.yaml")
    parser.add_argument("--memory", type=Path, help="file of the memory: read if it is there, else written")
    words = parser.parse_args()
    if words.memory is not None and words.memory.exists():
        memory = load_grounds(words.memory)
    else:
        memory = learned(words.robot)
        if words.memory is not None:
            save_grounds(memory, words.memory)
    report(list(judged(words.robot, memory)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
