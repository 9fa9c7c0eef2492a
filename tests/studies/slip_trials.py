"""Trials of `monitor` on drives of the twin: false alarms, delays, and the error of slip.

    python -m tests.studies.slip_trials --seeds 5

prints the tables of docs/explanation/monitor.md.
"""

from __future__ import annotations

import argparse
import copy
import dataclasses
import functools
import tempfile
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.estimate.estimate import Estimate
from terrafusion.fusion.metrics.pooled_consistency import mean_interval
from terrafusion.fusion.replay import replay
from terrafusion.twin.model.library import read_named
from terrafusion.twin.model.vehicle import VehicleParams, load_vehicle
from terrafusion.twin.scenario.file import load_scenario
from terrafusion.twin.scenario.scenario import RouteLeg, Scenario
from terrafusion.twin.simulate import simulate
from tests.studies.parts import TaskWorkers, add_options, answers

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

STRAIGHT = ("straight", "staircase", "paper_profile")
FIRM = ("asphalt", "medium_sand")
COARSE_QUANTUM_RAD, COARSE_HZ = 0.02, 10.0
"""Encoders as some field logs have them."""
VETO = 0.1
"""Slip at which the naive test of single samples fires."""
ROLLING_MPS = 0.1
"""Slip is scored where the wheels turn at more than this."""
STOPPED_MPS = 0.05
MOVING_MPS = 0.2
"""The error of slip is scored where the robot moves faster."""
KEYFRAME_S = 0.1
TABLES = ("alarms", "delays", "slip")
ENCODERS = ("fine", "coarse")


def coarse_vehicle(folder: Path) -> Path:
    """A vehicle file in `folder`: elevate with encoders of 0.02 rad read at 10 Hz."""
    from ruamel.yaml import YAML

    raw = copy.deepcopy(read_named("vehicles", "elevate", kind="vehicle")[0])
    wheels = raw["sensors"]["wheels"]
    wheels["quantum_rad"]["value"], wheels["rate_hz"]["value"] = COARSE_QUANTUM_RAD, COARSE_HZ
    path = folder / "coarse.yaml"
    with path.open("w", encoding="utf-8") as out:
        YAML(typ="safe", pure=True).dump(raw, out)
    return path


def spinning_hill(slope_deg: float = 20.0) -> Scenario:
    """From medium sand onto loose sand on a slope that its shear strength does not carry: the wheels spin."""
    route = (RouteLeg("medium_sand", 15.0), RouteLeg("loose_sand"))
    return dataclasses.replace(load_scenario("straight"), name="hill", route=route, slope_deg=slope_deg)


def true_slip(
    recording: Recording, vehicle: VehicleParams, t_ns: NDArray[np.int64]
) -> tuple[Array, Array, Array]:
    """Slip 1 - v / (omega R), wheel speed and body speed (n,) at times, from the true motion.

    `recording` must be noiseless; slip is NaN where the wheels turn slower than `ROLLING_MPS`.
    """
    wheels, truth = recording.wheels, recording.truth
    assert wheels is not None
    assert truth is not None
    assert truth.twist_body is not None
    half_ns = 0.5e9 / vehicle.sensors.wheels.rate_hz  # encoders report the mean since the sample before
    rim = np.interp(t_ns, wheels.t_ns - half_ns, wheels.side_speeds_mps(vehicle.wheel.radius_m).mean(axis=1))
    speed = np.interp(t_ns, truth.t_ns, truth.twist_body[:, 0])
    rolling = np.abs(rim) > ROLLING_MPS
    return np.where(rolling, 1.0 - speed / np.where(rolling, rim, 1.0), np.nan), rim, speed


def alarms(flags: Flags) -> int:
    """How often a flag is raised."""
    return int(np.sum(flags[1:] & ~flags[:-1])) + int(flags[:1].sum())


def poisson_interval(count: int, seconds: float) -> tuple[float, float]:
    """Exact 95 % interval of a rate (1/h) from a count (Garwood 1936, Biometrika 28)."""
    from scipy.stats import chi2

    hours = seconds / 3600.0
    low = 0.5 * chi2.ppf(0.025, 2 * count) / hours if count else 0.0
    return float(low), float(0.5 * chi2.ppf(0.975, 2 * count + 2) / hours)


def naive_alarms(recording: Recording, estimate: Estimate, vehicle: VehicleParams) -> int:
    """Alarms of a test of single samples: wheel speed as reported against estimated speed, 10 % apart."""
    wheels, path = recording.wheels, estimate.trajectory
    assert wheels is not None
    assert path.twist_body is not None
    rim = wheels.side_speeds_mps(vehicle.wheel.radius_m).mean(axis=1)
    speed = np.interp(wheels.t_ns, path.t_ns, path.twist_body[:, 0])
    inside = (wheels.t_ns >= path.t_ns[0]) & (wheels.t_ns <= path.t_ns[-1]) & (np.abs(speed) > ROLLING_MPS)
    return alarms(inside & (np.abs(rim - speed) > VETO * np.abs(speed)))


