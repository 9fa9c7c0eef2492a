"""Barometer and magnetometer: units, range, hard iron. No finding is an error: both are optional."""

from collections.abc import Iterator, Mapping

import numpy as np

from terrafusion.datasets.checks.finding import CheckContext, Finding, changed, changed_field, scaled
from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.channels import Barometer, Magnetometer

CODES = {"barometer": "pressure-unit", "magnetometer": "field-unit"}
FIELDS = {"barometer": "pressure_pa", "magnetometer": "field_t"}
PRESSURE_UNITS = {"hPa": 1e2, "kPa": 1e3}
FIELD_UNITS = {"uT": 1e-6, "gauss": 1e-4, "milligauss": 1e-7, "nT": 1e-9}
NORMALISED = (0.85, 1.25)
"""Lengths of fields that were divided by the local field's size, as Xsens devices give them."""
LEAST_ROWS = 20
LEAST_COVER = 0.75
"""Share of the directions, in sectors of 30 deg, that must be seen to distinguish offset and heading."""
HARD_IRON = 0.1
"""Horizontal offset over the horizontal field from which the heading errs by up to 6 deg."""


def check_pressure(context: CheckContext) -> Iterator[Finding]:
    """Pressures must be those of the atmosphere, in pascal."""
    barometer = context.recording.barometer
    pressure = np.empty(0) if barometer is None else barometer.pressure_pa
    known = pressure[np.isfinite(pressure)]
    if not known.size:
        return
    size = float(np.median(known))
    yield from _range(
        "barometer",
        "pressure",
        size,
        Barometer.POSSIBLE_PA,
        PRESSURE_UNITS,
        "Pa",
        "name the unit of the pressures",
    )
    low, high = Barometer.POSSIBLE_PA
    beyond = (known < low) | (known > high)
    if low <= size <= high and beyond.any():
        yield Finding(
            "pressure-range", "warning", "barometer",
            f"{int(beyond.sum())} of {len(known)} pressures are outside the atmosphere's range",
            f"from {known.min():.6g} to {known.max():.6g} Pa",
            "leave these rows out",
            changed("barometer", lambda b: b.select((b.pressure_pa >= low) & (b.pressure_pa <= high))),
        )  # fmt: skip


def check_field(context: CheckContext) -> Iterator[Finding]:
    """Fields must be as strong as Earth's, in tesla, and turn about zero when the robot turns."""
    magnetometer = context.recording.magnetometer
    if magnetometer is None:
        return
    field = magnetometer.field_t[np.isfinite(magnetometer.field_t).all(axis=1)]
    if not len(field):
        return
    size = float(np.median(np.linalg.norm(field, axis=1)))
    normalised = NORMALISED[0] < size < NORMALISED[1]
    fix = (
        "give the field in tesla: only its direction is known" if normalised else "name the unit of the field"
    )
    findings = list(_range("magnetometer", "field", size, Magnetometer.POSSIBLE_T, FIELD_UNITS, "T", fix))
    yield from findings
    if not findings:
        yield from _hard_iron(field)


def _range(
    channel: str,
    quantity: str,
    size: float,
    limits: tuple[float, float],
    units: Mapping[str, float],
    unit: str,
    fix: str,
) -> Iterator[Finding]:
    if limits[0] <= size <= limits[1]:
        return
    meant = next((u for u, factor in units.items() if limits[0] <= size * factor <= limits[1]), None)
    yield Finding(
        CODES[channel], "warning", channel,
        f"the {quantity} looks like {meant}, not {unit}"
        if meant
        else f"the {quantity} is outside Earth's range",
        f"median size {size:.4g}; possible are {limits[0]:g} to {limits[1]:g} {unit}",
        f"multiply by {units[meant]:g}" if meant else fix,
        scaled(channel, units[meant], FIELDS[channel]) if meant else None,
    )  # fmt: skip


def _hard_iron(field: Array) -> Iterator[Finding]:
    fitted = circle(field[:, :2])
    if fitted is None:
        return
    centre, radius = fitted
    offset = float(np.hypot(*centre))
    if offset <= HARD_IRON * radius:
        return
    worst = np.degrees(np.arcsin(min(offset / radius, 1.0)))
    yield Finding(
        "hard-iron", "warning", "magnetometer",
        f"the robot's own iron turns the compass by up to {worst:.0f} deg",
        f"over the turns of the run the horizontal field circles ({centre[0] * 1e6:.1f}, "
        f"{centre[1] * 1e6:.1f}) uT at a radius of {radius * 1e6:.1f} uT",
        "subtract that offset, assuming level ground",
        changed_field("magnetometer", "field_t", lambda field_t: field_t - np.append(centre, 0.0)),
    )  # fmt: skip


def circle(points: Array) -> tuple[Array, float] | None:
    """Centre (2,) and radius of a circle through points (N, 2), where they lie all around it; else None.

    Least squares of x^2 + y^2 = 2 a x + 2 b y + c (Kasa 1976, IEEE Trans. Instrum. Meas. 25(1)).
    """
    if len(points) < LEAST_ROWS:
        return None
    scale = float(np.abs(points).max())
    if scale == 0.0:
        return None
    x = points / scale
    A = np.column_stack([2.0 * x, np.ones(len(x))])
    solved, _, rank, _ = np.linalg.lstsq(A, (x**2).sum(axis=1), rcond=1e-9)
    square = float(solved[2] + solved[:2] @ solved[:2])
    if rank < 3 or square <= 0.0:
        return None
    angle = np.arctan2(*(x - solved[:2]).T[::-1])
    seen = np.unique(np.floor((angle + np.pi) / np.radians(30.0)).astype(int) % 12)
    if len(seen) < LEAST_COVER * 12:
        return None
    return solved[:2] * scale, float(np.sqrt(square)) * scale
