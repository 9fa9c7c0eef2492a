"""Scores of an estimate against truth or held-out GNSS fixes, in the horizontal plane.

- ATE: rms of the position error (Sturm et al. 2012, "A benchmark for the evaluation of RGB-D SLAM systems",
  IROS, eq. 5) without alignment, because estimate and reference share the ENU frame. Only a run without GNSS
  is aligned, once, at its start.
- RPE: Sturm et al. (2012), eq. 2, over pairs 10, 50 or 100 m of path apart, as percent of that length,
  averaged over all pairs as in Geiger et al. (2012, KITTI). Without a reference heading, displacements are
  compared in the world frame, so heading errors count in full.
- NEES: mean of e' P^-1 e / 2 for the 2-D position error e and its covariance P (Bar-Shalom, Li, Kirubarajan
  2001, sec. 5.4.2, divided by the dimension): 1 is consistent, above 1 overconfident. Against fixes, P
  includes the covariance of the fix. By terrain and over time: `consistency`.
- Outage: errors inside a span without GNSS, never realigned: position and heading errors at its start count.

Times in seconds count from the start of the recording.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array, TimesNs
from terrafusion.datasets.core.channels import Gnss
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.estimate.antenna import AntennaPlaces
from terrafusion.fusion.estimate.estimate import Estimate
from terrafusion.fusion.metrics.consistency import Consistency, by_terrain, ground_at, whitened_series
from terrafusion.fusion.metrics.error_series import (
    Errors,
    align_both,
    errors_against_fixes,
    errors_against_truth,
    known_keyframes,
    travelled_m,
)

Rows = NDArray[np.int64]

LEFT_S, LEFT_SHARE = 2.0, 0.25
"""References must reach this close to the end of an outage, s or as a share of it."""
RPE_LENGTHS_M = (10, 50, 100)
"""Path lengths of the relative pose error."""


@dataclass(frozen=True)
class Outage:
    """A span of `seconds` from `start_s` in which the estimator gets no GNSS fix."""

    start_s: float
    seconds: float

    def covers(self, t_ns: TimesNs, start_ns: int) -> NDArray[np.bool_]:
        """Whether times (N,) lie in start <= t < end; `start_ns` is the start of the recording."""
        t_s = (t_ns - start_ns) * 1e-9
        return np.asarray((t_s >= self.start_s) & (t_s < self.start_s + self.seconds))

    def scored(self, errors: Errors, end_ns: int, start_ns: int) -> Rows:
        """Rows (n,) of the references inside, none where they end long before it does.

        An outage ends at the latest with the last keyframe, `end_ns`.
        """
        rows = np.flatnonzero(self.covers(errors.t_ns, start_ns))
        if not len(rows):
            return rows
        end_s = min(self.start_s + self.seconds, (end_ns - start_ns) * 1e-9)
        left_s = end_s - float(errors.t_ns[rows[-1]] - start_ns) * 1e-9
        return rows if left_s <= max(LEFT_S, LEFT_SHARE * (end_s - self.start_s)) else rows[:0]


@dataclass(frozen=True)
class OutageScore:
    """Drift in one outage; None without a reference inside it.

    `max_m` is the largest error, `end_yaw_error_rad` the size of the heading error at the end,
    `nees_mean` that of the position inside.
    """

    start_s: float
    seconds: float
    distance_m: float
    end_error_m: float | None
    median_m: float | None
    percent: float | None
    max_m: float | None = None
    end_yaw_error_rad: float | None = None
    nees_mean: float | None = None


@dataclass(frozen=True)
class HeldOut:
    """Horizontal distance of the estimated antenna from the held-out fixes."""

    fixes: int
    median_m: float
    p95_m: float


@dataclass(frozen=True, eq=False)
class Scores:
    """All scores of one run; None without a reference.

    `errors` are the underlying series, `notes` describe alignment and exclusions. `consistency` holds NEES
    and NIS of the whole run and by terrain.
    """

    against: str | None
    ate_m: float | None
    rpe_percent: dict[str, float | None]
    yaw_rmse_rad: float | None
    velocity_rmse_mps: float | None
    nees_mean: float | None
    held_out: HeldOut | None
    outages: tuple[OutageScore, ...]
    notes: tuple[str, ...] = ()
    errors: Errors | None = field(default=None, repr=False)
    consistency: tuple[Consistency, ...] = ()

    def __repr__(self) -> str:
        return "\n".join(["Scores", *(f"  {line}" for line in self.lines() or ["no reference"])])

    def lines(self) -> list[str]:
        """Error, fixes held out and the first outages, in words."""
        lines = []
        if self.ate_m is not None:
            lines.append(f"position error against {self.against}: {self.ate_m:.3f} m (RMS)")
        if self.held_out is not None:
            held = self.held_out
            lines.append(f"{held.fixes} fixes held out: median error {held.median_m:.2f} m")
        for outage in self.outages[:4]:
            end = "not scored" if outage.end_error_m is None else f"{outage.end_error_m:.2f} m at its end"
            lines.append(f"outage {outage.start_s:g} to {outage.start_s + outage.seconds:g} s: {end}")
        return lines


def parse_outage(text: str) -> Outage:
    """`START:SECONDS`, both in seconds, as in "120:60".

    Raises:
        ConfigError: not two finite numbers, a negative start, or no duration.
    """
    try:
        return as_outage(text.split(":"))
    except ConfigError:
        raise ConfigError(
            f"'{text}' is not an outage",
            remedy="write START:SECONDS with START >= 0 and SECONDS > 0, as in 120:60",
        ) from None


def as_outage(pair: Any) -> Outage:
    """The outage of a pair (start, length) in seconds, or itself.

    Raises:
        ConfigError: not two finite numbers, a negative start, or no duration.
    """
    if isinstance(pair, Outage):
        return pair
    try:
        start_s, seconds = map(float, pair)
    except (TypeError, ValueError):
        start_s = seconds = math.nan
    if not (0.0 <= start_s < math.inf and 0.0 < seconds < math.inf):
        raise ConfigError(
            f"{pair!r} is not an outage", remedy="give pairs (start, length) in seconds, as in [(60, 30)]"
        )
    return Outage(start_s, seconds)


def as_outages(pairs: Any) -> list[Outage]:
    """Outages of pairs (start, length) in seconds.

    Raises:
        ConfigError: no pairs.
    """
    if not isinstance(pairs, Iterable):
        raise ConfigError(
            f"outages are {pairs!r}", remedy="give pairs (start, length) in seconds, as in [(60, 30)]"
        )
    return [as_outage(pair) for pair in pairs]


def score(
    estimate: Estimate,
    recording: Recording,
    *,
    held_out: Gnss | None = None,
    outages: Sequence[Outage] = (),
    antenna_m: tuple[float, ...] | AntennaPlaces = (0.0, 0.0, 0.0),
    aligned: bool = False,
) -> Scores:
    """Score `estimate` against the truth of `recording`, else against the held-out fixes.

    Args:
        held_out: fixes not given to the estimator.
        outages: spans that are also scored separately.
        antenna_m: (3,) antenna in the body frame, or its places over the drive: the point of fixes and of a
            truth of the antenna.
        aligned: start and heading of the estimate are arbitrary (a run without GNSS) and fitted once to the
            start of the reference.
    """
    known, notes = known_keyframes(estimate)
    antenna = antenna_m if isinstance(antenna_m, AntennaPlaces) else AntennaPlaces.fixed(antenna_m)
    truth = errors_against_truth(known, recording, antenna)
    fixes = errors_against_fixes(known, held_out, antenna)
    if aligned:
        truth, fixes, aligned_by = align_both(truth, fixes)
        notes += aligned_by
    has_position = truth is not None and bool(np.isfinite(truth.reference_m).any())
    main = truth if has_position or fixes is None else fixes
    attitude = truth if truth is not None else fixes
    against = None if main is None else "truth" if main is truth else "gnss_held_out"
    if against == "gnss_held_out":
        notes += ("the errors against GNSS fixes hold the noise of the fixes as well",)
    series = whitened_series(known, main, attitude)
    start_ns = recording.start_ns
    return Scores(
        against=against,
        ate_m=None if main is None else _rms(main.distance_m()),
        rpe_percent=dict.fromkeys(map(str, RPE_LENGTHS_M)) if main is None else rpe_percent(main),
        yaw_rmse_rad=None if attitude is None else _rms(attitude.yaw_error_rad()),
        velocity_rmse_mps=None if attitude is None else _rms(_norm(attitude.velocity_error_mps)),
        nees_mean=None if main is None else _mean(main.nees()),
        held_out=_held_out(fixes),
        outages=tuple(_outage(o, known, main, start_ns) for o in outages),
        notes=notes,
        errors=main,
        consistency=tuple(
            row for one in series for row in by_terrain(one, ground_at(recording, known, one.t_ns), start_ns)
        ),
    )


def rpe_percent(errors: Errors) -> dict[str, float | None]:
    """Mean relative position error over all pairs a length of path apart, percent of that path.

    One number for each length; None if the run is shorter.
    """
    path = errors.path_m()
    out: dict[str, float | None] = {}
    for length in RPE_LENGTHS_M:
        first, last = path_pairs(errors, length, path)
        error = relative_error_m(errors, first, last)
        out[f"{length:g}"] = _mean(100.0 * error / (path[last] - path[first]))
    return out


def path_pairs(errors: Errors, length_m: float, path_m: Array | None = None) -> tuple[Rows, Rows]:
    """Rows (n,) of all starts and of the first sample at least `length_m` of the reference's path later."""
    path = errors.path_m() if path_m is None else path_m
    known = np.flatnonzero(np.isfinite(errors.distance_m()))
    last = np.searchsorted(path, path[known] + length_m, side="left")
    inside = last < len(path)
    return known[inside], last[inside]


