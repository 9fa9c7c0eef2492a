"""NEES and NIS of an estimate by terrain and over time, with the band of a consistent estimator.

An error e with covariance P is whitened, u = L^-1 e with P = L L'. For a consistent estimator u has zero
mean and unit variance and |u|^2 is chi-square with d degrees of freedom (Bar-Shalom, Li, Kirubarajan 2001,
sec. 5.4.2): NEES for errors against a reference, NIS for innovations. Both per dimension, |u|^2 / d: 1 is
consistent, above 1 overconfident, below 1 cautious.

Samples of one run are correlated. For a Gaussian process with autocorrelation rho the mean square of N
samples has the variance of N_eff independent ones,

    1 / N_eff = sum over all pairs (s, t) of rho(|s - t|)^2 / N^2

(Bayley and Hammersley 1946, J. R. Stat. Soc. Suppl. 8(2)), and N_eff d times the mean is close to chi-square
with d N_eff degrees of freedom. rho is estimated about zero, the known mean (a constant error counts as one
sample), and truncated at its first value that is not positive (Geyer 1992, initial positive sequence).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array, TimesNs
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.estimate.estimate import Estimate, Innovation
from terrafusion.fusion.metrics.error_series import Errors
from terrafusion.fusion.terrain.external import TRUE_SOURCES

Rows = NDArray[np.bool_]

CONFIDENCE = 0.95
"""Share of consistent estimators whose mean falls into the band."""
WINDOW_S = 20.0
"""Length of the windows of `over_time`."""
ALL = "all"


@dataclass(frozen=True, eq=False)
class Whitened:
    """Errors of one quantity, whitened by their covariance.

    Attributes:
        quantity: "position", "heading" or "nis <sensor>".
        t_ns: (N,), evenly spaced except for gaps.
        values: (N, d), unit variance and zero mean where the estimator is consistent; NaN where unknown.
    """

    quantity: str
    t_ns: TimesNs
    values: Array

    def squares(self) -> Array:
        """NEES or NIS per dimension, (N,)."""
        return np.asarray((self.values**2).mean(axis=1))

    def known(self) -> Rows:
        """Rows with finite values, (N,)."""
        return np.asarray(np.isfinite(self.values).all(axis=1))


@dataclass(frozen=True)
class Consistency:
    """Mean NEES or NIS per dimension over a set of samples, with the band of a consistent estimator.

    Attributes:
        quantity: as in `Whitened`.
        terrain: the class, or "all".
        start_s, end_s: first and last sample, from the start of the recording.
        samples, effective: their number, and the equivalent number of independent samples.
        mean: per dimension.
        low, high: a consistent estimator's mean lies between them with probability `CONFIDENCE`.
    """

    quantity: str
    terrain: str
    start_s: float
    end_s: float
    samples: int
    effective: float
    mean: float
    low: float
    high: float

    def verdict(self) -> str:
        """ "consistent", "overconfident" or "cautious"."""
        return verdict(self.mean, self.low, self.high)


def verdict(mean: float, low: float, high: float) -> str:
    """Verdict on a mean NEES by the band of a consistent estimator."""
    return "overconfident" if mean > high else "cautious" if mean < low else "consistent"


def position(errors: Errors) -> Whitened:
    """Horizontal position errors by the Cholesky factor of their covariance; NaN if not positive definite."""
    e, P = errors.position_error_m(), errors.covariance_m2
    off = 0.5 * (P[:, 0, 1] + P[:, 1, 0])
    with np.errstate(invalid="ignore", divide="ignore"):
        first = np.sqrt(P[:, 0, 0])
        below = off / first
        second = np.sqrt(P[:, 1, 1] - below**2)
        east = e[:, 0] / first
        values = np.stack([east, (e[:, 1] - below * east) / second], axis=1)
    values[~np.isfinite(values).all(axis=1)] = np.nan
    return Whitened("position", errors.t_ns, values)


def heading(errors: Errors) -> Whitened:
    """Heading errors over their sigma; NaN where the reference has no heading or sigma is 0."""
    sigma = np.where(errors.yaw_sigma_rad > 0.0, errors.yaw_sigma_rad, np.nan)
    return Whitened("heading", errors.t_ns, (errors.yaw_error_rad() / sigma)[:, None])


def innovations(found: Sequence[Innovation]) -> tuple[Whitened, ...]:
    """Normalised innovations of each sensor, those that a gate refused among them.

    The innovation's own direction stands for the whitened one (equal where its covariance is
    isotropic): it only decides how correlated two samples are, never the NIS.
    """
    out = []
    for sensor in dict.fromkeys(i.sensor for i in found):
        of = [i for i in found if i.sensor == sensor and i.dof > 0 and np.isfinite(i.nis)]
        of = [i for i in of if i.dof == of[0].dof]
        if not of:
            continue
        dof = of[0].dof
        value = np.array([np.ravel(i.value)[:dof] for i in of], dtype=float)
        size = np.linalg.norm(value, axis=1)
        nis = np.array([i.nis for i in of])
        along = np.divide(value, size[:, None], out=np.full_like(value, dof**-0.5), where=size[:, None] > 0.0)
        out.append(Whitened(f"nis {sensor}", np.array([i.t_ns for i in of]), along * np.sqrt(nis)[:, None]))
    return tuple(out)


def pair_counts(rows: Rows) -> Array:
    """Number of pairs of the chosen rows (N,) that are k rows apart, (N,), k = 0 ... N - 1; exact."""
    return np.rint(_correlate(rows.astype(float)))


def squared_correlation(values: Array, rows: Rows) -> Array:
    """rho(k)^2 (N,) of whitened errors (N, d) over the chosen rows, truncated; mean over d."""
    pairs = pair_counts(rows)
    total = np.zeros(len(rows))
    for column in np.where(rows[:, None], values, 0.0).T:
        sums = _correlate(column)
        if not sums[0] > 0.0:
            total[0] += 1.0
            continue
        rho = np.divide(sums * pairs[0], sums[0] * pairs, out=np.zeros_like(sums), where=pairs > 0.5)
        ends = np.flatnonzero((rho <= 0.0) & (pairs > 0.5))
        rho[ends[0] if len(ends) else len(rho) :] = 0.0
        total += np.minimum(rho, 1.0) ** 2
    return total / values.shape[1]


def effective_samples(rows: Rows, correlation: Array) -> float:
    """Equivalent number of independent samples of the chosen rows, 1 to their number.

    `correlation` is rho(k)^2 at lag k rows, from `squared_correlation`.
    """
    inside = np.flatnonzero(rows)
    if not len(inside):
        return 0.0
    pairs = pair_counts(rows[inside[0] : inside[-1] + 1])
    both = float(pairs[0] * correlation[0] + 2.0 * pairs[1:] @ correlation[1 : len(pairs)])
    return min(float(len(inside)), max(1.0, len(inside) ** 2 / both))


def band(degrees: float, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Central interval of a chi-square variable of `degrees` degrees of freedom (> 0) over their number."""
    from scipy.special import gammaincinv

    tail = 0.5 * (1.0 - confidence)
    low, high = (2.0 * float(gammaincinv(0.5 * degrees, p)) / degrees for p in (tail, 1.0 - tail))
    return low, high


