"""Ground that varies over the plane: a random field of strength and patches of another soil, from a seed.

The strength's logarithm is a Gaussian field of standard deviation `strength_sigma` whose correlation
falls as exp(-(d / length_m)^2) with the distance d (the squared-exponential model of random-field
practice: Vanmarcke 1977). It is drawn on a periodic grid by filtering white noise in the frequency
domain, so it has no border and costs one FFT. Patches are where a second such field is high.
"""

import zlib
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.quantity import Quantity
from terrafusion.twin.model.plant import RouteTable, SoilField
from terrafusion.twin.physics.layout import ENDS, INDEX, SIDES, SOIL_PARAMETERS, VEHICLE_PARAMETERS

CELLS_A_LENGTH = 5.0
"""Grid points in the shorter correlation length: bilinear values between them lose at most 2 % of sigma."""
MIN_CELLS, MAX_CELLS = 256, 1024
"""Grid points along a side."""
LENGTHS_A_SIDE = 10.0
"""The grid repeats after at least this many of the longer correlation length."""
BORDER = 0.15
"""Width of a patch's border in sigmas of its field: about a fifth of `length_m` on the ground."""

STRENGTH_RESPONSE = {
    "k_c": 1.0, "k_phi": 1.0, "cohesion_pa": 1.0, "tan_friction": 0.3, "friction_cap": 0.3
}  # fmt: skip
"""Exponent with which each soil parameter follows the local strength.

Stiffness and cohesion follow in full; friction varies about 0.3 as much: coefficients of variation of
2 to 13 % for friction angles stand against 10 to 50 % for undrained strength (Phoon and Kulhawy 1999).
"""


@dataclass(frozen=True)
class Variation:
    """Strength of the ground: sigma of its logarithm, and the distance at which correlation falls to 1/e."""

    strength_sigma: Annotated[float, Quantity("", 0.0, 1.0)]
    length_m: Annotated[float, Quantity("m", 0.1, 1000.0)]


@dataclass(frozen=True)
class SoilPatches:
    """Patches of `terrain` that cover `share` of the plane; `length_m` sets their size."""

    terrain: str
    share: Annotated[float, Quantity("", 0.0, 1.0)]
    length_m: Annotated[float, Quantity("m", 0.1, 1000.0)]


def gaussian_field(cells: int, cell_m: float, length_m: float, rng: np.random.Generator) -> Array:
    """Periodic Gaussian field (cells, cells), zero mean and unit variance over realisations.

    Correlation exp(-(d / length_m)^2): its spectrum exp(-(k length_m)^2 / 4) shapes white noise.
    """
    from scipy import fft

    k = 2.0 * np.pi * fft.fftfreq(cells, cell_m)
    half = 2.0 * np.pi * fft.rfftfreq(cells, cell_m)
    along = np.exp(-((k * length_m) ** 2) / 8.0)
    amplitude = along[:, None] * np.exp(-((half * length_m) ** 2) / 8.0)
    # Variance of the filtered noise is the mean of the squared amplitude over the whole grid.
    unit = amplitude / np.mean(along**2)
    return np.asarray(fft.irfft2(fft.rfft2(rng.normal(size=(cells, cells))) * unit, s=(cells, cells)))


def soil_field(
    variation: Variation | None, patches: SoilPatches | None, patch_soil: Array | None, seed: int
) -> SoilField | None:
    """The field of one seed, None where the ground neither varies nor has patches.

    Args:
        variation: of the strength; its mean over realisations is that of the soil itself.
        patches: of another soil.
        patch_soil: (S,) `SOIL_PARAMETERS` of that soil.
        seed: strength and patches each have their own stream of it.

    Raises:
        ConfigError: the correlation lengths are too far apart for one grid.
    """
    lengths = [spec.length_m for spec in (variation, patches) if spec is not None]
    if not lengths:
        return None
    cells, cell_m = _grid(lengths)
    log_gain, share = np.zeros((cells, cells)), np.zeros((cells, cells))
    if variation is not None:
        unit = gaussian_field(cells, cell_m, variation.length_m, random_stream(seed, "ground strength"))
        log_gain = variation.strength_sigma * unit - 0.5 * variation.strength_sigma**2
    if patches is not None:
        share = _patch_share(
            gaussian_field(cells, cell_m, patches.length_m, random_stream(seed, "ground patches")),
            patches.share,
        )
    response = np.array([STRENGTH_RESPONSE.get(name, 0.0) for name in SOIL_PARAMETERS])
    soil = np.zeros(len(SOIL_PARAMETERS)) if patch_soil is None else patch_soil
    return SoilField(cell_m, log_gain, response, share, soil)


