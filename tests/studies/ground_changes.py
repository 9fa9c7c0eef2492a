"""How soon is a change of ground noticed, and named, by a classifier of the robot's own grounds?

    python -m tests.studies.ground_changes

BorealTC by run: five folds, and routes spliced from the raw samples of runs that the model was not trained
on. The limit of the alarm was chosen on routes with seeds 0 to 9; these have other seeds, but the same runs.
"""

from __future__ import annotations

from terrafusion.fusion.training.cross_validation import LabelledRun, cross_validate, open_runs
from tests.studies.field_runs import catalogued
from tests.studies.ground_classifier.change_detection import changes_seen

FIRST_SEED = 1000


def main() -> int:
    """Train on each fold, splice routes, print."""
    folded = cross_validate(labelled_runs())
    held_out = [
        [(run.signals, run.label) for run, f in zip(folded.runs, folded.fold_of, strict=True) if f == fold]
        for fold in range(len(folded.models))
    ]
    scores, changes = folded.scores(), changes_seen(folded.models, held_out, FIRST_SEED)
    assert changes is not None
    print(f"runs {len(folded.runs)}, temperatures {', '.join(f'{m.temperature:g}' for m in folded.models)}")
    print(f"macro-F1 {scores.macro_f1:.3f}, ECE {scores.ece:.3f}")
    print(f"changes {changes.changes}")
    print(f"alarm within 2 s: {changes.alarms:.0%}")
    print(f"false alarms a minute: {changes.false_alarms:.2f}")
    print(f"new ground named within 2 s: {changes.within_2_s:.0%}")
    print(f"new ground named after, median: {changes.median_s:.1f} s")
    print(f"never named: {changes.never:.0%}")
    return 0


def labelled_runs() -> list[LabelledRun]:
    """The runs of BorealTC that have an IMU."""
    names = [name for name in catalogued() if name.startswith("borealtc/")]
    return open_runs([name for name in names if has_imu(name)])


def has_imu(name: str) -> bool:
    """Whether a recording of BorealTC has an IMU: some hold wheels and currents alone."""
    from terrafusion.datasets.readers import open_recording

    return open_recording(name).imu is not None


if __name__ == "__main__":
    raise SystemExit(main())
