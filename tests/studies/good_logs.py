"""Do the log checks change logs in which nothing is wrong? All public field logs, and 50 runs of the twin.

    python -m tests.studies.good_logs [--runs 50] [LOG...]

Counts logs for which a finding offers a repair, and lists these findings. `KNOWN` are true faults of public
logs, which are listed apart.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
from collections.abc import Iterator
from pathlib import Path

import terrafusion as tf
from terrafusion.datasets.catalog.catalog import load_catalog, locate
from terrafusion.datasets.checks import run_checks
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers import open_recordings
from terrafusion.fusion.cli.common import rig_of
from tests.studies.parts import TaskWorkers, add_options, answers

KNOWN = {
    "borealtc": {"clock-offset", "clock-drift"},
    "wvu_pathfinder/s5t1": {"uneven-sampling"},
    "comma2k19": {"uneven-sampling"},
}
"""By beginning of the name: wheels and IMU that did not start together, and times of arrival."""
VEHICLES = ("elevate", "husky", "warthog")
SCENARIOS = ("figure_eight", "waypoints", "paper_profile", "circle", "staircase", "chirp", "straight", "spin")
GROUNDS = ("asphalt", "gravel", "grass", "medium_sand", "loose_sand")


def simulated(seed: int) -> Recording:
    """A run with its truth and label, without truth, or without both."""
    ground = GROUNDS[(seed + seed // len(SCENARIOS)) % len(GROUNDS)]
    scenario, vehicle = SCENARIOS[seed % len(SCENARIOS)], VEHICLES[seed % len(VEHICLES)]
    run = tf.simulate(scenario, seed=seed, vehicle=vehicle, terrain=ground)
    if seed % 2:
        run = dataclasses.replace(run, truth=None, truth_channels=())
    return dataclasses.replace(run, terrain=None, terrain_name="") if seed % 4 > 1 else run


def repairs_offered(log: Recording) -> set[str]:
    """Codes of the findings that offer a repair."""
    return {finding.code for finding in run_checks(log, rig_of(log, None)) if finding.repair is not None}


def known_faults(name: str) -> set[str]:
    """Codes of the true faults of a public log."""
    return {code for log, codes in KNOWN.items() if name.startswith(log) for code in codes}


def field_names() -> Iterator[str]:
    """Names of the drives of the catalogue that are on this machine."""
    for name in load_catalog().recordings():
        with contextlib.suppress(DataError):
            if locate(name) is not None:
                yield name


def offered(trial: tuple[str, str | int]) -> list[tuple[str, list[str]]]:
    """Name and codes of every recording of a field log, or of a run of the twin."""
    kind, which = trial
    logs = open_recordings(str(which)) if kind == "log" else [simulated(int(which))]
    return [(log.name, sorted(repairs_offered(log))) for log in logs]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("logs", nargs="*", help="by default all of the catalogue that are here")
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--out", type=Path, help="folder for parts; the same command continues")
    add_options(parser)
    given = parser.parse_args()
    names, seeds = given.logs or [*field_names()], range(given.runs)
    trials = [*(("log", name) for name in names), *(("run", seed) for seed in seeds)]
    found = answers(trials, offered, TaskWorkers.of(given), given.out)
    field, changed, runs = 0, 0, 0
    for name, rows in zip(names, found, strict=False):
        for called, codes in rows:
            true = known_faults(name)
            field, changed = field + 1, changed + bool(set(codes) - true)
            if codes:
                print(f"{called}: {', '.join(codes)}{' (known)' if set(codes) <= true else ''}")
    print(f"field logs {field}, of which a repair would change {changed}")
    for seed, [(_, codes)] in zip(seeds, found[len(names) :], strict=True):
        runs += bool(codes)
        if codes:
            print(f"run {seed}: {', '.join(codes)}")
    print(f"simulated runs {given.runs}, of which a repair would change {runs}")


if __name__ == "__main__":
    from tests.studies import good_logs

    good_logs.main()  # workers know the logs by the module's own name
