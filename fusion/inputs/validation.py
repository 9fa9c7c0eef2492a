"""Checks of samples before an estimator uses them.

What is no sample (no time, another shape, a missing number) is refused with a `DataError`, and the estimator
goes on with the next. Numbers that no ground robot has are left out and counted, so that one bad message ends
no run.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from terrafusion.datasets.core.arrays import Array, Stamp
from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.sensors import ASSUMED_SIGMA_M, ASSUMED_VELOCITY_SIGMA_MPS

MOST_RADPS, MOST_MPS2 = 100.0, 2000.0
"""Beyond these no gyro (35 to 70 rad/s) or accelerometer (some 200 g) of a robot measures."""
MOST_MPS, MOST_TRAVEL_M = 100.0, 1e9
"""Speed of a ground robot, and distance that a counter of its wheels may show."""
MOST_AWAY_M, MOST_HEIGHT_M = 2e7, 1e5
"""Half the circumference of the earth; heights are below the stratosphere."""
_FLOAT = np.dtype(float)
LEAST_REPORTED_SIGMA_M, MOST_REPORTED_SIGMA_M = 1e-3, 1e3
"""Reported sigmas outside this range are replaced by that of the class of fix; without a class the smaller
ones are raised to it."""


@dataclass(frozen=True, eq=False)
class GnssFix:
    """One fix: antenna position (3,) and sigma (3,), ENU m; velocity (3,) m/s and its sigma where known.

    `fix` is the receiver's class of fix, None where it reports none.
    """

    t_ns: int
    enu_m: Array
    sigma_m: Array
    velocity_mps: Array | None = None
    sigma_v_mps: float = float("nan")
    fix: Fix | None = None

    @property
    def horizontal_sigma_m(self) -> float:
        """The larger of its sigmas east and north."""
        return max(self.sigma_m[:2].tolist())


def checked_time(t_ns: Any, channel: str) -> int:
    """A time as an integer of ns.

    Raises:
        DataError: it is neither an integer nor a datetime64, or lies outside 64 bits.
    """
    if type(t_ns) is not int:
        if isinstance(t_ns, np.datetime64) and not np.isnat(t_ns):
            t_ns = int(t_ns.astype("datetime64[ns]").astype(np.int64))
        elif isinstance(t_ns, (int, np.integer)) and not isinstance(t_ns, bool):
            t_ns = int(t_ns)
        else:
            raise DataError(
                f"the time {t_ns!r} is no integer", channel=channel, remedy="give nanoseconds, such as 10**9"
            )
    if not -(2**63) < t_ns < 2**63:
        raise DataError(f"the time {t_ns} ns has more than 64 bits", channel=channel, remedy="give ns")
    return int(t_ns)


def as_numbers(values: ArrayLike | None, what: str, channel: str) -> Array:
    """Values as an array of floats of its own: a driver may fill its buffer again.

    Raises:
        DataError: they are no numbers.
    """
    if type(values) is np.ndarray and values.dtype is _FLOAT:
        return values.copy()
    try:
        return np.array(values, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise DataError(f"{what} {values!r}: no numbers", channel=channel, remedy="give floats") from None


def as_number(value: Any, what: str, channel: str) -> float:
    """A value as a float.

    Raises:
        DataError: it is no single number.
    """
    if type(value) is float:
        return value
    number = as_numbers(value, what, channel)
    if number.ndim:
        raise DataError(
            f"{what} {value!r} has {number.size} values", channel=channel, remedy="give one number"
        )
    return float(number)


def beyond(reading: Array, limit: float) -> bool:
    """Whether any value of a reading is larger than a limit, either way."""
    # No generator: every IMU sample comes here.
    for x in reading.tolist():  # noqa: SIM110
        if x > limit or x < -limit:
            return True
    return False


def checked_fix(
    t_ns: Stamp,
    enu_m: ArrayLike,
    sigma_m: ArrayLike | None,
    velocity_mps: ArrayLike | None,
    sigma_v_mps: float,
    fix: Fix | int | str | None,
) -> GnssFix | None:
    """A fix as the graph takes it; None where the receiver reports that it has none.

    A sigma that is missing, NaN, below 1 mm or above 1 km is replaced by that of the class of fix
    (`ASSUMED_SIGMA_M`; up twice as much). Without a class, less than 1 mm is taken for 1 mm, and a fix of
    more than 1 km is none. A velocity without a positive sigma has `ASSUMED_VELOCITY_SIGMA_MPS`, one without
    its upward part measures the others; a height without a sigma is free.

    Raises:
        DataError: no time, no east or north, an unknown class of fix, neither sigma nor class, or a
            velocity of other than three axes.
    """
    t_ns = checked_time(t_ns, "gnss")
    position = as_numbers(enu_m, "position", "gnss")
    known = _class_of(fix)
    if known is Fix.NONE:
        return None
    if position.shape != (3,) or not math.isfinite(position[0] + position[1]):
        raise DataError("a fix without east and north", channel="gnss", remedy="leave invalid fixes out")
    if beyond(position[:2], MOST_AWAY_M):
        raise DataError(
            f"a fix at {position[:2].tolist()} m lies beyond the earth",
            channel="gnss",
            remedy="give metres east and north of a datum",
        )
    if not abs(position[2]) <= MOST_HEIGHT_M:
        position = np.append(position[:2], np.nan)
    sigma = _sigma_of(sigma_m, known)
    if sigma is None:
        return None
    velocity = None if velocity_mps is None else as_numbers(velocity_mps, "velocity", "gnss")
    if velocity is not None and velocity.shape != (3,):
        raise DataError(
            f"a velocity of shape {velocity.shape}", channel="gnss", remedy="give east, north, up"
        )
    if velocity is not None:  # the estimator refuses and counts it; its square must not overflow
        velocity = np.minimum(np.maximum(velocity, -MOST_TRAVEL_M), MOST_TRAVEL_M)
    sigma_v_mps = as_number(sigma_v_mps, "velocity sigma", "gnss")
    if not 0.0 < sigma_v_mps < np.inf:  # as drivers tell that they do not know it
        sigma_v_mps = ASSUMED_VELOCITY_SIGMA_MPS
    return GnssFix(t_ns, position, sigma, velocity, sigma_v_mps, known)


def _sigma_of(sigma_m: ArrayLike | None, known: Fix | None) -> Array | None:
    """1 sigma (3,) of a fix, NaN where its height is unknown; None where it is of no use."""
    sigma = np.full(3, np.nan) if sigma_m is None else np.array(as_numbers(sigma_m, "sigma", "gnss"))
    if sigma.ndim == 0:
        sigma = np.full(3, float(sigma))
    if sigma.shape != (3,):
        raise DataError(
            f"sigma {sigma.tolist()} is neither one number nor three", channel="gnss",
            remedy="give metres, 1 sigma, for east, north and up",
        )  # fmt: skip
    level = sigma[:2].tolist()
    sensible = all(LEAST_REPORTED_SIGMA_M <= one <= MOST_REPORTED_SIGMA_M for one in level)
    if not sensible and known is not None:
        sigma = ASSUMED_SIGMA_M[known] * np.array([1.0, 1.0, 2.0])
    elif not all(0.0 < one < math.inf for one in level):
        raise DataError(
            f"sigma {sigma.tolist()} is not positive", channel="gnss", remedy="give metres, 1 sigma"
        )
    elif not sensible:
        if beyond(sigma[:2], MOST_REPORTED_SIGMA_M):
            return None
        sigma[:2] = np.maximum(sigma[:2], LEAST_REPORTED_SIGMA_M)
    sigma[2] = max(sigma[2], LEAST_REPORTED_SIGMA_M) if 0.0 < sigma[2] <= MOST_HEIGHT_M else np.nan
    return sigma


def _class_of(fix: Fix | int | str | None) -> Fix | None:
    if fix is None or isinstance(fix, Fix):
        return fix
    try:
        return Fix[fix.upper()] if isinstance(fix, str) else Fix(fix)
    except (KeyError, TypeError, ValueError):
        raise DataError(
            f"unknown class of fix {fix!r}",
            channel="gnss",
            remedy=f"give one of {', '.join(known.name.lower() for known in Fix)}",
        ) from None
