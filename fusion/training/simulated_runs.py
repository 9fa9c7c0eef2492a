"""Simulated runs for training, and their windows as the estimator forms them."""

import copy
import dataclasses
import hashlib
import json
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.gauss_markov import markov_decay, markov_spread
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.scratch import scratch_folder
from terrafusion.datasets.core.yaml_file import dump_yaml
from terrafusion.fusion.terrain.features import Window
from terrafusion.twin.model.library import read_named
from terrafusion.twin.model.soil_table import PARAMS
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.scenario.file import load_scenario
from terrafusion.twin.simulate import simulate

GROUNDS = ("asphalt", "medium_sand", "loose_sand", "mud")
SCENARIOS = ("staircase", "figure_eight")
"""0.3 to 1.5 m/s straight ahead in steps, with stops; 0.8 m/s in circles to both sides."""
SLOPES_DEG = (0.0, 3.0, 6.0)
PAYLOADS_KG = (0.0, 30.0)
UPDATE_S = 0.5
WINDOW_S = 1.0
SLIP_SIGMA = 0.04
"""1 sigma of the estimator's slip at run time, and its correlation time `SLIP_ERROR_S`."""
SLIP_ERROR_S = 2.0

SOIL_SCATTER = {
    "pressure": {"k_c_n_per_m_n1": 0.2, "k_phi_n_per_m_n2": 0.2},
    "shear": {"cohesion_pa": 0.2, "friction_angle_rad": 0.1, "shear_modulus_m": 0.2, "friction_cap": 0.2},
    "vibration": {"accel_mps2_at_1mps": 0.2, "gyro_radps_at_1mps": 0.2},
}
"""Relative range from which the soil of each run is drawn."""


@dataclass(frozen=True)
class Condition:
    """One simulated run; heading and soil are drawn from the condition."""

    scenario: str
    terrain: str
    slope_deg: float
    payload_kg: float
    seed: int
    vehicle: str = "elevate"

    def run(self) -> Recording:
        """Simulate it."""
        rng = self.stream("drive")
        scenario = dataclasses.replace(
            load_scenario(self.scenario), heading_deg=float(rng.uniform(0.0, 360.0))
        )
        with scratch_folder() as folder:
            soil = scattered_soil(self.terrain, rng, folder)
            return simulate(
                scenario,
                vehicle=self.vehicle,
                terrain=str(soil),
                slope_deg=self.slope_deg,
                payload_kg=self.payload_kg,
                seed=self.seed,
            )

    def stream(self, name: str) -> np.random.Generator:
        """Random numbers of this condition for one purpose."""
        text = json.dumps([*dataclasses.astuple(self), name])
        return np.random.default_rng(zlib.crc32(text.encode()))


def scattered_soil(terrain: str, rng: np.random.Generator, folder: Path) -> Path:
    """A soil file in `folder`: the library's soil scattered by `SOIL_SCATTER` inside its valid ranges."""
    raw = copy.deepcopy(read_named("soils", terrain, kind="terrain")[0])
    for section, ranges in SOIL_SCATTER.items():
        for key, share in ranges.items():
            entry = raw[section][key]
            drawn = entry["value"] * float(rng.uniform(1.0 - share, 1.0 + share))
            low, high = entry.get("valid", (drawn, drawn))
            entry["value"] = min(max(drawn, low), high)
    return dump_yaml(folder / f"{terrain}.yaml", raw)


@dataclass(frozen=True)
class Grid:
    """Runs on every ground: scenarios (they set the speeds) x slopes x payloads x seeds."""

    scenarios: tuple[str, ...]
    slopes_deg: tuple[float, ...]
    payloads_kg: tuple[float, ...]
    seeds: tuple[int, ...]
    grounds: tuple[str, ...] = GROUNDS
    vehicle: str = "elevate"

    def conditions(self) -> list[Condition]:
        """All combinations, ground by ground."""
        return [
            Condition(scenario, ground, slope, payload, seed, self.vehicle)
            for ground in self.grounds
            for scenario in self.scenarios
            for slope in self.slopes_deg
            for payload in self.payloads_kg
            for seed in self.seeds
        ]

    def fingerprint(self, **settings: Any) -> str:
        """SHA-256 of the soil, scenario and vehicle files of the runs, and of all settings."""
        digest = hashlib.sha256()
        files = {"soils": self.grounds, "scenarios": self.scenarios, "vehicles": (self.vehicle,)}
        for folder, names in files.items():
            for name in sorted(names):
                digest.update(f"{folder}/{name}\n".encode())
                digest.update((PARAMS / folder / f"{name}.yaml").read_bytes())
        text = json.dumps(
            {"grid": dataclasses.asdict(self), "soil scatter": SOIL_SCATTER, **settings}, sort_keys=True
        )
        digest.update(text.encode())
        return digest.hexdigest()


