"""The weighting policy: terrain class -> noise of each sensor.

A policy is one YAML file made by `terrafusion policy fit` from twin runs, with the hash of its inputs.
Where the class is uncertain, the noise is the moment match of the mixture: its variance includes the
spread of the class means (law of total variance).
"""

import dataclasses
import functools
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.config import quantities, structure
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.printable import counted
from terrafusion.datasets.core.quantity import Quantity, Word
from terrafusion.datasets.core.yaml_file import read_yaml

SCHEMA = "terrafusion.policy/2"


@dataclass(frozen=True)
class SensorNoise:
    """Noise of the sensors on one ground (1 sigma).

    Slip is i = 1 - v / (omega R), positive when driving wheels outrun the robot: an Ornstein-Uhlenbeck
    process about `slip_mean + slip_per_grade * grade` (grade: sine of the slope, positive where the robot
    drives uphill). Yaw scale is true over wheel yaw rate, less one. Side-slip is the lateral over the
    forward displacement.
    The inflations multiply the standard deviations of the data sheet (IMU) or of the receiver's report
    (GNSS); roll and pitch rate have another one than yaw rate, as rough ground shakes them more.
    """

    slip_mean: Annotated[float, Quantity("", -1.0, 1.0)]
    slip_per_grade: Annotated[float, Quantity("", -20.0, 20.0)]
    slip_sigma: Annotated[float, Quantity("", 1e-4, 1.0)]
    slip_time_s: Annotated[float, Quantity("s", 0.05, 600.0)]
    wheel_sigma_mps: Annotated[float, Quantity("m/s", 1e-4, 2.0)]
    yaw_scale_mean: Annotated[float, Quantity("", -0.95, 0.95)]
    yaw_scale_sigma: Annotated[float, Quantity("", 1e-4, 1.0)]
    side_slip_sigma: Annotated[float, Quantity("", 1e-4, 2.0)]
    gyro_inflation: Annotated[float, Quantity("", 1.0, 1e4)]
    gyro_yaw_inflation: Annotated[float, Quantity("", 1.0, 1e4)]
    accel_inflation: Annotated[float, Quantity("", 1.0, 1e4)]
    gnss_inflation: Annotated[float, Quantity("", 1.0, 100.0)]

    def gyro_axes(self) -> tuple[float, float, float]:
        """Inflation of the gyro about roll, pitch and yaw."""
        return self.gyro_inflation, self.gyro_inflation, self.gyro_yaw_inflation

    def slip_at(self, grade: float) -> float:
        """Expected slip at a grade (sine of the slope, uphill positive)."""
        return min(max(self.slip_mean + self.slip_per_grade * grade, -0.9), 0.9)


_FIELDS = tuple(f.name for f in dataclasses.fields(SensorNoise))
_SLIP_MEAN, _SLIP_SIGMA = _FIELDS.index("slip_mean"), _FIELDS.index("slip_sigma")
_YAW_MEAN, _YAW_SIGMA = _FIELDS.index("yaw_scale_mean"), _FIELDS.index("yaw_scale_sigma")
_SLIP_PER_GRADE, _SLIP_TIME = _FIELDS.index("slip_per_grade"), _FIELDS.index("slip_time_s")
_AVERAGED = np.array(
    [name in ("slip_mean", "slip_per_grade", "slip_time_s", "yaw_scale_mean") for name in _FIELDS]
)
"""Columns that blend as means; the others are standard deviations (or factors on them)."""
_RANGES = quantities(SensorNoise)


def within_ranges(noise: SensorNoise) -> SensorNoise:
    """The noise with every number clipped to the range that a policy file allows."""
    return SensorNoise(**{n: min(max(getattr(noise, n), q.low), q.high) for n, q in _RANGES.items()})


