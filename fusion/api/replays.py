"""`terrafusion.replay`: a recorded drive through the estimator, with its scores and its report."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from terrafusion.datasets.core.arguments import checked_path, checked_progress
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.tables import text_html
from terrafusion.datasets.readers.logs import Log, opened
from terrafusion.fusion.grounds.file import read_grounds
from terrafusion.fusion.grounds.memory import GroundMemory
from terrafusion.fusion.metrics.scores import Outage, as_outages
from terrafusion.fusion.noise.policy import Policy
from terrafusion.fusion.outputs.replay_files import metrics_of
from terrafusion.fusion.replay import ReplayResult
from terrafusion.fusion.replay import replay as run
from terrafusion.fusion.reports.replay import write_replay
from terrafusion.fusion.terrain.classifier import TerrainModel, load_terrain_model
from terrafusion.twin.model.vehicle import VehicleParams, as_vehicle


@dataclass(frozen=True, eq=False, repr=False)
class Replay(ReplayResult):
    """A replayed drive: `estimate`, `metrics` and `report`."""

    @property
    def metrics(self) -> dict[str, Any]:
        """The content of `metrics.json`; it keeps to docs/schemas/metrics.schema.json."""
        return metrics_of(self)

    def report(self, out: str | Path) -> Path:
        """Writes metrics.json, estimate.csv, trajectory.tum, weights.jsonl and report.html into a folder.

        Returns:
            the page.

        Raises:
            TerrafusionError: the folder cannot be written.
        """
        folder = checked_path(out, "out")
        write_replay(folder, self)
        return folder / "report.html"

    def __repr__(self) -> str:
        lines = [
            *self.verdict.lines()[:3],
            f"Replay of '{self.recording.name}' ({self.vehicle.name}, {self.mode}), "
            f"{self.recording.duration_s():.1f} s at {self.realtime_factor():.0f} x real time",
        ]
        below = [*self.scores.lines(), *repr(self.estimate).splitlines()]
        return "\n".join([*lines, *(f"  {line}" for line in below)])

    def _repr_html_(self) -> str:
        return text_html(repr(self))


def replay(
    log: Log,
    *,
    vehicle: str | Path | VehicleParams | None = None,
    mode: str = "adaptive",
    policy: str | Path | Policy | None = None,
    outages: Sequence[tuple[float, float] | Outage] = (),
    batch: bool = False,
    magnetometer: bool = False,
    calibrate: bool = False,
    lag_s: float = 5.0,
    grounds: str | Path | GroundMemory | None = None,
    terrain_model: str | Path | TerrainModel | None = None,
    progress: Callable[[float], None] | None = None,
) -> Replay:
    """Estimate a recorded drive and score it against its truth, or against fixes that are held out.

    Args:
        log: a `Recording`, or the path or catalogue name of one.
        vehicle: name, YAML file or `Vehicle`; by default what the log says.
        mode: "adaptive", "fixed", "robust" or "innovation".
        policy: weighting policy, or its file; by default the shipped one.
        outages: (start, length) in s, from the start of the log: no fix is given to the estimator there.
        batch: smooth the whole drive at once, instead of a fixed lag as live.
        magnetometer: use the log's magnetometer.
        calibrate: also estimate wheel radius, antenna, IMU rotation and delays.
        lag_s: length of the smoothing window.
        grounds: what the robot learned of its grounds on earlier drives (a file need not exist yet);
            `result.grounds` holds it with what this drive adds.
        terrain_model: of this robot, made by `terrafusion terrain train`, or its file; by default the
            shipped one.
        progress: called with the share done, 0 to 1.

    Raises:
        TerrafusionError: the log or the vehicle cannot be used; one line says what, where and what to do.

    Example:
        >>> import terrafusion as tf
        >>> result = tf.replay(tf.simulate("straight"), outages=[(20, 10)])
        >>> result.metrics["mode"]
        'adaptive'
    """
    checked_progress(progress)
    known = None if vehicle is None else as_vehicle(vehicle)
    if not (grounds is None or isinstance(grounds, (str, Path, GroundMemory))):
        raise ConfigError(f"grounds is {grounds!r}", remedy="give a file, or the `grounds` of a result")
    (recording,) = opened([log], None if known is None else known.rig())
    if isinstance(terrain_model, (str, Path)):
        terrain_model = load_terrain_model(Path(terrain_model))
    result = run(
        recording,
        vehicle=vehicle,
        mode=mode,
        policy=policy,
        outages=as_outages(outages),
        batch=batch,
        progress=progress,
        magnetometer=magnetometer,
        settings={"calibrate": calibrate, "lag_s": lag_s, "terrain_model": terrain_model},
        grounds=read_grounds(Path(grounds)) if isinstance(grounds, (str, Path)) else grounds,
    )
    return Replay(**vars(result))
