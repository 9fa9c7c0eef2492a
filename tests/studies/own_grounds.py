"""How well does a terrain model that is trained on a robot's own labelled logs know its grounds?

    python -m tests.studies.own_grounds

BorealTC (Husky, an IMU and wheels, no fixes), by run in five folds: `terrafusion terrain eval` of its logs.
"""

from __future__ import annotations

from terrafusion.fusion.cli.terrain import score_lines
from terrafusion.fusion.training.logged_runs import open_runs
from terrafusion.fusion.training.train_on_logs import cross_validated
from tests.studies.field_runs import catalogued


def main() -> int:
    """Train on four folds, score the fifth, for each fold; print."""
    runs = open_runs([name for name in catalogued() if name.startswith("borealtc/") and has_imu(name)])
    scores = cross_validated(runs)
    for line in score_lines(f"{len(runs)} runs", scores):
        if not line.startswith(("ground change", "one update")):
            print(line)
    return 0


def has_imu(name: str) -> bool:
    """Whether a recording of BorealTC has an IMU: some hold wheels and currents alone."""
    from terrafusion.datasets.readers import open_recording

    return open_recording(name).imu is not None


if __name__ == "__main__":
    raise SystemExit(main())
