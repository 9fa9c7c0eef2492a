"""Twin and plant on one drive, without noise or effects: how far their nominal forms lie apart.

python -m tests.studies.blind.plant_against_twin
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.blind.plant.run import simulate
from terrafusion.twin.gap.blind.plant.spec import RunSpec, Segment
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.physics.layout import INDEX, state_slice
from terrafusion.twin.scenario.file import load_scenario
from terrafusion.twin.scenario.scenario import DriveSegment
from terrafusion.twin.simulate import SimulatedRun, simulate_run

Array = NDArray[np.float64]

DRIVE = (
    Segment(3.0), Segment(9.0, 1.0), Segment(9.0, 1.0, 0.3), Segment(9.0, 0.0, 0.8), Segment(9.0, 1.6),
    Segment(4.0),
)  # fmt: skip
SETTLED_S = 2.5
"""A segment counts as steady from here on: commands ramp at 1.5 m/s2 and 3 rad/s2."""
SOILS = ("asphalt", "medium_sand", "gravel", "grass", "loose_sand")


def steady_differences(soils: Sequence[str], vehicle: str = "elevate") -> dict[str, dict[str, float]]:
    """Largest difference of segment means where the drive is steady, and the path's at its end, by soil.

    Returns:
        `u` m/s, `r` rad/s, `wheel` rad/s (each side), `current` A (each side), `yaw` rad and `path_m` at the
        end.
    """
    robot = load_vehicle(vehicle)
    plant = simulate([RunSpec(robot, load_soil(soil), DRIVE, noiseless=True) for soil in soils])
    told = tuple(
        DriveSegment(duration_s=s.duration_s, v_mps=s.v_mps, yaw_rate_radps=s.yaw_rate_radps) for s in DRIVE
    )
    seconds = sum(s.duration_s for s in DRIVE)
    scenario = dataclasses.replace(load_scenario("straight"), drive=told, duration_s=seconds)
    return {
        soil: _between(simulate_run(scenario, vehicle=robot, terrain=soil, noiseless=True), h)
        for soil, h in zip(soils, plant, strict=True)
    }


def _between(run: SimulatedRun, h: dict[str, Array]) -> dict[str, float]:
    x, motor = run.states, run.recording.motor
    assert motor is not None
    wheel = x[:, state_slice("wheel_speed")][:, :2]
    amps = h["current"][:, :2] + h["current"][:, 2:]
    pairs = {
        "u": (x[:, INDEX["u"]], h["u"]), "r": (x[:, INDEX["r"]], h["r"]), "wheel": (wheel, h["speed"][:, :2]),
    }  # fmt: skip
    found = {name: _largest(a - b, 100.0) for name, (a, b) in pairs.items()}
    found["current"] = _largest(motor.current_a - amps[::2][: len(motor.current_a)], 50.0)
    found["yaw"] = abs(float(x[-1, INDEX["yaw"]] - h["yaw"][-1]))
    end = x[-1, [INDEX["x"], INDEX["y"]]] - np.array([h["x"][-1], h["y"][-1]])
    return found | {"path_m": float(np.hypot(*end))}


def _largest(difference: Array, rate_hz: float) -> float:
    """Largest mean over the steady part of a segment, absolute."""
    ends = np.cumsum([s.duration_s for s in DRIVE])
    parts = [
        difference[round((end - s.duration_s + SETTLED_S) * rate_hz) : round(end * rate_hz) - 1]
        for s, end in zip(DRIVE, ends, strict=True)
    ]
    return max(float(np.abs(part.mean(axis=0)).max()) for part in parts)


if __name__ == "__main__":
    print("soil          u m/s   r rad/s  wheel rad/s  current A  yaw rad  path m")
    for name, d in steady_differences(SOILS).items():
        print(
            f"{name:12s} {d['u']:7.4f} {d['r']:9.4f} {d['wheel']:12.4f} {d['current']:10.3f} "
            f"{d['yaw']:8.3f} {d['path_m']:7.2f}"
        )