@dataclass(frozen=True)
class Count:
    """Alarms on drives without slip: of the monitor, of the naive test, and of immobilisation."""

    seconds: float = 0.0
    slipping: int = 0
    naive: int = 0
    immobilised: int = 0

    def __add__(self, other: Count) -> Count:
        pairs = zip(dataclasses.astuple(self), dataclasses.astuple(other), strict=True)
        return Count(*(a + b for a, b in pairs))


def count_alarms(vehicle: str, seed: int, gnss: bool = True) -> Count:
    """All straight drives on firm ground with one seed."""
    params = load_vehicle(vehicle)
    total = Count()
    for ground in FIRM:
        for scenario in STRAIGHT:
            recording = simulate(scenario, vehicle=params, terrain=ground, seed=seed)
            given = recording if gnss else dataclasses.replace(recording, gnss=None)
            estimate = replay(given, vehicle=vehicle).estimate
            assert estimate.slipping is not None
            assert estimate.immobilised is not None
            total += Count(
                recording.duration_s(),
                alarms(estimate.slipping),
                naive_alarms(recording, estimate, params),
                alarms(estimate.immobilised),
            )
    return total


@dataclass(frozen=True)
class Told:
    """When something began and when it was told, seconds from the start; None: never."""

    onset_s: float
    told_s: float | None


def delays_text(found: Sequence[Told]) -> str:
    """Mean delay with the 95 % of its bootstrap over the trials, the longest, and how many were told."""
    late = np.array([told.told_s - told.onset_s for told in found if told.told_s is not None])
    if not len(late):
        return f"never told in {len(found)}"
    low, high = mean_interval(late)
    told = f"{late.mean():.2f} s late [{low:.2f}, {high:.2f}], at most {late.max():.2f} s"
    return f"{told}; told in {len(late)} of {len(found)}"


def _first(estimate: Estimate, flags: Flags, start_ns: int, after_s: float) -> float | None:
    t_s = (estimate.trajectory.t_ns - start_ns) * 1e-9
    raised = t_s[flags & (t_s >= after_s)]
    return float(raised[0]) if raised.size else None


def stuck_trial(scenario: str | Scenario, terrain: str | None, vehicle: str, seed: int, gnss: bool) -> Told:
    """A robot that gets stuck: from when it stands for good (true speed below `STOPPED_MPS`)."""
    recording = simulate(scenario, vehicle=load_vehicle(vehicle), terrain=terrain, seed=seed)
    truth = recording.truth
    assert truth is not None
    assert truth.twist_body is not None
    moving = np.flatnonzero(truth.twist_body[:, 0] > STOPPED_MPS)
    onset = float(truth.t_ns[moving[-1] + 1] - recording.start_ns) * 1e-9
    given = recording if gnss else dataclasses.replace(recording, gnss=None)
    estimate = replay(given, vehicle=vehicle).estimate
    assert estimate.immobilised is not None
    return Told(onset, _first(estimate, estimate.immobilised, recording.start_ns, onset - 1.0))


def slip_trial(vehicle: str, seed: int, gnss: bool = True) -> Told:
    """Loose sand on 5 deg: from when the slip first exceeds 0.2."""
    params = load_vehicle(vehicle)
    drive = {"vehicle": params, "terrain": "loose_sand", "slope_deg": 5.0}
    recording = simulate("paper_profile", seed=seed, **drive)  # type: ignore[arg-type]
    exact = simulate("paper_profile", noiseless=True, **drive)  # type: ignore[arg-type]
    given = recording if gnss else dataclasses.replace(recording, gnss=None)
    estimate = replay(given, vehicle=vehicle).estimate
    assert estimate.slipping is not None
    assert exact.truth is not None
    slip, _, _ = true_slip(exact, params, exact.truth.t_ns)
    onset = float(exact.truth.t_ns[np.flatnonzero(slip > 0.2)[0]] - exact.start_ns) * 1e-9
    return Told(onset, _first(estimate, estimate.slipping, recording.start_ns, 0.0))


def mean_slip(exact: Recording, vehicle: VehicleParams, t_ns: NDArray[np.int64], span_s: float) -> Array:
    """Slip (n,) over the `span_s` before each time, as a keyframe has it: of the ways of wheels and robot.

    `exact` must be noiseless; NaN where the robot moves slower than `MOVING_MPS`: at breakaway wheels turn
    under a robot that stands, and a ratio of ways says little.
    """
    assert exact.truth is not None
    _, rim, speed = true_slip(exact, vehicle, exact.truth.t_ns)
    t_s = (exact.truth.t_ns - exact.start_ns) * 1e-9
    end_s = (t_ns - exact.start_ns) * 1e-9
    ways = []
    for rate in (rim, speed):
        way = np.append(0.0, np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(t_s)))
        ways.append(np.interp(end_s, t_s, way) - np.interp(end_s - span_s, t_s, way))
    rolled, moved = ways
    moving = (np.abs(moved) > MOVING_MPS * span_s) & (np.abs(rolled) > ROLLING_MPS * span_s)
    return np.where(moving, 1.0 - moved / np.where(moving, rolled, 1.0), np.nan)


