"""Batched runs of the plant: specs in, `Recording`s out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.channels import Command, Terrain
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.gap.blind.plant import sensors
from terrafusion.twin.gap.blind.plant.commands import commanded_twist, side_commands
from terrafusion.twin.gap.blind.plant.field import PlantSoilField
from terrafusion.twin.gap.blind.plant.machine import Machine
from terrafusion.twin.gap.blind.plant.spec import RunSpec, stacked_numbers

Array = NDArray[np.float64]

FRAME_S = 0.01
SUBSTEPS = 4
COMMAND_HZ = 50.0
GUST_S = 3.0
_BODY = ("x", "y", "z", "yaw", "u", "v", "r", "lean_x", "lean_y", "motor_work")
_WHEEL = ("angle", "speed", "torque", "play")
_FRAME = ("pull_u", "pull_v", "normal", "rise_x", "rise_y", "cg_forward", "cg_left")


def record(
    specs: Sequence[RunSpec], *, substeps: int = SUBSTEPS, names: Sequence[str] = ()
) -> list[Recording]:
    """The logs of all runs, in their order. Runs of one call take the time of the longest.

    Args:
        specs: of one duration.
        substeps: integration steps a frame of 10 ms.
        names: of the recordings, else run-1 and so on.

    Raises:
        ConfigError: durations differ.
    """
    histories = simulate(specs, substeps=substeps)
    names = names or [f"run-{i + 1}" for i in range(len(specs))]
    return [_recording(spec, h, name) for spec, h, name in zip(specs, histories, names, strict=True)]


def simulate(specs: Sequence[RunSpec], *, substeps: int = SUBSTEPS) -> list[sensors.History]:
    """The motion of each run, at frames of 10 ms: arrays (N,) or (N, 4) by name, SI units.

    Raises:
        ConfigError: durations differ.
    """
    duration = specs[0].duration_s()
    if any(abs(spec.duration_s() - duration) > 1e-9 for spec in specs):
        raise ConfigError("runs that are computed together must last equally long")
    n = stacked_numbers(specs)
    t_s: Array = np.asarray(FRAME_S * np.arange(round(duration / FRAME_S) + 1), dtype=np.float64)
    machine = Machine(n, PlantSoilField(specs), _gusts(specs, len(t_s)))
    sides = side_commands(specs, n, t_s)
    history: dict[str, list[Array]] = {name: [] for name in (*_BODY, *_WHEEL, *_FRAME, "soil")}
    _settle(machine, sides[0])
    _store(machine, history)
    for i in range(len(t_s) - 1):
        machine.step(sides[i : i + 2], FRAME_S, substeps)
        _store(machine, history)
    whole = {
        name: np.stack(history.pop(name)) for name in list(history)
    }  # one after the other: half the memory
    return [_one(whole, n, t_s, b) for b in range(len(specs))]


def _settle(machine: Machine, command: Array, seconds: float = 6.0) -> None:
    """Loads, shear and speed loops settle at standstill; the motion meanwhile is undone."""
    start = {
        name: machine.s[name].copy()
        for name in ("x", "y", "z", "yaw", "travel", "angle", "motor_work", "heat")
    }
    for _ in range(round(seconds / FRAME_S)):
        machine.step(np.stack([command, command]), FRAME_S, 1)
    machine.s |= start
    machine.t_s = 0.0


def _store(machine: Machine, history: dict[str, list[Array]]) -> None:
    for name in (*_BODY, *_WHEEL):
        history[name].append(machine.s[name])
    shape = machine.s["u"].shape
    for name in _FRAME:
        history[name].append(np.broadcast_to(machine.frame[name], shape))
    history["soil"].append(machine.frame["soil"][0].mean(axis=0))


def _one(whole: dict[str, Array], n: dict[str, Any], t_s: Array, b: int) -> sensors.History:
    h = {name: values[..., b] for name, values in whole.items()}
    own = {name: values[..., b] for name, values in n.items()}
    return h | {"t": t_s, "current": sensors.currents(own, h["torque"], h["speed"])}


def _gusts(specs: Sequence[RunSpec], count: int) -> Array | None:
    """Side force (N, B) of gusts: first-order Gauss-Markov, N."""
    sizes = [spec.changes.get("gust_n", 0.0) for spec in specs]
    if not any(sizes):
        return None
    from scipy.signal import lfilter

    keep = np.exp(-FRAME_S / GUST_S)
    drive = np.stack([spec.stream("gusts").normal(size=count) for spec in specs], axis=1)
    return np.asarray(sizes * lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], drive, axis=0))


def _recording(spec: RunSpec, h: sensors.History, name: str) -> Recording:
    rows = sensors.every(COMMAND_HZ, 1.0 / FRAME_S, len(h["t"]))
    twist = commanded_twist(spec, h["t"][rows])
    first = sensors.stamps(np.array([0.0]))
    return Recording(
        name=name,
        start_ns=sensors.START_NS,
        vehicle=spec.vehicle.name,
        command=Command(sensors.stamps(h["t"][rows]), twist[:, 0], twist[:, 1]),
        wheels=sensors.wheels(spec, h),
        imu=sensors.imu(spec, h),
        gnss=sensors.gnss(spec, h),
        motor=sensors.motor(spec, h),
        terrain=Terrain(first, np.array([spec.soil.name], dtype=object)),
        terrain_name=spec.soil.name,
        description="simulated by the plant of the blind check",
    )
