"""Barometer: height differences, with a bias that follows the weather.

The pressure becomes a height in the standard atmosphere. It differs from the estimated height by a bias,
unknown at the start and drifting with the weather, and by a share of every climb, since the air is not as
warm as the standard's. So a barometer only holds the height of GNSS or of the start. The samples of a
second count as one.
"""

from collections.abc import Callable

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.atmosphere import height_of, height_per_pa
from terrafusion.datasets.core.channels import Barometer
from terrafusion.datasets.core.sensors import BarometerSpec
from terrafusion.fusion.estimate.estimate import Innovation
from terrafusion.fusion.estimator.slow_bias import BiasedSensor, SlowBias
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.key_state import POSE, KeyState

GENERIC = BarometerSpec(rate_hz=10.0, noise_pa=10.0, walk_paps_sqrthz=0.5, position_m=(0.0, 0.0, 0.0))
"""For a vehicle whose file has no barometer (assumed: a MEMS sensor outdoors)."""
INTERVAL_NS = 1_000_000_000
MOST_AGE_NS = 3_000_000_000
UNKNOWN_M = 1e4
SCALE_SIGMA = 0.05
"""Relative error of a height difference: air within 15 K of the standard's (assumed)."""
FREE_M = 1e5


def height_jacobian(R: Array, sensor_m: Array) -> Array:
    """Derivative (6,) of the height of a body-fixed point by the pose (GTSAM tangent)."""
    up = R[2]
    return np.concatenate([np.cross(sensor_m, up), up])


def height_factor(k: int, height_m: float, sigma_m: float, sensor_m: Array) -> gtsam.NonlinearFactor:
    """Height of the body-fixed point `sensor_m` (3,) at keyframe k; east and north are free."""
    sigmas = np.array([FREE_M, FREE_M, sigma_m])
    noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    return gtsam.GPSFactorArm(X(k), np.array([0.0, 0.0, height_m]), sensor_m, noise)


class BarometerAiding(BiasedSensor[float]):
    """Turns pressures into factors of the newest keyframe; `report` gets every innovation (m).

    After `PATIENCE` rejected seconds the pressure has jumped: a door, a hatch, a gust.
    """

    SENSOR, GATE_SIGMA, PATIENCE = "barometer", 4.0, 10

    def __init__(self, spec: BarometerSpec | None, report: Callable[[Innovation], None]) -> None:
        super().__init__(report)
        self.spec = spec or GENERIC
        self.bias: SlowBias | None = None
        self.jumps = 0
        self._mean = [0.0, 0.0]
        self._due_ns: int | None = None
        self._last_ns = 0
        self._datum_m = 0.0
        self._aligned = False
        self._slope = 0.0

    def add(self, t_ns: int, pressure_pa: float) -> None:
        """One pressure; impossible values are rejected."""
        low, high = Barometer.POSSIBLE_PA
        if low <= pressure_pa <= high:
            self._hold(int(t_ns), float(pressure_pa))
        else:
            self.refused += 1

    @property
    def active(self) -> bool:
        """Whether a sample has ever come."""
        return bool(self._samples) or self.bias is not None or self._mean[1] > 0.0

    def update(
        self, chain: Chain, t_ns: int, newest_ns: int, before: Array, after: Array, aligned: bool = False
    ) -> bool:
        """Use the samples up to the newest keyframe; True where a factor was added.

        `before` and `after` (n, n) are the newest keyframe's covariance, without and with the other
        measurements of this keyframe; `aligned`: a local path was aligned with the map, heights too. The
        newest IMU sample is at `newest_ns`.
        """
        if aligned and not self._aligned:
            self._aligned, self._mean, self._due_ns = True, [0.0, 0.0], None
            self._forget_offset()
        key = chain.state(chain.last)
        lever = np.array(self.spec.position_m)
        jacobian = height_jacobian(key.rotation, lever)
        was, now = (float(jacobian @ P[POSE, POSE] @ jacobian) for P in (before, after))
        if self.bias is not None:
            self.bias.state_updated(was, now)
        height = float(key.place_of(lever)[2])
        self._gather(t_ns, newest_ns, height, key)
        if self._due_ns is None:
            self._due_ns = t_ns + INTERVAL_NS
        if t_ns < self._due_ns or not self._mean[1]:
            return False
        self._due_ns = t_ns + INTERVAL_NS
        return self._measure(chain, t_ns, height, now)

    def _gather(self, t_ns: int, newest_ns: int, height_m: float, key: KeyState) -> None:
        """Sums of pressure height less estimated height over the samples up to now."""
        for at_ns, pressure in self._due(t_ns, newest_ns, MOST_AGE_NS):
            relative = height_m - float(key.velocity[2]) * (t_ns - at_ns) * 1e-9
            self._mean[0] += float(height_of(pressure)) - relative
            self._mean[1] += 1.0
            self._slope = abs(float(height_per_pa(pressure)))

    def _measure(self, chain: Chain, t_ns: int, height_m: float, variance: float) -> bool:
        total, count = self._mean
        self._mean = [0.0, 0.0]
        offset = total / count
        per_pa = self._slope
        noise = (self.spec.noise_pa * per_pa) ** 2 / count
        if self.bias is None:
            self._datum_m = height_m
            self.bias = SlowBias.of(np.array([offset, 0.0]), np.array([UNKNOWN_M, SCALE_SIGMA]))
        else:
            walk = (self.spec.walk_paps_sqrthz * per_pa) ** 2 * (t_ns - self._last_ns) * 1e-9
            self.bias.drift(np.array([walk, 0.0]))
        self._last_ns = t_ns
        H = np.array([1.0, height_m - self._datum_m])
        innovation = offset - float(H @ self.bias.mean)
        relative = self._gated(self.bias, t_ns, innovation, H, variance, noise)
        if relative is None:
            return False
        lever = np.array(self.spec.position_m)
        factor = height_factor(chain.last, height_m + relative.innovation, relative.sigma, lever)
        chain.add(chain.last, factor)
        return True

    def _has_jumped(self) -> None:
        self._forget_offset()
        self.jumps += 1

    def _forget_offset(self) -> None:
        if self.bias is not None:
            self.bias.forget(np.array([UNKNOWN_M**2, 0.0]))

    def note(self) -> str | None:
        """How many pressures were used and rejected, in a sentence."""
        if not self.used and not self.refused:
            return None
        jumps = f", taken to have jumped {self.jumps} times" if self.jumps else ""
        return f"barometer: height differences of {self.used} s were used, {self.refused} refused{jumps}"
