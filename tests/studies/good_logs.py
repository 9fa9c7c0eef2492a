"""Do the log checks change logs in which nothing is wrong? All public field logs, and 50 runs of the twin.

    python -m tests.studies.good_logs [--runs 50] [LOG...]

Counts logs for which a finding offers a repair, and lists these findings. `KNOWN` are true faults of public
logs, which are listed apart.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
from collections.abc import Iterable, Iterator

import terrafusion as tf
from terrafusion.datasets.catalog.catalog import load_catalog, locate
from terrafusion.datasets.checks import run_checks
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers import open_recordings
from terrafusion.fusion.cli.common import rig_of

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
            if not name.startswith("cmu_single_wheel") and locate(name) is not None:
                yield name


def _field(names: Iterable[str]) -> Iterator[tuple[str, Recording]]:
    for name in names:
        yield from ((name, recording) for recording in open_recordings(name))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("logs", nargs="*", help="by default all of the catalogue that are here")
    parser.add_argument("--runs", type=int, default=50)
    options = parser.parse_args()
    field, changed = 0, 0
    for name, recording in _field(options.logs or field_names()):
        codes = repairs_offered(recording)
        field, changed = field + 1, changed + bool(codes - known_faults(name))
        if codes:
            known = " (known)" if codes <= known_faults(name) else ""
            print(f"{recording.name}: {', '.join(sorted(codes))}{known}")
    print(f"field logs {field}, of which a repair would change {changed}")
    runs = 0
    for seed in range(options.runs):
        codes = repairs_offered(simulated(seed))
        runs += bool(codes)
        if codes:
            print(f"run {seed}: {', '.join(sorted(codes))}")
    print(f"simulated runs {options.runs}, of which a repair would change {runs}")


if __name__ == "__main__":
    main()
