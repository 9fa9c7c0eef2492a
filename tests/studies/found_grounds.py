"""Errors in outages where robots that no terrain model knows drive over several grounds.

    python -m tests.studies.found_grounds [--develop] [--seeds N]

A robot drives for about 160 s with fixes, over a new ground every few metres, then 60 s without. The modes
"fixed" and "adaptive" are compared, and "memory": adaptive with the grounds that another drive of the same
robot found. "told" gets the true ground at all times, and the policy's slip of it.
Development used husky and warthog on mixed and firm ground of the twin, seeds below 2000; all else, and
the seeds of `JUDGE`, was first driven when the method was done.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from terrafusion.datasets.core.bootstrap import percentile_interval
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.benchmark import twin_runs
from terrafusion.fusion.benchmark.methods import true_labels
from terrafusion.fusion.grounds.memory import GroundMemory
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.replay import replay
from terrafusion.twin.effects.alternative_terramechanics import second_terramechanics
from terrafusion.twin.scenario.scenario import RouteLeg, Scenario
from terrafusion.twin.simulate import simulate_run
from tests.studies.opponents.drives import made
from tests.studies.parts import TaskWorkers, add_options, answers

ROBOTS = ("husky", "pathfinder", "warthog")
DEVELOP, JUDGE = 1000, 3000
"""First seeds."""
LEAD_S, OUTAGE_S, TAIL_S = 160.0, 60.0, 2.0
MODES = ("fixed", "adaptive", "memory", "told")
DRAWS = 4000


@dataclasses.dataclass(frozen=True)
class Setting:
    """Grounds of the route in random order, the plant, and the receiver ("": that of the vehicle file)."""

    grounds: tuple[str, ...]
    plant: str = "twin"
    receiver: str = "rtk"


SETTINGS = {
    "mixed": Setting(twin_runs.GROUNDS),
    "other_laws": Setting(twin_runs.GROUNDS, plant="second"),
    "other_grounds": Setting(("gravel", "grass", "snow", "ploughed_soil")),
    "coarse_fixes": Setting(twin_runs.GROUNDS, receiver=""),
    "firm": Setting(("asphalt",)),
}


def drive_of(setting: Setting, robot: str, seed: int) -> tuple[Recording, Outage]:
    """A drive and its outage."""
    case = twin_runs.BenchmarkCase("mixed", setting.plant, seed)
    rng = case.stream("found grounds", robot, *setting.grounds)
    outage = Outage(round(LEAD_S + float(rng.uniform(0.0, 10.0)), 1), OUTAGE_S)
    seconds = outage.start_s + OUTAGE_S + TAIL_S
    several = len(setting.grounds) > 1
    family = dataclasses.replace(twin_runs.FAMILIES["mixed"], grounds=setting.grounds)
    route = twin_runs._route(family, seconds, rng) if several else (RouteLeg(setting.grounds[0]),)
    second = setting.plant == "second"
    scenario = Scenario(
        name=case.key,
        description="several grounds",
        duration_s=seconds,
        drive=twin_runs._wander(seconds, rng),
        max_accel_mps2=0.5,
        route=route,
        heading_deg=float(rng.uniform(-180.0, 180.0)),
        variation=twin_runs.CORRELATED if second else None,
    )
    soils = twin_runs.soils_of(case, {leg.terrain for leg in route})
    run = simulate_run(
        scenario,
        vehicle=robot,
        soils=soils,
        effects=second_terramechanics() if second else {},
        seed=int(rng.integers(2**31)),
    ).recording
    return made(run, setting.receiver) if setting.receiver else run, outage


def errors_m(trial: tuple[str, str, int]) -> dict[str, float]:
    """Error at the end of the outage by mode, m: setting, robot and seed.

    None where a drive gets stuck before coarse fixes have shown the heading.
    """
    try:
        return _errors_m(trial)
    except DataError:
        return {}


def _errors_m(trial: tuple[str, str, int]) -> dict[str, float]:
    name, robot, seed = trial
    setting = SETTINGS[name]
    log, outage = drive_of(setting, robot, seed)
    before, _ = drive_of(setting, robot, seed + 500)
    memory = replay(before, vehicle=robot, grounds=GroundMemory(), findings=()).grounds
    arms: dict[str, dict[str, Any]] = {
        "fixed": {"mode": "fixed"},
        "adaptive": {},
        "memory": {"grounds": memory},
        "told": {"settings": {"labels": true_labels(log)}},
    }
    found = {}
    for arm, options in arms.items():
        scores = replay(log, vehicle=robot, outages=[outage], findings=(), **options).scores
        end_m = scores.outages[0].end_error_m
        assert end_m is not None
        found[arm] = end_m
    return found


def ratio(errors: list[dict[str, float]], mode: str) -> str:
    """Geometric mean over drives of the error over that of fixed weights, and its 95 % interval."""
    logs = np.array([np.log(e[mode] / e["fixed"]) for e in errors])
    draws = np.random.default_rng(0).choice(logs, (DRAWS, len(logs))).mean(axis=1)
    low, high = percentile_interval(np.exp(draws))
    return f"{np.exp(logs.mean()):.2f} [{low:.2f}, {high:.2f}]"


def main() -> None:
    """Print a line a setting and robot, and one a setting."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.found_grounds",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--develop", action="store_true", help="the seeds that served development")
    parser.add_argument("--setting", choices=tuple(SETTINGS), action="append", help="this one alone")
    parser.add_argument("--robot", choices=ROBOTS, action="append", help="this one alone")
    parser.add_argument("--out", type=Path, help="folder for parts; the same command continues")
    add_options(parser)
    given = parser.parse_args()
    first = DEVELOP if given.develop else JUDGE
    print(f"{'':28s} {'fixed, m':>9s}  over fixed: " + "".join(f"{mode:20s}" for mode in MODES[1:]))
    for name in given.setting or SETTINGS:
        robots = given.robot or ROBOTS
        trials = [(name, robot, seed) for robot in robots for seed in range(first, first + given.seeds)]
        errors = answers(trials, errors_m, TaskWorkers.of(given), given.out)
        groups = {robot: errors[i * given.seeds :][: given.seeds] for i, robot in enumerate(robots)}
        for robot, drives in {**groups, "all": errors}.items():
            some = [one for one in drives if one]
            median = float(np.median([e["fixed"] for e in some]))
            ratios = "".join(f"{ratio(some, mode):20s}" for mode in MODES[1:])
            stuck = f"stuck at the start {len(drives) - len(some)}" if len(some) < len(drives) else ""
            print(f"{name + ' ' + robot:28s} {median:9.2f}              {ratios}{stuck}", flush=True)


if __name__ == "__main__":
    from tests.studies import found_grounds

    found_grounds.main()  # workers know the trials by the module's own name