def summarise(
    whitened: Whitened, rows: Rows, start_ns: int, terrain: str = ALL, correlation: Array | None = None
) -> Consistency | None:
    """Mean and band over the chosen rows (N,), or None if none of them is known.

    Without `correlation` it is estimated from these rows.
    """
    rows = rows & whitened.known()
    if not rows.any():
        return None
    if correlation is None:
        correlation = squared_correlation(whitened.values, rows)
    effective = effective_samples(rows, correlation)
    low, high = band(effective * whitened.values.shape[1])
    t_s = (whitened.t_ns[rows][[0, -1]] - start_ns) * 1e-9
    mean = float(whitened.squares()[rows].mean())
    return Consistency(
        whitened.quantity, terrain, float(t_s[0]), float(t_s[1]), int(rows.sum()), effective, mean, low, high
    )


def by_terrain(whitened: Whitened, label: NDArray[np.str_], start_ns: int) -> tuple[Consistency, ...]:
    """The whole run, then each terrain of the labels (N,) in order of appearance."""
    everything = np.ones(len(label), dtype=bool)
    rows = [summarise(whitened, everything, start_ns)]
    names = list(dict.fromkeys(label.tolist()))
    rows += [summarise(whitened, label == name, start_ns, name) for name in names]
    return tuple(row for row in rows if row is not None)


def over_time(whitened: Whitened, start_ns: int, window_s: float = WINDOW_S) -> tuple[Consistency, ...]:
    """Window by window from the start of the recording, with the correlation of the whole run."""
    if not whitened.known().any():
        return ()
    correlation = squared_correlation(whitened.values, whitened.known())
    window = ((whitened.t_ns - start_ns) // round(window_s * 1e9)).astype(np.int64)
    found = [
        summarise(whitened, window == k, start_ns, correlation=correlation)
        for k in np.unique(window).tolist()
    ]
    return tuple(one for one in found if one is not None)


def ground_at(recording: Recording, estimate: Estimate, t_ns: TimesNs) -> NDArray[np.str_]:
    """The terrain (N,) at each time: annotated or simulated if the recording has it, else as estimated.

    A label holds until the next one, the first also before its time.
    """
    terrain = recording.terrain
    if terrain is not None and len(terrain) and terrain.source in TRUE_SOURCES:
        return _held(terrain.t_ns, terrain.label, t_ns)
    return estimated_ground_at(estimate, t_ns)


def estimated_ground_at(estimate: Estimate, t_ns: TimesNs) -> NDArray[np.str_]:
    """The most probable terrain (N,) at each time, "unknown" from an estimate without classes."""
    if not estimate.classes or not len(estimate.trajectory):
        return np.full(len(t_ns), "unknown")
    return _held(estimate.trajectory.t_ns, estimate.dominant_terrain(), t_ns)


def _held(clock: TimesNs, label: NDArray[np.object_] | NDArray[np.str_], t_ns: TimesNs) -> NDArray[np.str_]:
    return np.asarray(label[np.maximum(np.searchsorted(clock, t_ns, side="right") - 1, 0)], dtype=str)


def whitened_series(
    estimate: Estimate, position_errors: Errors | None, heading_errors: Errors | None
) -> tuple[Whitened, ...]:
    """Whitened position and heading errors against their references, and innovations by sensor."""
    against = [] if position_errors is None else [position(position_errors)]
    against += [] if heading_errors is None else [heading(heading_errors)]
    return tuple(one for one in (*against, *innovations(estimate.innovations)) if one.known().any())


def _correlate(column: Array) -> Array:
    """sum over t of x(t) x(t + k), (N,), by the fast Fourier transform with zero padding."""
    from scipy.fft import irfft, next_fast_len, rfft

    size = next_fast_len(2 * len(column), real=True)
    spectrum = rfft(column, size)
    return np.asarray(irfft(np.abs(spectrum) ** 2, size)[: len(column)])
