"""The live loop: messages go to the estimator as they arrive, odometry comes out at the rate of the IMU."""

import dataclasses
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.heap import older_objects_unsearched
from terrafusion.datasets.core.messages import ImuSample, Message
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.config.sensor_config import imu_kind, sensor_config_of
from terrafusion.fusion.estimate.estimate import State
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.estimator.history import History
from terrafusion.fusion.grounds.memory import GroundMemory
from terrafusion.fusion.metrics.verdict import Verdict
from terrafusion.fusion.replay import judged
from terrafusion.fusion.terrain.classifier import TerrainModel
from terrafusion.twin.model.choose import choose_vehicle


@dataclass
class Latencies:
    """Computing times, ms: of every IMU sample that made a keyframe, of the others, and of `odometry`."""

    keyframe: list[float] = field(default_factory=list)
    sample: list[float] = field(default_factory=list)
    odometry: list[float] = field(default_factory=list)

    def lines(self) -> Iterator[str]:
        for spec in dataclasses.fields(self):
            values = getattr(self, spec.name)
            if values:
                p50, p99, worst = np.percentile(values, [50, 99, 100])
                quantiles = f"p50 {p50:.3f} ms, p99 {p99:.3f} ms, max {worst:.3f} ms"
                yield f"{spec.name:9} {quantiles}, {len(values)} calls"


def live_estimator(
    recording: Recording,
    vehicle: str | None = None,
    history: History | None = None,
    mode: str = "adaptive",
    gnss: bool = False,
    terrain_model: TerrainModel | None = None,
    grounds: GroundMemory | None = None,
) -> Estimator:
    """An estimator for the robot and the sensors of a recording.

    Args:
        recording: of the robot, however short.
        vehicle: name or YAML file; by default what the recording names.
        history: collects the states.
        mode: as in `EstimatorConfig`.
        gnss: fixes will come, though the recording has none.
        terrain_model, grounds: as in `EstimatorConfig`.

    Raises:
        DataError: the log has no IMU or no wheels, or nothing tells the robot's geometry.
        ConfigError: an unknown vehicle.
    """
    if recording.wheels is None or imu_kind(recording.imu) == "none":
        raise DataError(
            "the log lacks IMU or wheels", remedy="live use needs both; see `terrafusion inspect`"
        )
    robot, _ = choose_vehicle(recording, vehicle)
    inputs = sensor_config_of(recording, recording.gnss)
    inputs = dataclasses.replace(inputs, gnss=inputs.gnss or gnss)
    config = EstimatorConfig(
        robot.rig(), robot.name, mode, inputs=inputs, terrain_model=terrain_model, grounds=grounds
    )
    if history is None:
        return Estimator(config)
    estimator = Estimator(
        config,
        on_state=lambda state: history.add(state, estimator.weights.noise),
        on_innovation=history.innovations.append,
    )
    return estimator


def verdict_of(estimator: Estimator, history: History, recording: Recording) -> Verdict:
    """The verdict on a finished run that got all fixes, against the truth where the recording has one."""
    history.align(estimator.gnss.alignment, batch=False)
    estimate = history.estimate(estimator.weights.detector.classes, [], ())
    return judged(recording, estimate, estimator, estimator.config.rig, recording.gnss)[2]


@older_objects_unsearched()
def run(
    estimator: Estimator,
    messages: Iterable[Message],
    publish: Callable[[State], None],
    realtime: bool = False,
) -> Latencies:
    """Feed messages as they arrive and publish odometry after every IMU sample, once there is a start."""
    taken, began, first_ns = Latencies(), time.perf_counter(), None
    for message in messages:
        first_ns = message.t_ns if first_ns is None else first_ns
        if realtime:
            time.sleep(max(0.0, (message.t_ns - first_ns) * 1e-9 - (time.perf_counter() - began)))
        before, begun = estimator.latest(), time.perf_counter()
        estimator.add(message)
        if not isinstance(message, ImuSample):
            continue
        fed = time.perf_counter()
        state = estimator.odometry()
        done = time.perf_counter()
        made = estimator.latest() is not before
        (taken.keyframe if made else taken.sample).append((fed - begun) * 1e3)
        if state is not None:
            taken.odometry.append((done - fed) * 1e3)
            publish(state)
    return taken
