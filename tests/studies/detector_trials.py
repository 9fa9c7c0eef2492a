"""How well are grounds told apart, on fresh drives, with sensors missing, on grounds never seen?

python -m tests.studies.detector_trials
"""

import dataclasses
from collections.abc import Callable

import numpy as np

from terrafusion.fusion.cli.terrain import score_lines
from terrafusion.fusion.terrain.classifier import TerrainModel, load_terrain_model
from terrafusion.fusion.terrain.features import Window
from terrafusion.fusion.training.detector_scores import (
    DetectorScores,
    LabelledRoute,
    changes_in,
    evaluate,
)
from terrafusion.fusion.training.simulated_runs import GROUNDS, Condition, windows_of
from terrafusion.fusion.training.train_detector import FRESH_SEED, fresh_routes
from terrafusion.twin.simulate import simulate

MIXED_RUNS = 4
SLOW_HZ = 30.0
"""Rate of the slowest IMU among the field logs."""


def run(
    model: TerrainModel, seeds: int, tick: Callable[[], None] = lambda: None
) -> dict[str, DetectorScores]:
    """Scores by test; `tick` is called after each simulated run.

    - spliced: routes spliced from new runs on single grounds;
    - no slip: the same without slip, as in a GNSS outage;
    - slow IMU: the same with an IMU of 30 Hz;
    - foreign: the same for a robot unknown to the model with twice the vibration; firm ground is unknown;
    - mixed route: simulated runs over several grounds;
    - without X: ground X left out of the model and expected to be unknown.
    """
    routes = fresh_routes(seeds, tick)
    mixed = [_mixed(MIXED_RUNS * FRESH_SEED + number, tick) for number in range(MIXED_RUNS * seeds)]
    foreign = model.for_vehicle(None)
    firm = sorted(set(model.classes) - set(foreign.classes))
    scores = {
        "spliced": evaluate(model, routes),
        "no slip": evaluate(model, [_changed(r, _without_slip) for r in routes]),
        "slow IMU": evaluate(model, [_changed(r, _slow) for r in routes]),
        "foreign": evaluate(foreign, [_relabelled(_changed(r, _louder), *firm) for r in routes]),
        "mixed route": evaluate(model, mixed),
    }
    for ground in GROUNDS:
        fewer = {name: mixture for name, mixture in model.classes.items() if name != ground}
        scores[f"without {ground}"] = evaluate(
            dataclasses.replace(model, classes=fewer), [_relabelled(r, ground) for r in routes]
        )
    return scores


def _mixed(seed: int, tick: Callable[[], None]) -> LabelledRoute:
    recording = simulate("mixed_terrain", seed=seed)
    tick()
    stream = Condition("mixed_terrain", "mixed", 0.0, 0.0, seed).stream("estimator")
    return changes_in(*windows_of(recording, stream))


def _changed(route: LabelledRoute, change: Callable[[Window], Window]) -> LabelledRoute:
    return dataclasses.replace(route, windows=[change(w) for w in route.windows])


def _relabelled(route: LabelledRoute, *grounds: str) -> LabelledRoute:
    labels = np.where(np.isin(route.labels, grounds), "unknown", route.labels)
    return dataclasses.replace(route, labels=labels)


def _without_slip(window: Window) -> Window:
    return dataclasses.replace(window, slip=None, slip_sigma=None)


def _louder(window: Window) -> Window:
    """Twice the vibration, the same yaw rate."""
    accel = 2.0 * window.accel_mps2
    gyro = window.gyro_radps * np.array([2.0, 2.0, 1.0])
    return dataclasses.replace(window, accel_mps2=accel, gyro_radps=gyro)


def _slow(window: Window) -> Window:
    """The IMU at `SLOW_HZ`, each sample the mean over its interval, as of an integrating sensor."""
    t = window.imu_t_s
    if len(t) < 2:
        return window
    ticks = np.arange(t[0], t[-1], 1.0 / SLOW_HZ)
    cuts = np.searchsorted(t, ticks)
    sizes = np.diff(np.append(cuts, len(t)))[:, None]
    return dataclasses.replace(
        window,
        imu_t_s=ticks,
        gyro_radps=np.add.reduceat(window.gyro_radps, cuts) / sizes,
        accel_mps2=np.add.reduceat(window.accel_mps2, cuts) / sizes,
    )


def main() -> int:
    """Print the scores of the shipped model."""
    for name, scores in run(load_terrain_model(), 1).items():
        print("\n".join([*score_lines(name, scores), ""]))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
