"""How long the estimator computes: live, batch, part by part, and beside GTSAM's own optimisers.

    python -m tests.studies.speed.speed [LOG ...] [--vehicle NAME] [--profile]

Without logs a drive of the twin is taken. Wall time is what a robot waits for; CPU time of the thread tells
it from what other programs on the machine took, and is what GTSAM is compared by. Other programs still empty
the caches: a keyframe's time is the least of `PASSES` drives, which are the same to the last bit.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.errors import DataError, TerrafusionError
from terrafusion.datasets.core.messages import ImuSample
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimate.estimate import State
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.graph.batch import BatchSmoother
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.key_state import KeyState
from tests.studies.speed import gtsam_graph as speed_gtsam
from tests.studies.speed.gtsam_graph import Graph

Array = NDArray[np.float64]

SCENARIO = {"scenario": "paper_profile", "terrain": "medium_sand", "slope_deg": 5.0, "seed": 4}
PASSES = 3
SHORT_S = 30.0
"""Length of the drive for GTSAM's slow ones: with Python factors its batch copies all values at each."""


@dataclass
class Live:
    """One live drive: wall and CPU time (ms) of each keyframe made, and of the call after it, which does
    what no state waits for; seconds of all calls; its factors."""

    wall_ms: list[float] = field(default_factory=list)
    cpu_ms: list[float] = field(default_factory=list)
    upkeep_ms: list[float] = field(default_factory=list)
    start_ms: float = 0.0
    seconds: float = 0.0
    cpu_s: float = 0.0
    archive: Chain | None = None
    states: list[State] = field(default_factory=list)

    def lines(self) -> Iterator[str]:
        timed = (
            ("keyframe, wall", self.wall_ms),
            ("keyframe, CPU ", self.cpu_ms),
            ("next call, CPU", self.upkeep_ms),
        )
        for name, values in timed:
            p50, p90, p99, worst = np.percentile(values, [50, 90, 99, 100])
            mean = float(np.mean(values))
            yield (
                f"{name}: mean {mean:.2f} ms, p50 {p50:.2f}, p90 {p90:.2f}, p99 {p99:.2f}, "
                f"max {worst:.2f} ms ({len(values)})"
            )
        yield f"start {self.start_ms:.0f} ms; whole drive {self.seconds:.2f} s wall, {self.cpu_s:.2f} s CPU"


def live(recording: Recording, config: EstimatorConfig, keep: bool = False) -> Live:
    """Feed a recording message by message; with `keep` all factors stay, for a batch.

    Raises:
        DataError: the log lacks a sensor, or the estimator never started.
    """
    taken = Live(archive=Chain(calibrate=config.calibrate) if keep else None)
    estimator = Estimator(config, on_state=taken.states.append, archive=taken.archive)
    fresh = False
    for message in recording.messages():
        before, wall, cpu = len(taken.states), time.perf_counter(), time.thread_time()
        estimator.add(message)
        wall, cpu = time.perf_counter() - wall, time.thread_time() - cpu
        taken.seconds += wall
        taken.cpu_s += cpu
        if len(taken.states) == before:
            if fresh and isinstance(message, ImuSample):
                taken.upkeep_ms.append(cpu * 1e3)
                fresh = False
            continue
        fresh = True
        if before == 0 or len(taken.states) > before + 1:  # the start makes all keyframes that waited for it
            taken.start_ms = max(taken.start_ms, wall * 1e3)
            continue
        taken.wall_ms.append(wall * 1e3)
        taken.cpu_ms.append(cpu * 1e3)
    if not taken.wall_ms:
        raise DataError("the estimator never started", remedy="see `terrafusion inspect`")
    return taken


def least(recording: Recording, config: EstimatorConfig) -> Live:
    """`live` several times, with its factors: of each keyframe, and of the whole, the least times."""
    passes = [live(recording, config, keep=True) for _ in range(PASSES)]
    for name in ("wall_ms", "cpu_ms", "upkeep_ms"):
        setattr(passes[0], name, np.min([getattr(one, name) for one in passes], axis=0).tolist())
    passes[0].seconds, passes[0].cpu_s = (min(getattr(p, n) for p in passes) for n in ("seconds", "cpu_s"))
    return passes[0]


def timed(call: Callable[[], object]) -> tuple[float, float]:
    """Wall and CPU seconds of a call."""
    wall, cpu = time.perf_counter(), time.thread_time()
    call()
    return time.perf_counter() - wall, time.thread_time() - cpu


def initial(taken: Live) -> list[KeyState]:
    """States to start a batch from, one a keyframe: the live ones; before them the predictions."""
    from terrafusion.fusion.estimator.key_states import key_state_of

    assert taken.archive is not None
    nodes = taken.archive.nodes
    known = [key_state_of(state) for state in taken.states]
    return [*(node.point for node in nodes[: len(nodes) - len(known)]), *known]


def batch_parts(chain: Chain, start: list[KeyState]) -> dict[str, tuple[float, float]]:
    """Wall and CPU seconds of the parts of a batch solution."""
    made: list[BatchSmoother] = []
    parts = {"set-up": timed(lambda: made.append(BatchSmoother(chain, start)))}
    parts["Gauss-Newton"] = timed(made[0].optimise)
    parts[f"  of which one of {made[0].iterations} linearisations with elimination"] = timed(
        made[0].linearise
    )
    parts["states and covariances"] = timed(lambda: (made[0].states(), made[0].covariances()))
    return parts


