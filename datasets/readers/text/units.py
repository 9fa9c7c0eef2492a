"""Units that a column of a table may be in, by the unit that ends the name of its field."""

import math

from terrafusion.datasets.core.frames import GRAVITY_MPS2

DEG = math.pi / 180.0

UNITS: dict[str, dict[str, float]] = {
    "radps": {"rad/s": 1.0, "deg/s": DEG, "rpm": math.pi / 30.0, "rev/s": 2.0 * math.pi},
    "mps": {"m/s": 1.0, "km/h": 1.0 / 3.6, "cm/s": 1e-2, "mm/s": 1e-3, "mph": 0.44704, "kn": 1852.0 / 3600.0},
    "mps2": {"m/s2": 1.0, "g": GRAVITY_MPS2, "mg": 1e-3 * GRAVITY_MPS2, "cm/s2": 1e-2, "mm/s2": 1e-3},
    "m": {"m": 1.0, "km": 1e3, "cm": 1e-2, "mm": 1e-3, "ft": 0.3048},
    "rad": {"rad": 1.0, "deg": DEG, "rev": 2.0 * math.pi},
    "deg": {"deg": 1.0, "rad": 1.0 / DEG, "1e-7 deg": 1e-7},
    "pa": {"Pa": 1.0, "hPa": 1e2, "mbar": 1e2, "kPa": 1e3},
    "t": {"T": 1.0, "mT": 1e-3, "uT": 1e-6, "nT": 1e-9, "G": 1e-4, "mG": 1e-7},
    "a": {"A": 1.0, "mA": 1e-3},
    "v": {"V": 1.0, "mV": 1e-3},
    "": {"1": 1.0, "%": 1e-2},
}
"""Factor from each unit to that of the field, the first. g: standard gravity; mph, kn, ft: international."""


def units_of(field: str) -> dict[str, float]:
    """The units that a column for `field` may be in, with their factors."""
    ending = field.rpartition("_")[2]
    numeric = field.startswith(("p_", "cov_", "q")) or "_" not in field
    return UNITS[""] if numeric or ending not in UNITS else UNITS[ending]
