"""The machine-readable results of a replay, in one folder.

    metrics.json     the scores; keeps to docs/schemas/metrics.schema.json
    estimate.csv     one row a keyframe (`estimate_columns` names the columns)
    trajectory.tum   `t x y z qx qy qz qw`, for evo and the like
    weights.jsonl    one change of a sensor's weight a line, with its reason

Each file appears when it is whole. Numbers that are unknown or not finite are null in JSON and empty cells in
CSV. The same estimate gives the same bytes.
"""

import csv
import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.files import write_atomically
from terrafusion.datasets.core.json_text import finite, to_json
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.writers.log_folder import decimal_seconds
from terrafusion.datasets.writers.tum import write_tum
from terrafusion.fusion.estimate.estimate import BIASES, STATUS, Estimate
from terrafusion.fusion.graph.key_state import LINEAR
from terrafusion.fusion.metrics.scores import Scores
from terrafusion.fusion.outputs.linear_states import calibration as calibration_of
from terrafusion.fusion.outputs.linear_states import learned_rows, series
from terrafusion.fusion.replay import ReplayResult
from terrafusion.fusion.terrain.classifier import UNKNOWN

SCHEMA = "terrafusion.replay/1"


def metrics_of(result: ReplayResult) -> dict[str, Any]:
    """The content of `metrics.json` (docs/schemas/metrics.schema.json) for one replay.

    `calibration` has rows of `linear_states.calibration` where it was asked for, else of `learned_rows`; the
    notes on the scoring follow those of the estimate.
    """
    estimate, scores, verdict = result.estimate, result.scores, result.verdict
    latencies = np.asarray(result.latencies_ms, dtype=float).ravel()
    latencies = latencies[np.isfinite(latencies)]
    p50, p99 = np.percentile(latencies, [50.0, 99.0]) if len(latencies) else (0.0, 0.0)
    shares = terrain_shares(estimate, result.found_shares)
    return {
        "schema": SCHEMA,
        "log": result.recording.name,
        "vehicle": result.vehicle.name,
        "mode": result.mode,
        "duration_s": _at_least_zero(result.recording.duration_s()),
        "distance_m": _at_least_zero(estimate.trajectory.path_length_m()),
        "realtime_factor": _at_least_zero(result.realtime_factor()),
        "updates": len(estimate.trajectory),
        "update_latency_ms": {"p50": float(p50), "p99": float(p99)},
        "terrain": {name: min(1.0, _at_least_zero(share)) for name, share in shares.items()},
        "weights": {"changes": len(estimate.changes)},
        "rejected": {"gnss": int(result.rejected_gnss), "wheels": int(result.rejected_wheels)},
        **_scored(scores),
        "calibration": [
            finite(row)
            for row in calibration_of(estimate, result.vehicle.rig()) or learned_rows(result.learned)
        ],
        "status": final_status(estimate),
        "notes": [*estimate.notes, *(note for note in scores.notes if note not in estimate.notes)],
        "verdict": {"value": verdict.value, "reasons": list(verdict.reasons)},
        "assumed": [finite(dataclasses.asdict(one)) for one in result.assumed],
        "baselines": finite(dataclasses.asdict(result.baselines)),
    }


def _scored(scores: Scores) -> dict[str, Any]:
    numbers = ("ate_m", "rpe_percent", "yaw_rmse_rad", "velocity_rmse_mps", "nees_mean")
    return {
        "against": scores.against,
        **{name: finite(getattr(scores, name)) for name in numbers},
        "held_out": None if scores.held_out is None else finite(dataclasses.asdict(scores.held_out)),
        "outages": [finite(dataclasses.asdict(outage)) for outage in scores.outages],
        "consistency": [
            finite(dataclasses.asdict(row)) | {"verdict": row.verdict()} for row in scores.consistency
        ],
    }


def terrain_shares(estimate: Estimate, found: Mapping[str, float] | None = None) -> dict[str, float]:
    """Share of the drive's time in which each class was the most probable; they sum to 1.

    A keyframe's class holds until the next keyframe; classes that never lead are left out. `found` are the
    shares of the grounds that the robot found in the time on unknown ground, which they take over.
    """
    t_ns = estimate.trajectory.t_ns
    if not len(t_ns) or not estimate.classes:
        return {}
    seconds = np.diff(t_ns, append=t_ns[-1]) * 1e-9
    if not seconds.sum() > 0.0:
        seconds = np.ones(len(t_ns))
    label = np.nan_to_num(estimate.terrain).argmax(axis=1)
    total = np.bincount(label, weights=seconds, minlength=len(estimate.classes)) / seconds.sum()
    shares = {name: float(share) for name, share in zip(estimate.classes, total, strict=True) if share > 0.0}
    unknown = shares.pop(UNKNOWN, 0.0)
    of_found = {name: share * unknown for name, share in (found or {}).items()}
    rest = max(unknown - sum(of_found.values()), 0.0)
    for name, share in {**of_found, UNKNOWN: rest}.items():
        if share > 0.0:
            shares[name] = shares.get(name, 0.0) + share
    return shares


def final_status(estimate: Estimate) -> dict[str, str]:
    """Status of the last keyframe and its sentence; `waiting` when there is no keyframe."""
    value = str(estimate.status[-1]) if len(estimate.status) else "waiting"
    return {"value": value, "message": STATUS.get(value, value)}


def is_local(estimate: Estimate) -> bool:
    """Whether start and heading of the path are arbitrary, because no fix ever came."""
    return bool(len(estimate.status)) and bool((estimate.status == "no_gnss").all())


