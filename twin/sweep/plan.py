"""A sweep: a scenario, a vehicle and axes, and the runs they make.

The runs are the cross product of the axes, the last axis of `AXES` running
fastest; a random sweep is a Latin hypercube of so many runs instead.
"""

import dataclasses
import enum
import hashlib
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from terrafusion.twin.model.soil import SoilParams
from terrafusion.twin.model.vehicle import VehicleParams
from terrafusion.twin.model.version import model_sha256, version
from terrafusion.twin.scenario.scenario import Scenario

AXES = ("terrain", "friction", "slope_deg", "payload_kg", "speed_scale", "speed_mps", "seed")
"""Names of the axes, in the order of the cross product; `speed_scale` and `speed_mps` exclude each other."""
MAX_RUNS = 100_000
"""A sweep of more runs is refused unless it is asked for."""

CHUNK_S = 4000.0
"""Driving in a chunk, s: some seconds of work, lost when a process is killed."""
MIN_CHUNKS = 32
"""Least number of chunks of a sweep, for many workers."""
CHUNK_STEP = 8
"""Chunks hold a multiple of so many runs, which the engine may drive together."""

Level = str | float | int


@dataclass(frozen=True)
class Axis:
    """One axis: its levels, or for a random sweep the span (low, high) it is drawn from.

    A span of whole numbers (`seed`) includes both ends.
    """

    name: str
    levels: tuple[Level, ...] = ()
    span: tuple[float, float] | None = None

    def at(self, share: float) -> Level:
        """The value at a share from 0 to below 1 of the axis."""
        if self.span is None:
            return self.levels[int(share * len(self.levels))]
        low, high = self.span
        if self.name == "seed":
            return int(low) + int(share * (high - low + 1.0))
        return low + share * (high - low)


@dataclass(frozen=True)
class SweepPoint:
    """One run of a sweep; None stands for the value of the scenario and its soils."""

    run: int
    terrain: str | None = None
    friction: float | None = None
    slope_deg: float | None = None
    payload_kg: float | None = None
    speed_scale: float | None = None
    speed_mps: float | None = None
    seed: int = 0


@dataclass(frozen=True)
class Sweep:
    """A sweep with everything its runs need, so that it can travel to another machine.

    Attributes:
        axes: in the order of `AXES`, those that the file names.
        random: number of runs of a Latin hypercube, None for the cross product.
        soils: (name, parameters) of every ground that the scenario or the axis `terrain` names.
        sensors: whether sensors are simulated and their errors measured.
    """

    name: str
    description: str
    scenario: Scenario
    vehicle: VehicleParams
    axes: tuple[Axis, ...]
    random: int | None
    random_seed: int
    sensors: bool
    soils: tuple[tuple[str, SoilParams], ...]

    @property
    def runs(self) -> int:
        """Number of runs."""
        if self.random is not None:
            return self.random
        return math.prod(len(axis.levels) for axis in self.axes)

    def cases(self) -> Iterator[SweepPoint]:
        """All runs in their order."""
        if self.random is None:
            shape = tuple(len(axis.levels) for axis in self.axes)
            for run, place in enumerate(np.ndindex(shape)):
                values = {a.name: a.levels[i] for a, i in zip(self.axes, place, strict=True)}
                yield SweepPoint(run, **values)
        else:
            for run, shares in enumerate(_hypercube(self.random, len(self.axes), self.random_seed)):
                values = {a.name: a.at(s) for a, s in zip(self.axes, shares, strict=True)}
                yield SweepPoint(run, **values)

    def speed_scale(self, case: SweepPoint) -> float:
        """Commanded speeds of a run over the scenario's."""
        if case.speed_mps is not None:
            return case.speed_mps / top_speed_mps(self.scenario)
        return 1.0 if case.speed_scale is None else case.speed_scale

    def chunks(self) -> list[range]:
        """Runs that are computed together, the same for any number of workers."""
        most = int(CHUNK_S / self.scenario.duration_s)
        size = max(1, min(most, self.runs // MIN_CHUNKS) // CHUNK_STEP) * CHUNK_STEP
        return [range(i, min(i + size, self.runs)) for i in range(0, self.runs, size)]

    def config(self) -> dict[str, Any]:
        """The sweep as plain data that JSON can hold."""
        return dict(_plain(dataclasses.asdict(self)))

    def sha256(self) -> str:
        """Hash of all that decides the rows: axes, scenario, vehicle, soils, version and the twin's code."""
        content = self.config() | {"terrafusion": version(), "model": model_sha256()}
        del content["name"], content["description"]
        text = json.dumps(content, sort_keys=True, allow_nan=False)
        return hashlib.sha256(text.encode()).hexdigest()

    def design(self) -> str:
        """The runs in words: their number, the axes and the driving."""
        if self.random is not None:
            how = f"Latin hypercube over {', '.join(axis.name for axis in self.axes)}"
        else:
            how = " x ".join(f"{axis.name} {len(axis.levels)}" for axis in self.axes)
        hours = self.runs * self.scenario.duration_s / 3600.0
        runs = "1 run" if self.runs == 1 else f"{self.runs} runs"
        return (
            f"{runs} of {self.scenario.duration_s:g} s ({how}; {hours:.3g} h of driving), "
            f"{'with' if self.sensors else 'without'} sensors"
        )


def top_speed_mps(scenario: Scenario) -> float:
    """The fastest forward speed the scenario commands, by its segments' mean and amplitude."""
    if scenario.waypoints:
        return scenario.waypoint_speed_mps
    return max(s.v_mps + abs(s.v_amplitude_mps) for s in scenario.drive)


def at_speed(scenario: Scenario, scale: float) -> Scenario:
    """The same drive at `scale` times its speeds; yaw rates scale along, so that curves keep their radius."""
    if scale == 1.0:
        return scenario
    drive = tuple(
        dataclasses.replace(
            s,
            v_mps=scale * s.v_mps,
            v_amplitude_mps=scale * s.v_amplitude_mps,
            yaw_rate_radps=scale * s.yaw_rate_radps,
            yaw_rate_amplitude_radps=scale * s.yaw_rate_amplitude_radps,
        )
        for s in scenario.drive
    )
    return dataclasses.replace(scenario, drive=drive, waypoint_speed_mps=scale * scenario.waypoint_speed_mps)


def _plain(value: Any) -> Any:
    """The same value for JSON: enumerations by name, numbers that are not finite as words."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value


def _hypercube(runs: int, axes: int, seed: int) -> list[list[float]]:
    """Shares (runs, axes) from 0 to below 1, one a stratum on each axis (McKay and others, 1979)."""
    from scipy.stats.qmc import LatinHypercube

    return np.asarray(LatinHypercube(axes, rng=seed).random(runs)).tolist()
