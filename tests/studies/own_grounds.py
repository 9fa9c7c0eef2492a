"""How well does a terrain model that is trained on a robot's own labelled logs know its grounds?

    python -m tests.studies.own_grounds

BorealTC (Husky, an IMU and wheels, no fixes), by run in five folds: `terrafusion terrain eval` of its logs.
"""

from __future__ import annotations

import re

from terrafusion.fusion.cli.terrain import score_lines
from terrafusion.fusion.training.logged_runs import open_runs
from terrafusion.fusion.training.train_on_logs import cross_validated
from tests.studies.field_runs import catalogued


def main() -> int:
    """Train on four folds, score the fifth, for each fold; print."""
    runs = open_runs([name for name in catalogued() if name.startswith("borealtc/") and has_imu(name)])
    by_run, spliced = cross_validated(runs)
    lines = score_lines(f"{len(runs)} runs", by_run)
    if spliced is not None:
        lines += score_lines("routes spliced from them", spliced)
    print(*(re.sub("; one update .*", "", line) for line in lines), sep="\n")
    return 0


def has_imu(name: str) -> bool:
    """Whether a recording of BorealTC has an IMU: some hold wheels and currents alone."""
    from terrafusion.datasets.readers import open_recording

    return open_recording(name).imu is not None


if __name__ == "__main__":
    raise SystemExit(main())
