"""An `Estimate` as it is written into a bag: odometry with both covariances, and diagnostics.

Frames follow REP-105: with GNSS the path is in `map`, because a fix may move it at once; without,
start and heading are arbitrary and the path drifts without a jump, which is what `odom` means.
"""

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.writers.mcap_estimate import Level, Status, WrittenEstimate
from terrafusion.fusion.estimate.estimate import STATUS, Estimate
from terrafusion.fusion.graph.key_state import LINEAR
from terrafusion.fusion.outputs.linear_states import series
from terrafusion.fusion.outputs.replay_files import is_local

EVERY_S = 1.0
"""Diagnostics come at least this often while there are keyframes, and at each change."""


def written_estimate(estimate: Estimate) -> WrittenEstimate:
    """The estimate, ready for `write_mcap`."""
    rows = diagnostic_rows(estimate)
    t_ns = estimate.trajectory.t_ns[rows]
    rejected = _rejected_by(estimate, t_ns)
    waits = _seconds_in_status(estimate)
    states = {name: found for name in LINEAR[1:] if (found := series(estimate, name)) is not None}
    diagnostics = [
        (
            _localisation(estimate, i, waits[i]),
            _ground(estimate, i),
            _weights(estimate, i),
            _gates({sensor: int(counts[j]) for sensor, counts in rejected.items()}),
            *_states(states, i),
        )
        for j, i in enumerate(rows.tolist())
    ]
    frame = "odom" if is_local(estimate) else "map"
    return WrittenEstimate(estimate.trajectory, estimate.twist_covariance, frame, t_ns, diagnostics)


def diagnostic_rows(estimate: Estimate) -> NDArray[np.int64]:
    """The keyframes that get diagnostics: the first of each second, and those where a state changes."""
    t_ns = estimate.trajectory.t_ns
    if not len(t_ns):
        return np.zeros(0, dtype=np.int64)
    second = (t_ns - t_ns[0]) // round(EVERY_S * 1e9)
    states = [second, estimate.status]
    if estimate.classes:
        states.append(estimate.dominant_terrain())
    states += [flag for flag in (estimate.slipping, estimate.immobilised) if flag is not None]
    changed = np.ones(len(t_ns), dtype=bool)
    changed[1:] = np.any([state[1:] != state[:-1] for state in states], axis=0)
    return np.flatnonzero(changed)


def _localisation(estimate: Estimate, i: int, seconds: float) -> Status:
    status = str(estimate.status[i])
    values = {"status": status, "status_s": f"{seconds:.1f}"}
    values["outage"] = _yes(status == "outage")
    P = estimate.trajectory.covariance
    if P is not None:
        east, north, yaw = np.sqrt(np.maximum(np.diagonal(P[i])[[0, 1, 5]], 0.0))
        values |= {"sigma_east_m": f"{east:.4g}", "sigma_north_m": f"{north:.4g}"}
        values["sigma_heading_deg"] = f"{np.degrees(yaw):.4g}"
    level = Level.OK if status == "running" else Level.WARN
    return Status("terrafusion/localisation", level, STATUS.get(status, status), values)


def _ground(estimate: Estimate, i: int) -> Status:
    values = {}
    message = "no terrain class is known"
    if estimate.classes:
        best = int(np.nan_to_num(estimate.terrain[i]).argmax())
        name, p = estimate.classes[best], float(estimate.terrain[i, best])
        message = f"{name} with probability {p:.2f}"
        values = {"terrain": name, "probability": f"{p:.3f}"}
    values |= {"slip": f"{estimate.slip[i]:.4f}", "slip_sigma": f"{estimate.slip_sigma[i]:.4f}"}
    level = Level.OK
    for name, flag in (("slipping", estimate.slipping), ("immobilised", estimate.immobilised)):
        if flag is not None:
            values[name] = _yes(flag[i])
            if flag[i]:
                level, message = Level.WARN, f"{message}, {name}"
    return Status("terrafusion/ground", level, message, values)


def _weights(estimate: Estimate, i: int) -> Status:
    values = {name: f"{column[i]:.4g}" for name, column in estimate.weights.items()}
    return Status("terrafusion/weights", Level.OK, "noise in force, as the policy file names it", values)


def _states(states: dict[str, tuple[Array, Array]], i: int) -> list[Status]:
    """The linear states but slip with their sigma; no status where the estimate has none."""
    values: dict[str, str] = {}
    for name, (value, sigma) in states.items():
        values |= {name: f"{value[i]:.5g}", f"sigma_{name}": f"{sigma[i]:.3g}"}
    message = "skid steering, GNSS drift and, where asked for, the robot's calibration"
    return [Status("terrafusion/states", Level.OK, message, values)] if values else []


def _gates(rejected: dict[str, int]) -> Status:
    message = ", ".join(f"{count} of {sensor}" for sensor, count in rejected.items() if count)
    return Status(
        "terrafusion/gates",
        Level.OK,
        f"rejected so far: {message}" if message else "nothing rejected so far",
        {f"rejected_{sensor}": str(count) for sensor, count in rejected.items()},
    )


def _rejected_by(estimate: Estimate, t_ns: NDArray[np.int64]) -> dict[str, NDArray[np.int64]]:
    """By sensor, measurements rejected by a gate up to each time (N,)."""
    sensors = dict.fromkeys(["gnss", "wheels", *(i.sensor for i in estimate.innovations)])
    counts = {}
    for sensor in sensors:
        times = sorted(i.t_ns for i in estimate.innovations if i.sensor == sensor and not i.accepted)
        counts[sensor] = np.searchsorted(np.array(times, dtype=np.int64), t_ns, side="right")
    return counts


def _seconds_in_status(estimate: Estimate) -> NDArray[np.float64]:
    """Seconds (N,) since the status of each keyframe began."""
    t_ns, status = estimate.trajectory.t_ns, estimate.status
    began = np.arange(len(t_ns))
    began[1:][status[1:] == status[:-1]] = 0
    return np.asarray((t_ns - t_ns[np.maximum.accumulate(began)]) * 1e-9)


def _yes(value: object) -> str:
    return "true" if value else "false"