def relative_error_m(errors: Errors, first: Rows, last: Rows) -> Array:
    """RPE of chosen pairs, (n,): the translation of Sturm et al. (2012), eq. 2, in the plane.

    Displacements are rotated into the frame at the start of the pair, or compared in the world frame if the
    reference lacks a heading at one of the starts.
    """
    estimate = errors.estimate_m[last] - errors.estimate_m[first]
    reference = errors.reference_m[last] - errors.reference_m[first]
    if len(first) and np.isfinite(errors.reference_yaw_rad[first]).all():
        estimate = _rotate(estimate, -errors.estimate_yaw_rad[first])
        reference = _rotate(reference, -errors.reference_yaw_rad[first])
    return _norm(estimate - reference)


def _held_out(errors: Errors | None) -> HeldOut | None:
    if errors is None:
        return None
    distance = errors.distance_m()
    return HeldOut(len(distance), float(np.median(distance)), float(np.percentile(distance, 95.0)))


def _outage(outage: Outage, estimate: Estimate, errors: Errors | None, start_ns: int) -> OutageScore:
    """Errors at the references inside the outage; the end error is that of the last of them, near its end."""
    path = estimate.trajectory
    inside = outage.covers(path.t_ns, start_ns)
    moved = travelled_m(path.position_m[inside])
    distance = float(moved[-1]) if len(moved) else 0.0
    nothing = OutageScore(outage.start_s, outage.seconds, distance, None, None, None)
    if errors is None or not np.isfinite(errors.reference_m).any():
        return nothing
    rows = outage.scored(errors, int(path.t_ns[-1]), start_ns)
    error = errors.distance_m()[rows]
    if not len(error):
        return nothing
    if len(error) > 1:
        distance = float(travelled_m(errors.reference_m[rows], errors.min_step_m)[-1])
    end = float(error[-1])
    yaw = float(np.abs(errors.yaw_error_rad()[rows][-1]))
    return OutageScore(
        start_s=outage.start_s,
        seconds=outage.seconds,
        distance_m=distance,
        end_error_m=end,
        median_m=float(np.median(error)),
        percent=100.0 * end / distance if distance >= 1.0 else None,
        max_m=float(error.max()),
        end_yaw_error_rad=yaw if np.isfinite(yaw) else None,
        nees_mean=_mean(errors.nees()[rows]),
    )


def _rotate(vectors: Array, angle_rad: Array) -> Array:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    x, y = vectors[:, 0], vectors[:, 1]
    return np.stack([c * x - s * y, s * x + c * y], axis=1)


def _norm(vectors: Array) -> Array:
    return np.asarray(np.hypot(vectors[:, 0], vectors[:, 1]))


def _rms(values: Array) -> float | None:
    mean = _mean(values**2)
    return None if mean is None else mean**0.5


def _mean(values: Array) -> float | None:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else None