@dataclass(frozen=True)
class Policy:
    """Noise of the terrain classes, and the one noise of fixed weighting.

    Attributes:
        classes: class name -> noise; "unknown" is one of them.
        fixed: pooled noise, fitted to all grounds together on the same training runs.
        inputs_sha256: hash of the training inputs.
        name: file name, for messages and reports.
    """

    classes: dict[str, SensorNoise]
    fixed: SensorNoise
    inputs_sha256: str
    name: str = "policy"

    def __repr__(self) -> str:
        """A line a class, of at most ten."""
        rows = [
            f"  {name}: slip {noise.slip_mean:.3f} +- {noise.slip_sigma:.2g}, "
            f"side-slip +- {noise.side_slip_sigma:.2g}"
            for name, noise in [("fixed", self.fixed), *self.classes.items()][:11]
        ]
        return "\n".join([f"Policy '{self.name}', {counted(len(self.classes), 'class', 'classes')}", *rows])

    def names(self) -> tuple[str, ...]:
        """Class names in the file's order; probabilities are given in this order."""
        return tuple(self.classes)

    def with_grounds(self, names: Iterable[str]) -> "Policy":
        """With the pooled noise on the named grounds that it does not know."""
        return dataclasses.replace(self, classes={**dict.fromkeys(names, self.fixed), **self.classes})

    @functools.cached_property
    def _table(self) -> NDArray[np.float64]:
        return np.array([dataclasses.astuple(row) for row in self.classes.values()])

    def slips(self) -> tuple[Array, Array, Array, Array]:
        """Mean, 1 sigma, slope over the grade and correlation time (s) of the slip, (k,) each."""
        mean, sigma, slope, time_s = self._table[:, [_SLIP_MEAN, _SLIP_SIGMA, _SLIP_PER_GRADE, _SLIP_TIME]].T
        return mean, sigma, slope, time_s

    def blend(
        self,
        probabilities: ArrayLike,
        grade: float = 0.0,
        slips: tuple[Array, Array, Array, Array] | None = None,
    ) -> SensorNoise:
        """The moment-matched noise for class probabilities (k,) that sum to one, at a grade.

        `slips`: those of the classes, as `slips()` gives them, where not the policy's.

        Slip and yaw scale have the mean and the variance of the mixture (law of total variance: mean of
        the variances plus variance of the means); the other errors have zero mean in every class, so their
        variances average.
        """
        p, table = np.asarray(probabilities, dtype=float), self._table
        if slips is not None:
            table = table.copy()
            table[:, [_SLIP_MEAN, _SLIP_SIGMA, _SLIP_PER_GRADE, _SLIP_TIME]] = np.column_stack(slips)
        mean = p @ table
        variance = p @ table**2
        expected = table[:, _SLIP_MEAN] + grade * table[:, _SLIP_PER_GRADE]
        variance[_SLIP_SIGMA] += p @ (expected - p @ expected) ** 2
        scales = table[:, _YAW_MEAN]
        variance[_YAW_SIGMA] += p @ (scales - p @ scales) ** 2
        return SensorNoise(*np.where(_AVERAGED, mean, np.sqrt(variance)).tolist())


@dataclass(frozen=True)
class PolicyFile:
    """Keys of a policy file."""

    schema: Annotated[str, Word((SCHEMA,))]
    classes: dict[str, SensorNoise]
    fixed: SensorNoise
    inputs_sha256: str = ""
    made_by: str = ""


@functools.cache
def _shipped() -> Policy:
    return load_policy(Path(__file__).with_name("policy.yaml"))


def load_policy(path: str | Path | None = None) -> Policy:
    """The policy file `path`, or the one shipped with the library.

    Raises:
        ConfigError: unknown or missing key, wrong type, out of range, no `unknown` class.
    """
    if path is None:
        return _shipped()
    if not isinstance(path, str | Path):
        raise ConfigError(f"a {type(path).__name__} is no policy", remedy="give its file, or a Policy")
    path = Path(path)
    content = structure(PolicyFile, read_yaml(path), file=path)
    if "unknown" not in content.classes:
        raise ConfigError("'classes' has no 'unknown'", file=path, remedy="add the noise of unknown ground")
    return Policy(content.classes, content.fixed, content.inputs_sha256, name=path.name)