def slip_rmse(ground: str, slope_deg: float, seed: int, batch: bool) -> float:
    """Error of the estimated slip, percentage points, over all keyframes where the robot moves."""
    params = load_vehicle("elevate")
    recording = simulate("paper_profile", vehicle=params, terrain=ground, slope_deg=slope_deg, seed=seed)
    exact = simulate("paper_profile", vehicle=params, terrain=ground, slope_deg=slope_deg, noiseless=True)
    estimate = replay(recording, batch=batch).estimate
    slip = mean_slip(exact, params, estimate.trajectory.t_ns, KEYFRAME_S)
    return 100.0 * float(np.sqrt(np.nanmean((estimate.slip - slip) ** 2)))


def coarse_or_fine(trial: tuple[str, str, bool, int]) -> list[float | None]:
    """The numbers of one trial: its name in `TRIALS`, encoders, whether there are fixes, and the seed."""
    name, encoders, gnss, seed = trial
    with tempfile.TemporaryDirectory() as folder:
        vehicle = "elevate" if encoders == "fine" else str(coarse_vehicle(Path(folder)))
        return list(dataclasses.astuple(TRIALS[name](vehicle, seed, gnss)))


def slip_error(trial: tuple[str, float, int, bool]) -> float:
    """`slip_rmse` of one trial."""
    return slip_rmse(*trial)


def _stalled(vehicle: str, seed: int, gnss: bool) -> Told:
    return stuck_trial("paper_profile", "mud", vehicle, seed, gnss)


def _spinning(vehicle: str, seed: int, gnss: bool) -> Told:
    return stuck_trial(spinning_hill(), None, vehicle, seed, gnss)


TRIALS: dict[str, Callable[[str, int, bool], Count | Told]] = {
    "alarms": count_alarms,
    "slip, loose sand 5 deg": slip_trial,
    "stalled in mud": _stalled,
    "spinning, loose sand 20 deg": _spinning,
}
SLIP_GROUNDS = (("mud", 0.0), ("loose_sand", 5.0), ("medium_sand", 5.0), ("asphalt", 0.0))
Answers = Callable[[Sequence[Any], Callable[[Any], Any]], list[Any]]


def report(
    seeds: int, tables: Collection[str], encoders: Collection[str], aiding: Collection[bool], answers: Answers
) -> Iterator[str]:  # fmt: skip
    """The tables, line by line; `aiding` says whether there are fixes."""
    given = [(name, gnss) for name in encoders for gnss in aiding]

    def found(what: str, name: str, gnss: bool) -> list[list[Any]]:
        return answers([(what, name, gnss, seed) for seed in range(seeds)], coarse_or_fine)

    if "alarms" in tables:
        yield "false alarms, straight on firm ground"
        for name, gnss in given:
            counts = sum((Count(*row) for row in found("alarms", name, gnss)), Count())
            yield f"  {name}, {_aid(gnss)}: {_alarm_text(counts)}"
    if "delays" in tables:
        yield "told late"
        for name, gnss in given:
            for what in list(TRIALS)[1:]:
                told = [Told(*row) for row in found(what, name, gnss)]
                yield f"  {name}, {_aid(gnss)}: {what}: {delays_text(told)}"
    if "slip" in tables:
        yield "slip RMSE, points, paper_profile: filtered, smoothed"
        few = range(min(seeds, 3))
        for ground, slope in SLIP_GROUNDS:
            errors = answers([(ground, slope, s, batch) for batch in (False, True) for s in few], slip_error)
            filtered, smoothed = np.mean(errors[: len(few)]), np.mean(errors[len(few) :])
            yield f"  {ground} {slope:.0f} deg: {filtered:.2f}, {smoothed:.2f}"


def _aid(gnss: bool) -> str:
    return "GNSS" if gnss else "no GNSS"


def _alarm_text(c: Count) -> str:
    slip, stuck = poisson_interval(c.slipping, c.seconds), poisson_interval(c.immobilised, c.seconds)
    return (
        f"{c.seconds / 60.0:.1f} min; slip {c.slipping} ({slip[0]:.1f} to {slip[1]:.1f} /h); "
        f"immobilised {c.immobilised} ({stuck[0]:.1f} to {stuck[1]:.1f} /h); "
        f"naive {c.naive} ({c.naive / c.seconds:.3f} /s)"
    )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5, help="of each trial (5: 77 min of straight driving)")
    parser.add_argument("--tables", nargs="+", choices=TABLES, default=TABLES, help="which of them")
    parser.add_argument("--encoders", nargs="+", choices=ENCODERS, default=ENCODERS, help="which of them")
    parser.add_argument("--gnss-only", action="store_true", help="leave out the drives without GNSS")
    parser.add_argument("--out", type=Path, help="folder for parts; the same command continues")
    add_options(parser)
    given = parser.parse_args()
    aiding = (True,) if given.gnss_only else (True, False)
    kept = functools.partial(answers, workers=TaskWorkers.of(given), out=given.out)
    for line in report(given.seeds, given.tables, given.encoders, aiding, kept):
        print(line, flush=True)


if __name__ == "__main__":
    from tests.studies import slip_trials

    slip_trials.main()  # workers know the trials by the module's own name
