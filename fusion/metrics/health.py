"""Plausibility of an estimate without a reference: finite numbers, speed and path against the wheels."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.checks.timing import is_gap
from terrafusion.datasets.core.channels import Wheels
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.fusion.estimate.estimate import Estimate
from terrafusion.fusion.metrics.error_series import travelled_m

SPEED_FACTOR, SPEED_SLACK_MPS = 1.5, 1.0
"""Largest plausible speed: a multiple of the fastest wheel speed plus a margin for rolling downhill."""
LEAST_PATH, MOST_PATH, PATH_SLACK_M = 0.2, 1.2, 5.0
"""Plausible path as a share of the wheels' path, with a margin for short runs. The median measured slip on
ice is 0.64 (docs/evidence/field.md), a share of 0.36."""
NOISE_SIGMAS = 3.0
"""Steps of fewer sigmas of the position may be noise of the estimate."""


@dataclass(frozen=True)
class Health:
    """Top horizontal speed, path, path rolled by the wheels; `why` the estimate is implausible, or ""."""

    top_speed_mps: float
    path_m: float
    rolled_m: float
    why: str

    def path_ratio(self) -> float | None:
        """Estimated path over rolled path; None if the wheels hardly turned."""
        return self.path_m / self.rolled_m if self.rolled_m >= 1.0 else None


def examine_estimate(estimate: Estimate, wheels: Wheels, radius_m: float) -> Health:
    """Check that an estimate is finite and that its speed and path agree with the wheels.

    Where the wheels end before it, so does the path that is compared.
    """
    path = estimate.trajectory
    P = path.covariance
    finite = bool(np.isfinite(path.position_m).all() and np.isfinite(estimate.velocity_mps).all())
    certain = P is not None and bool(np.isfinite(P).all() and (np.einsum("nii->ni", P) > 0.0).all())
    speed = float(np.hypot(*estimate.velocity_mps[:, :2].T).max()) if finite else float("nan")
    wheels = wheels.between(int(path.t_ns[0]), int(path.t_ns[-1]) + 1)
    end = int(np.searchsorted(path.t_ns, wheels.t_ns[-1], side="right")) if len(wheels) else len(path)
    moved = float(travelled_m(path.position_m[:end])[-1]) if finite else float("nan")
    sides = wheels.side_speeds_mps(radius_m)
    sides = sides[np.isfinite(sides).all(axis=1)]
    fastest = float(np.abs(sides).max()) if len(sides) else 0.0
    rolled = rolled_m(wheels, radius_m)
    seen_m = float(np.diff(rolled_until_m(wheels, radius_m))[~is_gap(wheels.t_ns)].sum())
    why = ""
    if not finite:
        why = "positions or velocities are not finite"
    elif not certain:
        why = "the covariance is not finite and positive"
    elif speed > SPEED_FACTOR * fastest + SPEED_SLACK_MPS:
        why = f"{speed:.1f} m/s with wheels of at most {fastest:.1f} m/s"
    elif moved > MOST_PATH * rolled + PATH_SLACK_M:
        moved = beyond_noise_m(path, end)
    if not why and not LEAST_PATH * seen_m - PATH_SLACK_M <= moved <= MOST_PATH * rolled + PATH_SLACK_M:
        why = f"a path of {moved:.0f} m where the wheels rolled {rolled:.0f} m"
    return Health(speed, moved, rolled, why)


def beyond_noise_m(path: Trajectory, end: int) -> float:
    """Length of the polygon of those of the first `end` positions that lie beyond the noise from its corner
    before, m.
    """
    assert path.covariance is not None
    least_m = NOISE_SIGMAS * np.sqrt(np.maximum(path.covariance[:, 0, 0], path.covariance[:, 1, 1]))
    corner, *others = (path.position_m[:end, 0] + 1j * path.position_m[:end, 1]).tolist()
    length_m = 0.0
    for place, least in zip(others, least_m[1:end].tolist(), strict=True):
        if (step := abs(place - corner)) > least:
            length_m, corner = length_m + step, place
    return length_m


def rolled_m(wheels: Wheels, radius_m: float) -> float:
    """Path of the mean of the wheels, m; forward and backward both count."""
    return float(rolled_until_m(wheels, radius_m)[-1]) if len(wheels) else 0.0


def rolled_until_m(wheels: Wheels, radius_m: float) -> NDArray[np.float64]:
    """Path (N,) of the mean of the wheels up to each sample, m; unknown speeds count as zero."""
    speed = np.abs(np.nan_to_num(wheels.side_speeds_mps(radius_m)).mean(axis=1))
    steps = 0.5 * (speed[1:] + speed[:-1]) * np.diff(wheels.t_ns) * 1e-9
    return np.concatenate([np.zeros(min(1, len(speed))), np.cumsum(steps)])
