"""Windows of labelled logs as the estimator forms them, to train and to score a terrain model."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers import open_recordings
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.noise.labels import GroundLabels
from terrafusion.fusion.replay import replay
from terrafusion.fusion.terrain.classifier import UNKNOWN
from terrafusion.fusion.terrain.external import true_grounds
from terrafusion.fusion.terrain.features import MIN_SPEED_MPS, Window
from terrafusion.fusion.training.detector_scores import LabelledRoute, changes_in
from terrafusion.twin.model.vehicle import load_vehicle


@dataclass(frozen=True, eq=False)
class LoggedRun:
    """A labelled run: its name, the vehicle's, and its windows with the ground of each."""

    name: str
    vehicle: str
    route: LabelledRoute

    def grounds(self) -> set[str]:
        """The grounds of the run."""
        return set(self.route.labels.tolist())


def open_runs(
    logs: Sequence[str], vehicle: str | None = None, tick: Callable[[], None] | None = None
) -> list[LoggedRun]:
    """The labelled runs of one robot's logs: files, folders, or catalogue names; `vehicle` instead of theirs.

    `tick` is called after each log.

    Raises:
        DataError: a run without ground labels, nothing that moves, or logs of several vehicles.
        TerrafusionError: a log cannot be read or replayed.
    """
    rig, found = None if vehicle is None else load_vehicle(vehicle).rig(), list[LoggedRun]()
    for log in logs:
        found += [run_of(recording, vehicle) for recording in open_recordings(log, rig=rig)]
        if tick is not None:
            tick()
    runs = [run for run in found if run.route.windows]
    names = sorted({run.vehicle for run in runs})
    if not runs:
        raise DataError("the robot does not move on labelled ground in the logs given", channel="terrain")
    if len(names) > 1:
        raise DataError(
            f"the logs are of {' and '.join(names)}", remedy="give those of one robot, or --vehicle"
        )
    return runs


def run_of(recording: Recording, vehicle: str | None = None) -> LoggedRun:
    """The windows of a recording in which the robot moves on ground with a label.

    Raises:
        DataError: the recording has no true label, or cannot be replayed.
    """
    labels = GroundLabels(*zip(*labelled_grounds(recording), strict=True))
    windows: list[Window] = []
    names: list[str] = []

    def watch(estimator: Estimator) -> None:
        window, state = estimator.weights.window, estimator.latest()
        if state is None or window is None or (windows and window is windows[-1]):
            return
        name = labels.at(state.t_ns)
        if window.ground_speed_mps() > MIN_SPEED_MPS and name not in ("", UNKNOWN):
            windows.append(window)
            names.append(name)

    used = replay(recording, vehicle=vehicle, mode="fixed", findings=(), watch=watch).vehicle
    return LoggedRun(recording.name, used.name, changes_in(windows, np.array(names)))


def labelled_grounds(recording: Recording) -> list[tuple[int, str]]:
    """Start (ns) and name of each ground of a run, "" where unlabelled; a DataError without a true label."""
    if grounds := true_grounds(recording):
        return grounds
    remedy = "name it in meta.yaml or the column map ('terrain'), or add terrain.csv (convert a bag first)"
    raise DataError(f"{recording.name}: no ground label", channel="terrain", remedy=remedy)
