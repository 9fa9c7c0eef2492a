"""Parameters as the solver sees them: scaled by their priors."""

import math
from dataclasses import dataclass
from typing import Self

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.quantity import Quantity

PRIOR_FACTOR = 0.5
"""Sigma of the logarithm of a positive number by default (assumed): known to a factor of 1.65."""
PRIOR_SHARE = 0.05
"""Sigma of any other number by default (assumed), as a share of its range."""


@dataclass(frozen=True)
class Prior:
    """Prior of a parameter: value and 1 sigma, in its unit."""

    value: float
    sigma: float


@dataclass(frozen=True)
class Coordinate:
    """A parameter as the solver sees it: w = 0 at the prior, 1 at one prior sigma.

    A positive number moves by its logarithm, any other one linearly: the solver does not depend on units.

    Attributes:
        unit: of the number.
        low, high: its range.
        prior: value at w = 0.
        scale: prior sigma, of the logarithm where `logarithmic`.
        logarithmic: how the number moves.
        start: value the search starts from.
    """

    name: str
    unit: str
    low: float
    high: float
    prior: float
    scale: float
    logarithmic: bool
    start: float

    @classmethod
    def of(
        cls, name: str, quantity: Quantity, start: float, prior: Prior | None, typical: float | None = None
    ) -> Self:
        """The coordinate of a number that stands at `start` in the model; without a prior that is the prior,
        as wide as an effect's `typical` size.

        Raises:
            ConfigError: a prior outside the number's range or without a width.
        """
        value = start if prior is None else prior.value
        if prior is not None and not (
            quantity.low <= value <= quantity.high and 0.0 < prior.sigma < math.inf
        ):
            raise ConfigError(
                f"the prior {prior.value:g} +- {prior.sigma:g} of '{name}' is out of range",
                remedy=f"give {quantity.allowed()} and a positive sigma",
            )
        logarithmic = typical is None and quantity.low >= 0.0 and value > 0.0 and start > 0.0
        if prior is not None:
            scale = prior.sigma / value if logarithmic else prior.sigma
        elif typical is not None:
            scale = typical
        else:
            scale = PRIOR_FACTOR if logarithmic else PRIOR_SHARE * (quantity.high - quantity.low)
        return cls(name, quantity.unit, quantity.low, quantity.high, value, scale, logarithmic, start)

    def value(self, w: float) -> float:
        """The number at w, kept in its range."""
        moved = (
            self.prior * math.exp(min(self.scale * w, 700.0))
            if self.logarithmic
            else self.prior + self.scale * w
        )
        return min(max(moved, self.low), self.high)

    def at(self, value: float) -> float:
        """w of a number."""
        if self.logarithmic:
            return math.log(value / self.prior) / self.scale
        return (value - self.prior) / self.scale

    def rate(self, w: float) -> float:
        """Derivative of the number by w."""
        return self.scale * (self.value(w) if self.logarithmic else 1.0)

    def bounds(self) -> tuple[float, float]:
        """Range of w."""
        low = -math.inf if self.logarithmic and self.low <= 0.0 else self.at(self.low)
        return low, self.at(self.high)
