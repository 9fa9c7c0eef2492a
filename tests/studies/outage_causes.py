"""What makes the error at the end of the demo's outage, for fixed, adaptive and noise that knows the truth?

    python -m tests.studies.outage_causes

The error gained in the outage is the sum of four integrals over its keyframes, of the estimated less the true
motion: along the robot (slip), across it (side-slip), what a wrong heading turns of the true motion, and the
rest (corrections of the path where smoothing moves it). Their sum with the error at the start is the error
at the end. "Known" arms replace one number of the noise in force by its true value; they bound what
any weighting could reach. Drives of `DEVELOP` served development, those of `JUDGE` did not.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import terrafusion.fusion.estimator.estimator as estimator_module
from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.bootstrap import percentile_interval
from terrafusion.datasets.core.frames import quaternion_to_matrix
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.benchmark.methods import true_labels
from terrafusion.fusion.benchmark.twin_runs import BenchmarkCase, simulate_case
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.noise.policy import SensorNoise
from terrafusion.fusion.replay import replay
from terrafusion.fusion.training.simulated_runs import wheel_samples
from terrafusion.fusion.weighting.adaptive import TerrainNoise
from terrafusion.twin.simulate import simulate
from tests.studies.parts import TaskWorkers, add_options, answers

DEMO_OUTAGE = Outage(75.0, 60.0)
DEVELOP = {"demo": range(1000, 1020), "mixed": range(100_000, 100_010)}
JUDGE = {"demo": range(100, 120), "mixed": range(200_000, 200_010)}
"""Seeds, written down before anything was changed; "demo" is the demo's drive, "mixed" the benchmark's."""
CAUSES = ("start", "slip", "side-slip", "heading", "corrections")
LEAST_MPS = 0.15
KNOWN_SLIP_SIGMA, KNOWN_SLIP_TIME_S = 0.005, 0.05


@dataclass(frozen=True, eq=False)
class Truth:
    """The true motion of a drive: slip (smoothed over .5 s), and its mean on each ground."""

    t_ns: Array
    slip: Array
    ground: Array
    mean: dict[str, float]

    @classmethod
    def of(cls, log: Recording, outage: Outage) -> Truth:
        """Slip from wheels and truth; means over the outage."""
        wheels = log.wheels
        assert wheels is not None
        samples = wheel_samples(log)
        rolled, t = samples.sides_mps.mean(axis=1), wheels.t_ns.astype(float)
        width = max(round(0.5 / float(np.median(np.diff(t)) * 1e-9)), 1)
        kernel = np.ones(width) / width
        wheel, robot = (np.convolve(x, kernel, "same") for x in (rolled, samples.forward_mps))
        driving = np.abs(wheel) > LEAST_MPS
        slip = np.where(driving, 1.0 - robot / np.where(driving, wheel, 1.0), 0.0)
        labels = true_labels(log)
        assert labels is not None
        ground = np.array([labels.at(int(x)) for x in t])
        inside = outage.covers(wheels.t_ns, log.start_ns)
        mean = {}
        for name in set(ground.tolist()):
            rows = (ground == name) & inside & driving
            if rows.any():
                mean[name] = 1.0 - float(robot[rows].sum() / wheel[rows].sum())
        return cls(t, slip, ground, mean)

    def at(self, t_ns: int) -> tuple[float, str]:
        """Slip and ground."""
        i = min(int(np.searchsorted(self.t_ns, t_ns)), len(self.t_ns) - 1)
        return float(self.slip[i]), str(self.ground[i])


Known = Callable[[SensorNoise, int], SensorNoise]
"""Noise in force and time -> noise with what the arm knows."""


def knows_slip(truth: Truth) -> Known:
    """The true slip at every keyframe."""

    def known(noise: SensorNoise, t_ns: int) -> SensorNoise:
        slip = float(np.clip(truth.at(t_ns + 50_000_000)[0], -0.9, 0.9))
        return dataclasses.replace(
            noise, slip_mean=slip, slip_per_grade=0.0, slip_sigma=KNOWN_SLIP_SIGMA,
            slip_time_s=KNOWN_SLIP_TIME_S,
        )  # fmt: skip

    return known


def knows_means(truth: Truth) -> Known:
    """The true mean slip of each ground in the outage of this drive."""

    def known(noise: SensorNoise, t_ns: int) -> SensorNoise:
        mean = truth.mean.get(truth.at(t_ns)[1], noise.slip_mean)
        return dataclasses.replace(noise, slip_mean=float(np.clip(mean, -0.9, 0.9)))

    return known


@contextmanager
def knowing(known: Known | None) -> Iterator[None]:
    """Estimators made inside take their noise through `known`."""
    if known is None:
        yield
        return

    class KnowingNoise(TerrainNoise):
        @property
        def noise(self) -> SensorNoise:
            return known(self.own, self.now_ns)

        @noise.setter
        def noise(self, value: SensorNoise) -> None:
            self.own = value

        now_ns = 0

    original = estimator_module.TerrainNoise
    estimator_module.TerrainNoise = KnowingNoise  # type: ignore[misc]
    try:
        yield
    finally:
        estimator_module.TerrainNoise = original  # type: ignore[misc]


def tell_time(estimator: Any) -> None:
    """After every keyframe: the time, for `KnowingNoise`."""
    estimator.weights.now_ns = estimator.chain.nodes[-1].t_ns


def terms(log: Recording, estimate: Any, outage: Outage) -> Array:
    """(5, 2) the `CAUSES` of the error at the end, m, east and north."""
    truth, path = log.truth, estimate.trajectory
    assert truth is not None
    assert truth.twist_body is not None
    assert truth.quaternion is not None
    rows = np.flatnonzero(outage.covers(path.t_ns, log.start_ns))
    t_ns = path.t_ns[rows]
    at, t = truth.t_ns.astype(float), t_ns.astype(float)
    place = np.column_stack([np.interp(t, at, truth.position_m[:, i]) for i in (0, 1)])
    body = np.column_stack([np.interp(t, at, truth.twist_body[:, i]) for i in (0, 1)])
    R = quaternion_to_matrix(truth.quaternion)
    yaw_of = np.unwrap(np.arctan2(R[:, 1, 0], R[:, 0, 0]))
    yaw = np.interp(t, at, yaw_of)
    E = quaternion_to_matrix(path.quaternion[rows])
    yaw_e = np.arctan2(E[:, 1, 0], E[:, 0, 0])
    own = np.einsum("nij,ni->nj", E, estimate.velocity_mps[rows])[:, :2]
    ahead, left = (
        np.column_stack([np.cos(yaw_e), np.sin(yaw_e)]),
        np.column_stack([-np.sin(yaw_e), np.cos(yaw_e)]),
    )
    true_ahead = np.column_stack([np.cos(yaw), np.sin(yaw)])
    true_left = np.column_stack([-np.sin(yaw), np.cos(yaw)])
    rates = np.stack(
        [
            (own[:, :1] - body[:, :1]) * ahead,
            (own[:, 1:] - body[:, 1:]) * left,
            body[:, :1] * (ahead - true_ahead) + body[:, 1:] * (left - true_left),
        ]
    )
    dt = np.diff(t_ns) * 1e-9
    sums = (0.5 * (rates[:, 1:] + rates[:, :-1]) * dt[:, None]).sum(axis=1)
    error = path.position_m[rows, :2] - place
    rest = error[-1] - error[0] - sums.sum(axis=0)
    return np.vstack([error[:1], sums, rest])


def drive_of(family: str, seed: int) -> tuple[Recording, Outage]:
    """The log and its outage."""
    if family == "demo":
        return simulate("demo", seed=seed), DEMO_OUTAGE
    run = simulate_case(BenchmarkCase(family, "twin", seed))
    assert run.outage is not None
    return run.recording, run.outage


def arms_of(log: Recording, outage: Outage) -> dict[str, tuple[str, Known | None, dict[str, Any]]]:
    """Name -> mode, what is known, settings."""
    truth, labels = Truth.of(log, outage), true_labels(log)
    true = {"labels": labels}
    return {
        "fixed": ("fixed", None, {}),
        "fixed, knows slip": ("fixed", knows_slip(truth), {}),
        "adaptive": ("adaptive", None, {}),
        "adaptive, knows ground": ("adaptive", None, true),
        "adaptive, knows ground's mean slip": ("adaptive", knows_means(truth), true),
        "adaptive, knows slip": ("adaptive", knows_slip(truth), true),
    }


def replayed(log: Recording, outage: Outage, mode: str, known: Known | None, settings: Any) -> Any:
    """The estimate of one arm."""
    with knowing(known):
        return replay(
            log, mode=mode, outages=[outage], settings=settings, watch=tell_time, findings=()
        ).estimate


def causes(drive: tuple[str, int, str | None]) -> dict[str, Any]:
    """The terms of one drive by arm: family, seed, and the arms that are wanted."""
    family, seed, wanted = drive
    log, outage = drive_of(family, seed)
    return {
        arm: terms(log, replayed(log, outage, mode, known, settings), outage).tolist()
        for arm, (mode, known, settings) in arms_of(log, outage).items()
        if wanted is None or arm in wanted.split(";")
    }


def ratio(errors: Array, fixed: Array) -> str:
    """Geometric mean of the ratio and its 95 % interval over drives."""
    logs = np.log(errors / fixed)
    draws = np.random.default_rng(0).choice(logs, (4000, len(logs))).mean(axis=1)
    low, high = percentile_interval(np.exp(draws))
    return f"{np.exp(logs.mean()):.2f} [{low:.2f}, {high:.2f}]"


def report(family: str, found: dict[str, list[Array]]) -> None:
    """One line an arm: error at the end, over fixed, and the length of each cause."""
    print(f"{'':42s} end, m   over fixed            " + " ".join(f"{c:>11s}" for c in CAUSES))
    ends = {arm: np.linalg.norm(np.array(rows).sum(axis=1), axis=1) for arm, rows in found.items()}
    for arm, rows in found.items():
        lengths = np.sqrt(np.mean(np.sum(np.array(rows) ** 2, axis=2), axis=0))
        print(
            f"{family + ' ' + arm:42s} {np.median(ends[arm]):6.2f}   {ratio(ends[arm], ends['fixed']):20s}  "
            + " ".join(f"{x:11.2f}" for x in lengths),
            flush=True,
        )


def main() -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.outage_causes", description=__doc__)
    parser.add_argument("--develop", action="store_true", help="the seeds that served development")
    parser.add_argument("--family", choices=tuple(JUDGE), help="this one alone")
    parser.add_argument("--arms", help="those that begin with one of these words, by commas")
    parser.add_argument("--drives", type=int, default=1000)
    parser.add_argument("--out", type=Path, help="folder for parts; the same command continues")
    add_options(parser)
    given = parser.parse_args()
    for family, seeds in (DEVELOP if given.develop else JUDGE).items():
        if given.family not in (None, family):
            continue
        found: dict[str, list[Array]] = {}
        drives = [(family, seed, given.arms) for seed in list(seeds)[: given.drives]]
        for answer in answers(drives, causes, TaskWorkers.of(given), given.out):
            for arm, rows in answer.items():
                found.setdefault(arm, []).append(np.array(rows))
        report(family, found)
    return 0


if __name__ == "__main__":
    from tests.studies import outage_causes

    raise SystemExit(outage_causes.main())  # workers know the drives by the module's own name
