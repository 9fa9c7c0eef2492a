"""Soil that varies: random fields over the plane, one set a run, and one draw a run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.blind.plant.spec import RunSpec

Array = NDArray[np.float64]

WAVES = 10
QUANTITIES = ("strength", "bearing", "modulus")
WEIGHTS = {"strength": 1.0, "bearing": 2.0, "modulus": -1.5}
"""How far each quantity's logarithm varies beside that of the strength (assumed)."""
SHARED = 0.7  # correlation of the quantities: dense ground is strong, stiff and shears early (assumed)


class PlantSoilField:
    """Logarithms of the gains of `QUANTITIES` at the wheels of all runs.

    A sum of plane waves with Gaussian wave vectors has a squared-exponential correlation (random Fourier
    features, Rahimi and Recht 2007).
    """

    def __init__(self, specs: Sequence[RunSpec]) -> None:
        drawn = [_drawn(spec) for spec in specs]
        self._base = np.stack([d[0] for d in drawn], axis=-1)  # (3, B)
        self._amplitude = np.stack([d[1] for d in drawn], axis=-1)  # (3, W, B)
        self._kx, self._ky, self._phase = (
            np.stack([d[i] for d in drawn], axis=-1) for i in (2, 3, 4)
        )  # (W, B)
        self._even = not self._amplitude.any()

    def at(self, x: Array, y: Array) -> Array:
        """Logarithms (3, 4, B) at places (4, B), m."""
        base = np.broadcast_to(self._base[:, None, :], (len(QUANTITIES), *x.shape))
        if self._even:
            return base
        wave = np.cos(self._kx[:, None] * x + self._ky[:, None] * y + self._phase[:, None])  # (W, 4, B)
        return np.asarray(base + np.einsum("qwb,wib->qib", self._amplitude, wave))


def _drawn(spec: RunSpec) -> tuple[Array, Array, Array, Array, Array]:
    rng = spec.stream("ground")
    weight = np.array([WEIGHTS[name] for name in QUANTITIES])
    common, own = rng.normal(), rng.normal(size=len(QUANTITIES))
    mixed = SHARED * common + np.sqrt(1.0 - SHARED**2) * own
    kx, ky = rng.normal(0.0, 1.0 / spec.ground.length_m, (2, WAVES))
    phase = rng.uniform(0.0, 2.0 * np.pi, WAVES)
    signs = np.where(rng.uniform(size=(len(QUANTITIES), WAVES)) < 0.5 * (1.0 + SHARED), 1.0, -1.0)
    size = 0.0 if spec.noiseless else 1.0
    amplitude = size * spec.ground.within * np.sqrt(2.0 / WAVES) * weight[:, None] * signs
    return size * spec.ground.between * weight * mixed, amplitude, kx, ky, phase