def write_outputs(
    directory: Path, estimate: Estimate, metrics: Mapping[str, Any], recording: Recording
) -> dict[str, Path]:
    """Write all files into `directory` (made when absent) and return their paths by file name.

    Raises:
        TerrafusionError: the folder cannot be made or written.
    """
    changes = (
        {"t_s": (change.t_ns - recording.start_ns) * 1e-9} | dataclasses.asdict(change)
        for change in estimate.changes
    )
    writers: dict[str, Callable[[Path], object]] = {
        "metrics.json": lambda path: path.write_text(to_json(metrics, indent=2) + "\n", encoding="utf-8"),
        "estimate.csv": lambda path: _write_csv(path, estimate_columns(estimate, recording.start_ns)),
        "trajectory.tum": lambda path: write_tum(estimate.trajectory, path),
        "weights.jsonl": lambda path: path.write_text(
            "".join(to_json(change) + "\n" for change in changes), encoding="utf-8", newline="\n"
        ),
    }
    return {name: write_atomically(directory / name, write) for name, write in writers.items()}


def estimate_columns(estimate: Estimate, start_ns: int) -> dict[str, list[str]]:
    """The cells of `estimate.csv`, by column.

    t_s                          seconds from the start of the recording
    t_ns                         nanoseconds, Unix epoch for real logs
    x_m, y_m, z_m                body origin, ENU about the datum
    qx, qy, qz, qw               orientation, body to world
    v_e_mps, v_n_mps, v_u_mps    velocity of the body origin, world
    yaw_rate_radps               body z, bias removed
    slip, slip_sigma             1 - v / (omega R), and its 1 sigma
    terrain, p_<class>           most probable class, and the probability of each
    sigma_x_m, sigma_y_m         1 sigma of the position, world axes
    sigma_yaw_rad                1 sigma of the heading
    gyro_bias_*, accel_bias_*    body axes
    w_<name>                     the weights in force, named and measured as in the policy file
    status                       waiting, aligning, running, outage, doubtful or no_gnss
    slipping, immobilised        1 or 0, see docs/explanation/monitor.md
    sigma_gyro_bias_*, sigma_accel_bias_*   1 sigma of the biases
    <state>, sigma_<state>       the linear states but slip, as far as they are estimated; see
                                 docs/explanation/calibration-states.md
    """
    path = estimate.trajectory
    n = len(path)
    q = path.quaternion if path.quaternion is not None else np.full((n, 4), np.nan)
    twist = path.twist_body if path.twist_body is not None else np.full((n, 6), np.nan)
    P = path.covariance if path.covariance is not None else np.full((n, 6, 6), np.nan)
    sigma = np.sqrt(np.maximum(np.diagonal(P, axis1=1, axis2=2), 0.0))
    offset = path.t_ns - start_ns
    table = {"t_s": decimal_seconds(offset), "t_ns": [str(t) for t in path.t_ns.tolist()]}
    table |= _numbers(("x_m", "y_m", "z_m"), path.position_m, ".6f")
    table |= _numbers(("qx", "qy", "qz", "qw"), q, ".9f")
    table |= _numbers(("v_e_mps", "v_n_mps", "v_u_mps"), estimate.velocity_mps, ".6f")
    table |= _numbers(("yaw_rate_radps",), twist[:, 5:], ".6f")
    table |= _numbers(("slip", "slip_sigma"), np.stack([estimate.slip, estimate.slip_sigma], axis=1), ".6f")
    table["terrain"] = (
        [_one_line(name) for name in estimate.dominant_terrain()] if estimate.classes else [""] * n
    )
    table |= _numbers([f"p_{name}" for name in estimate.classes], estimate.terrain, ".6f")
    table |= _numbers(("sigma_x_m", "sigma_y_m", "sigma_yaw_rad"), sigma[:, [0, 1, 5]], ".6g")
    table |= _numbers(BIASES, np.hstack([estimate.gyro_bias_radps, estimate.accel_bias_mps2]), ".6g")
    for name, values in estimate.weights.items():
        table |= _numbers((f"w_{name}",), np.reshape(values, (n, 1)), ".6g")
    table["status"] = [_one_line(value) for value in estimate.status]
    for name, flags in (("slipping", estimate.slipping), ("immobilised", estimate.immobilised)):
        table[name] = [""] * n if flags is None else [str(int(flag)) for flag in flags]
    biases = [f"sigma_{name}" for name in BIASES]
    unknown = np.full((n, 6), np.nan)
    table |= _numbers(biases, unknown if estimate.bias_sigma is None else estimate.bias_sigma, ".6g")
    for state in LINEAR[1:]:
        value_and_sigma = series(estimate, state)
        if value_and_sigma is not None:
            table |= _numbers((state, f"sigma_{state}"), np.stack(value_and_sigma, axis=1), ".6g")
    return table


def _numbers(names: Sequence[str], values: NDArray[Any], spec: str) -> dict[str, list[str]]:
    columns = np.asarray(values, dtype=float).T.tolist()
    return {
        name: [format(x, spec) if math.isfinite(x) else "" for x in column]
        for name, column in zip(names, columns, strict=True)
    }


def _one_line(value: object) -> str:
    return " ".join(str(value).split())


def _write_csv(path: Path, table: Mapping[str, list[str]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as out:
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(_one_line(name) for name in table)
        writer.writerows(zip(*table.values(), strict=True))


def _at_least_zero(value: float) -> float:
    """`value`, or 0 where it is negative or not finite: the schema has no null for it."""
    return float(value) if math.isfinite(value) and value > 0.0 else 0.0