def run_all(
    conditions: Iterable[Condition], tick: Callable[[], None]
) -> Iterator[tuple[Condition, Recording]]:
    """Simulate the conditions in turn; `tick` is called after each."""
    for condition in conditions:
        yield condition, condition.run()
        tick()


def seconds(t_ns: NDArray[np.int64], recording: Recording) -> Array:
    """Seconds (n,) from the recording's start."""
    return np.asarray((t_ns - recording.start_ns) * 1e-9, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class WheelSamples:
    """Wheels and truth on the wheels' clock (n,): side speeds (n, 2) m/s, true forward speed and yaw rate."""

    t_s: Array
    sides_mps: Array
    forward_mps: Array
    yaw_rate_radps: Array


def wheel_samples(recording: Recording) -> WheelSamples:
    """Wheels and truth of a run; a ValueError without wheels, or without a truth that has a body twist."""
    rig = load_vehicle(recording.vehicle or "elevate").rig()
    wheels, truth = recording.wheels, recording.truth
    if wheels is None or truth is None or truth.twist_body is None:
        raise ValueError(f"{recording.name}: wheels and a true twist are needed")
    t, truth_t = seconds(wheels.t_ns, recording), seconds(truth.t_ns, recording)
    return WheelSamples(
        t_s=t,
        sides_mps=wheels.side_speeds_mps(rig.wheel_radius_m),
        forward_mps=np.interp(t, truth_t, truth.twist_body[:, 0]),
        yaw_rate_radps=np.interp(t, truth_t, truth.twist_body[:, 5]),
    )


def windows_of(recording: Recording, rng: np.random.Generator) -> tuple[list[Window], NDArray[Any]]:
    """Windows every `UPDATE_S` and the ground (n,) at the end of each, by the recording's labels.

    Speed and slip of the estimator are simulated: true slip with a Gauss-Markov error of `SLIP_SIGMA` and
    `SLIP_ERROR_S`, true speed with a white error of 0.03 m/s.
    """
    imu, terrain = recording.imu, recording.terrain
    if imu is None or terrain is None:
        raise ValueError(f"{recording.name}: an IMU and terrain labels are needed")
    track = load_vehicle(recording.vehicle or "elevate").rig().track_m
    samples = wheel_samples(recording)
    imu_t = seconds(imu.t_ns, recording)
    label_t = seconds(terrain.t_ns, recording)
    mean = samples.sides_mps.mean(axis=1)
    yaw = (samples.sides_mps[:, 1] - samples.sides_mps[:, 0]) / track
    ends = np.arange(WINDOW_S, samples.t_s[-1], UPDATE_S)
    keep = markov_decay(UPDATE_S, SLIP_ERROR_S)
    error = rng.normal() * SLIP_SIGMA
    windows, labels = [], []
    for end in ends:
        rows = slice(*np.searchsorted(samples.t_s, [end - WINDOW_S, end]))
        recent = slice(*np.searchsorted(samples.t_s, [end - UPDATE_S, end]))
        around = slice(*np.searchsorted(imu_t, [end - WINDOW_S, end]))
        error = keep * error + markov_spread(keep) * SLIP_SIGMA * rng.normal()
        wheel, speed = float(mean[recent].mean()), float(samples.forward_mps[recent].mean())
        slip = 1.0 - speed / wheel + error if abs(wheel) > 1e-3 else None
        span = float(samples.t_s[rows][-1] - samples.t_s[rows][0])
        windows.append(
            Window(
                dt_s=UPDATE_S,
                imu_t_s=imu_t[around],
                gyro_radps=imu.gyro_radps[around],
                accel_mps2=imu.accel_mps2[around],
                wheel_speed_mps=wheel,
                wheel_speed_rate_mps2=float(mean[rows][-5:].mean() - mean[rows][:5].mean()) / span,
                speed_mps=speed + 0.03 * rng.normal(),
                yaw_rate_wheels_radps=float(yaw[rows].mean()),
                yaw_rate_gyro_radps=float(imu.gyro_radps[around, 2].mean()),
                slip=slip,
                slip_sigma=None if slip is None else SLIP_SIGMA,
            )
        )
        labels.append(terrain.label[max(int(np.searchsorted(label_t, end, side="right")) - 1, 0)])
    return windows, np.array(labels)
