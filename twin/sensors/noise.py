"""Random series of the sensor models, and the streams they are drawn from."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.gauss_markov import markov_decay, markov_spread
from terrafusion.twin.model.ground import random_stream

PLANE_WAVES = 24
"""Waves in the sum of `place_field`."""
FLICKER_RATIO = math.sqrt(10.0)
"""Ratio of neighbouring correlation times of `flicker`."""
FLICKER_TIMES_S = tuple(FLICKER_RATIO**k for k in range(8))
"""Correlation times of `flicker`: 1 s to 3162 s."""
FLICKER_STEP_S = 0.25
"""Flicker is drawn at this interval, a quarter of its shortest correlation time, and is linear between."""
FLOOR_PER_INSTABILITY = math.sqrt(2.0 * math.log(2.0) / math.pi)
"""Floor of the Allan deviation over the coefficient of bias instability, 0.664 (IEEE Std 952-1997)."""


@dataclass(frozen=True)
class NoiseStreams:
    """Named random streams of one seed, or none of them when noiseless."""

    seed: int
    noiseless: bool = False

    def stream(self, name: str) -> np.random.Generator:
        """The generator of the stream `name`; the same seed and name give the same numbers."""
        return random_stream(self.seed, name)


def rows_at_rate(count: int, sample_hz: float, rate_hz: float) -> NDArray[np.int64]:
    """Rows of a series at `sample_hz` nearest to the ticks of a sensor at `rate_hz`, the first at row 0."""
    ratio = max(sample_hz / rate_hz, 1.0)
    ticks = np.round(ratio * np.arange(int((count - 1) / ratio + 1e-9) + 1)).astype(np.int64)
    return ticks[ticks < count]


def sample_rate_hz(t_s: Array) -> float:
    """Mean rate of the samples t_s (N,)."""
    return (len(t_s) - 1) / float(t_s[-1] - t_s[0])


def gauss_markov(rng: np.random.Generator, count: int, interval_s: float, correlation_s: float) -> Array:
    """First-order Gauss-Markov series (count, 3) of unit variance, stationary from the start."""
    from scipy.signal import lfilter

    keep = float(markov_decay(interval_s, correlation_s)) if correlation_s > 0.0 else 0.0
    drive = rng.normal(size=(count, 3))
    drive[1:] *= markov_spread(keep)
    return np.asarray(lfilter([1.0], [1.0, -keep], drive, axis=0))


def white_and_walk(
    rng: np.random.Generator, count: int, rate_hz: float, density: float, walk: float, bias_sigma: float
) -> Array:
    """White noise, turn-on bias and bias random walk (count, 3) of a triad sampled at `rate_hz`."""
    white = rng.normal(0.0, density * math.sqrt(rate_hz), (count, 3))
    steps = rng.normal(0.0, walk / math.sqrt(rate_hz), (count, 3))
    return np.asarray(white + rng.normal(0.0, bias_sigma, 3) + np.cumsum(steps, axis=0))


def flicker(rng: np.random.Generator, count: int, rate_hz: float, floor: float) -> Array:
    """Bias instability (count, 3): 1/f noise whose Allan deviation is flat at `floor`.

    A sum of Gauss-Markov processes of one variance q^2 and correlation times spaced
    by the ratio r has the one-sided spectrum q^2 / (f ln r) between them (Keshner 1982); bias
    instability B has B^2 / (pi f), so q = B sqrt(ln r / pi), and the floor is 0.664 B (IEEE Std 952-1997).
    """
    coarse = math.ceil(count / rate_hz / FLICKER_STEP_S) + 2
    total = sum(gauss_markov(rng, coarse, FLICKER_STEP_S, time_s) for time_s in FLICKER_TIMES_S)
    q = floor / FLOOR_PER_INSTABILITY * math.sqrt(math.log(FLICKER_RATIO) / math.pi)
    at = np.arange(count) / rate_hz
    grid = FLICKER_STEP_S * np.arange(coarse)
    return q * np.stack([np.interp(at, grid, column) for column in np.asarray(total).T], axis=1)


def band_noise(rng: np.random.Generator, count: int, rate_hz: float, low_hz: float, high_hz: float) -> Array:
    """Six series (count, 6) of unit variance between two frequencies (Butterworth), held below Nyquist."""
    from scipy.signal import butter, sosfilt

    top = 0.45 * rate_hz
    low, high = min(low_hz, 0.5 * top), min(high_hz, top)
    band = butter(2, [low, high], btype="bandpass", fs=rate_hz, output="sos")
    settle = int(3.0 * rate_hz / low) + 1
    series = sosfilt(band, rng.normal(size=(count + settle, 6)), axis=0)[settle:]
    impulse = sosfilt(band, np.eye(1, max(settle, 4096))[0])
    return np.asarray(series / math.sqrt(float(np.sum(impulse**2))))


def stepped(values: Array, quantum: float) -> Array:
    """The values rounded to multiples of `quantum`; unchanged where it is 0."""
    return np.round(values / quantum) * quantum if quantum > 0.0 else values


def place_field(position_m: Array, length_m: float, rng: np.random.Generator) -> Array:
    """A fixed random field (N, 3) over the ground, of variance `PLANE_WAVES` / 2 an axis.

    A sum of plane waves with Gaussian wave vectors: its correlation is squared-exponential over `length_m`
    (random Fourier features, Rahimi and Recht 2007).
    """
    waves = rng.normal(0.0, 1.0 / length_m, (3, 2, PLANE_WAVES))
    phase = rng.uniform(0.0, 2.0 * np.pi, (3, PLANE_WAVES))
    parts = [np.cos(position_m[:, :2] @ w + p).sum(axis=1) for w, p in zip(waves, phase, strict=True)]
    return np.stack(parts, axis=1)