def value_at(grid: Array, cell_m: float, x_m: Array, y_m: Array) -> Array:
    """Bilinear value (N,) of a periodic grid (rows along y) at points (N,), as the wheels meet it."""
    rows, columns = grid.shape
    column, row = x_m / cell_m, y_m / cell_m
    i, j = np.floor(column).astype(np.int64), np.floor(row).astype(np.int64)
    fc, fr = column - i, row - j
    near, far = j % rows, (j + 1) % rows
    left, right = i % columns, (i + 1) % columns
    lower = (1.0 - fc) * grid[near, left] + fc * grid[near, right]
    upper = (1.0 - fc) * grid[far, left] + fc * grid[far, right]
    return np.asarray((1.0 - fr) * lower + fr * upper)


def patch_share(field: SoilField | None, x_m: Array, y_m: Array) -> Array:
    """Share (N,) of the patch soil at points of the plane (N,), zero without a field."""
    return np.zeros_like(x_m) if field is None else value_at(field.patch_share, field.cell_m, x_m, y_m)


def _grid(lengths_m: list[float]) -> tuple[int, float]:
    """Grid points along a side, and their spacing in metres."""
    from scipy import fft

    cell_m = min(lengths_m) / CELLS_A_LENGTH
    cells = max(MIN_CELLS, int(np.ceil(LENGTHS_A_SIDE * max(lengths_m) / cell_m)))
    if cells > MAX_CELLS:
        raise ConfigError(
            f"correlation lengths of {min(lengths_m):g} and {max(lengths_m):g} m do not fit one grid",
            remedy=f"keep them within a factor of {MAX_CELLS / LENGTHS_A_SIDE / CELLS_A_LENGTH:.0f}",
        )
    return int(fft.next_fast_len(cells, real=True)), cell_m


def _patch_share(unit: Array, share: float) -> Array:
    """Share (H, W) of the patch soil: above one half on `share` of the grid, smooth at the borders."""
    from scipy.special import ndtr

    if share <= 0.0 or share >= 1.0:
        return np.full_like(unit, float(share >= 1.0))
    return np.asarray(ndtr((unit - np.quantile(unit, 1.0 - share)) / BORDER))


def random_stream(seed: int, name: str) -> np.random.Generator:
    """Generator of the stream `name`: the same seed and name give the same numbers."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, zlib.crc32(name.encode())])))


def under_wheels(route: RouteTable, vehicle: Array, t_s: Array, states: Array) -> Array:
    """`SOIL_PARAMETERS` (N, 4 S) under each wheel, wheel by wheel, at the samples (N,) of a drive.

    As the integrator has it: the route's table joined smoothly between its knots, then varied by the field.
    """
    time_weight, travel_weight = route.weights()
    half = {name: 0.5 * vehicle[VEHICLE_PARAMETERS.index(f"{name}_m")] for name in ("wheelbase", "track")}
    x, y, yaw, travel = (states[:, INDEX[name]] for name in ("x", "y", "yaw", "travel"))
    wheels = []
    for end, side in zip(ENDS, SIDES, strict=True):
        ahead, left = end * half["wheelbase"], side * half["track"]
        soil = route.along(route.soil, time_weight * t_s + travel_weight * (travel + ahead))
        if route.field is not None:
            place = x + np.cos(yaw) * ahead - np.sin(yaw) * left, y + np.sin(yaw) * ahead + np.cos(yaw) * left
            gain = value_at(route.field.log_gain, route.field.cell_m, *place)
            soil = soil * np.exp(gain[:, None] * route.field.response)
            share = patch_share(route.field, *place)[:, None]
            soil = soil + share * (route.field.patch_soil - soil)
        wheels.append(soil)
    return np.hstack(wheels)
