"""Ground labels for the estimator, in place of its terrain detector while nothing contradicts them."""

import bisect
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.fusion.terrain.classifier import UNKNOWN


@dataclass(frozen=True)
class GroundLabels:
    """The ground over time: label k holds from `t_ns[k]` to the next, the first also before it.

    For comparisons with the true ground, and for robots that know it from a map.

    Attributes:
        t_ns: increasing times.
        names: a terrain name for each; one that the policy does not know counts as unknown ground.

    Raises:
        ConfigError: no labels, not as many as times, or times that do not increase.
    """

    t_ns: tuple[int, ...]
    names: tuple[str, ...]

    def __post_init__(self) -> None:
        ordered = all(a < b for a, b in zip(self.t_ns, self.t_ns[1:], strict=False))
        if not self.t_ns or len(self.t_ns) != len(self.names) or not ordered:
            raise ConfigError(
                f"{len(self.names)} ground labels at {len(self.t_ns)} times",
                remedy="give one label for each of increasing times",
            )

    def at(self, t_ns: int) -> str:
        """The label in force."""
        return self.names[max(bisect.bisect_right(self.t_ns, t_ns) - 1, 0)]

    def probabilities(self, t_ns: int, classes: tuple[str, ...]) -> NDArray[np.float64]:
        """Certainty (k,) of the label in force, or of `UNKNOWN` where it is none of the classes."""
        name = self.at(t_ns)
        p = np.zeros(len(classes))
        p[classes.index(name if name in classes else UNKNOWN)] = 1.0
        return p