def compare(recording: Recording, config: EstimatorConfig, taken: Live) -> Iterator[str]:
    """Ours and GTSAM's optimisers on the factors of a live drive, one line each."""
    yield from _batches(taken, Graph.NATIVE, ("GaussNewton", "LevenbergMarquardt"))
    # GTSAM's full graph has the states of a calibration, so ours has them there, too.
    short = live(first_part(recording, SHORT_S), dataclasses.replace(config, calibrate=True), keep=True)
    assert short.archive is not None
    yield from _batches(short, Graph.FULL, ("GaussNewton",))
    yield _lag_line(short.archive, Graph.NATIVE, speed_gtsam.incremental, config.lag_s)
    yield _lag_line(short.archive, Graph.FULL, speed_gtsam.incremental, config.lag_s)
    yield _lag_line(short.archive, Graph.NATIVE, speed_gtsam.batch_lag, config.lag_s)


def _batches(taken: Live, kind: Graph, optimisers: tuple[str, ...]) -> Iterator[str]:
    chain, start = taken.archive, initial(taken)
    assert chain is not None
    ours = sum(cpu for name, (_, cpu) in batch_parts(chain, start).items() if not name.startswith(" "))
    yield f"batch of {len(start)} keyframes, ours: {ours:.2f} s CPU with covariances"
    for optimiser in optimisers:
        seconds, error = speed_gtsam.batch(chain, start, kind, optimiser)
        told = f"batch of {len(start)} keyframes, GTSAM {optimiser}, {kind.value}: {seconds:.2f} s CPU"
        yield told if np.isfinite(error) else f"{told} until it gave up (indeterminate)"


def _lag_line(chain: Chain, kind: Graph, make: Callable[[float], object], lag_s: float) -> str:
    told = f"fixed lag, GTSAM {type(make(lag_s)).__name__}, {kind.value}"
    try:
        ms = speed_gtsam.fixed_lag(chain, kind, make, lag_s)
    except RuntimeError as error:
        return f"{told}: gave up ({str(error).strip().splitlines()[0]})"
    p50, p99 = np.percentile(ms, [50, 99])
    return f"{told}, CPU: mean {ms.mean():.2f} ms, p50 {p50:.2f}, p99 {p99:.2f}"


def first_part(recording: Recording, seconds: float) -> Recording:
    """The first seconds of a drive."""
    end = recording.start_ns + round(seconds * 1e9)
    parts = {
        name: getattr(recording, name).between(recording.start_ns, end)
        for name in ("imu", "wheels", "gnss")
        if getattr(recording, name) is not None
    }
    return dataclasses.replace(recording, **parts)


def profile(recording: Recording, config: EstimatorConfig, rows: int = 30) -> str:
    """Where the live pass spends its time, by function with all it calls."""
    import cProfile
    import io
    import pstats

    profiler = cProfile.Profile()
    profiler.runcall(live, recording, config)
    out = io.StringIO()
    pstats.Stats(profiler, stream=out).sort_stats("cumulative").print_stats("fusion/", rows)
    return out.getvalue()


def main(arguments: list[str] | None = None) -> int:
    """The command line of the module's docstring."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.speed.speed")
    parser.add_argument(
        "logs", nargs="*", help="logs, as of `terrafusion replay`; by default a drive of the twin"
    )
    parser.add_argument("--vehicle", help="name or YAML file; by default what the log says")
    parser.add_argument("--profile", action="store_true", help="also the live pass by function")
    asked = parser.parse_args(arguments)
    try:
        for recording in _recordings(asked.logs):
            _report(recording, asked.vehicle, asked.profile)
    except TerrafusionError as error:
        print(f"error: {error}")
        return 1
    return 0


def _recordings(logs: list[str]) -> Iterator[Recording]:
    from terrafusion.datasets.readers import open_recording
    from terrafusion.twin.simulate import simulate

    if not logs:
        yield simulate(**SCENARIO)  # type: ignore[arg-type]
    for log in logs:
        yield open_recording(log)


def _report(recording: Recording, vehicle: str | None, with_profile: bool) -> None:
    from terrafusion.twin.model.choose import choose_vehicle

    robot, _ = choose_vehicle(recording, vehicle)
    config = EstimatorConfig(robot.rig(), robot.name)
    print(f"{recording.duration_s():.0f} s of {robot.name}, lag {config.lag_s:g} s, least of {PASSES} drives")
    taken = least(recording, config)
    assert taken.archive is not None
    for line in taken.lines():
        print(f"  {line}", flush=True)
    print("  with the states of a calibration")
    for line in least(recording, dataclasses.replace(config, calibrate=True)).lines():
        print(f"    {line}", flush=True)
    print(f"  batch: live pass {taken.seconds:.2f} s wall, {taken.cpu_s:.2f} s CPU, then")
    for name, (wall, cpu) in batch_parts(taken.archive, initial(taken)).items():
        print(f"    {name}: {wall:.3f} s wall, {cpu:.3f} s CPU", flush=True)
    for line in compare(recording, config, taken):
        print(f"  {line}", flush=True)
    if with_profile:
        print(profile(recording, config))


if __name__ == "__main__":
    raise SystemExit(main())
