"""Stationarity from wheels and IMU over a window, and zero-velocity updates (ZUPT).

The IMU is tested by the generalised likelihood ratio of Skog, Handel, Nilsson and Rantakokko (2010, IEEE
T-BME 57(11), the SHOE detector): at rest the gyro reads its bias and the specific force is gravity in an
unknown direction. The wheels must turn by less than their encoders' quantum over a window in which a
creeping robot would turn them by two.

The noise in the test is that of the data sheet, or the vibration from differences of successive samples
(von Neumann 1941, Ann. Math. Stat. 12(4)) where that is more, as of an idling engine; it is capped, so
that a ride on a lorry is no rest.
"""

import bisect
import math

import gtsam
import numpy as np
from gtsam.symbol_shorthand import V

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.datasets.core.sensors import ImuSpec, Rig
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.factors import no_motion_factor
from terrafusion.fusion.graph.key_state import VELOCITY, KeyState
from terrafusion.fusion.inputs.streams import ImuStream, WheelStream
from terrafusion.fusion.inputs.validation import GnssFix

CREEP_MPS = 0.02
"""The slowest motion that the wheels must show within a window."""
PARKED_MPS = 1e-3
"""Creep of a parked robot (assumed; the twin's creeps 0.06 mm/s down 5 deg)."""
SHORTEST_S, LONGEST_S = 0.3, 1.5
LIMIT = 3.0
"""Statistic per degree of freedom, 1 expected at rest: white noise of 30 degrees passes 3 with p = 2e-7; the
margin is for noise that is not white."""
GRAVITY_SIGMA_MPS2 = 0.03
"""Difference of local and standard gravity, equator to pole."""
CEILING_RADPS, CEILING_MPS2 = 0.01, 0.2
"""Largest noise of a resting IMU (assumed)."""
MOVING_MPS = 0.05
"""A speed this far above four sigma is motion, whatever wheels and IMU show."""
WINDOW_AT_REST_S, AT_REST_M = 10.0, 0.02
"""What is kept of a rest before the start, and how far its wheels may turn meanwhile."""
LONGEST_WAIT_S = 300.0
"""A start that takes longer uses the newer half of the samples only."""

_STOPPED = gtsam.noiseModel.Isotropic.Sigma(3, 0.005)


def shaking(samples: Array) -> float:
    """Standard deviation of the fast part of samples (n, 3), from successive differences on known axes."""
    known = samples[:, np.isfinite(samples).all(axis=0)]
    if known.size == 0 or len(known) < 2:
        return 0.0
    return math.sqrt(float(np.mean(np.diff(known, axis=0) ** 2)) / 2.0)


def likelihood_ratio(
    gyro_radps: Array, accel_mps2: Array, sigma_gyro_radps: float, sigma_accel_mps2: float
) -> float:
    """The statistic of Skog et al. (2010) per degree of freedom; about 1 at rest, large in motion.

    Args:
        gyro_radps: (n, 3), bias removed; an axis that is not measured is NaN.
        accel_mps2: (n, 3), bias removed; NaN where there is no accelerometer, then the gyro decides.
        sigma_gyro_radps, sigma_accel_mps2: noise of one sample and axis, 1 sigma.
    """
    n = len(gyro_radps)
    known = gyro_radps[:, np.isfinite(gyro_radps).all(axis=0)]
    total, dof = float(np.sum(known**2)) / sigma_gyro_radps**2, known.size
    if np.isfinite(accel_mps2).all():
        mean = accel_mps2.mean(axis=0)
        up = mean / max(float(np.linalg.norm(mean)), 1e-9)
        total += float(np.sum((accel_mps2 - GRAVITY_MPS2 * up) ** 2)) / sigma_accel_mps2**2
        dof += 3 * n - 2
    return total / max(dof, 1)


class StationarityDetector:
    """Detects rest at each keyframe.

    Attributes:
        window_s: length of the window, in which `CREEP_MPS` turns the wheels by more than two quanta.
        still_m: how far the wheels may turn within it.
    """

    def __init__(self, rig: Rig) -> None:
        needed = 2.5 * rig.quantum_m / CREEP_MPS + 1.0 / rig.sensors.wheels.rate_hz
        self.window_s = min(max(needed, SHORTEST_S), LONGEST_S)
        self.still_m = max(1.001 * rig.quantum_m, PARKED_MPS * self.window_s)
        self._imu_spec = rig.sensors.imu

    def is_stationary(
        self,
        t_ns: int,
        imu: ImuStream,
        wheels: WheelStream,
        gyro_bias_radps: Array,
        accel_bias_mps2: Array,
        speed_mps: float = 0.0,
        speed_sigma_mps: float = math.inf,
    ) -> bool:
        """Whether the robot has stood during the window that ends at `t_ns`.

        `speed_mps` with its sigma is the estimate's, where it does not rest on wheels and IMU alone.
        """
        if speed_mps > MOVING_MPS + 4.0 * speed_sigma_mps:
            return False
        start_ns = t_ns - round(self.window_s * 1e9)
        turned = wheel_motion(wheels, start_ns, t_ns)
        if turned is None or turned > self.still_m:
            return False
        t_s, gyro, accel = imu.window(start_ns, t_ns + 1)
        if len(t_s) < 3:
            return False
        rate_hz = (len(t_s) - 1) / max(float(t_s[-1] - t_s[0]), 1e-6)
        sigma_gyro, sigma_accel = noise_at_rest(self._imu_spec, rate_hz, gyro, accel)
        statistic = likelihood_ratio(gyro - gyro_bias_radps, accel - accel_bias_mps2, sigma_gyro, sigma_accel)
        return statistic < LIMIT

    def update(
        self,
        chain: Chain,
        link: gtsam.NonlinearFactorGraph,
        imu: ImuStream,
        wheels: WheelStream,
        before: KeyState,
        aided: bool,
    ) -> None:
        """Zero velocity at the newest keyframe, and no motion in its link, where the robot has stood.

        `link` leads to it from the keyframe with the state `before`; `aided`: fixes hold the estimate.
        """
        sigma_mps = math.sqrt(chain.covariance[VELOCITY, VELOCITY].trace()) if aided else math.inf
        biases = before.bias.gyroscope(), before.bias.accelerometer()
        speed_mps, t_ns = math.sqrt(before.velocity @ before.velocity), chain.nodes[-1].t_ns
        if self.is_stationary(t_ns, imu, wheels, *biases, speed_mps, sigma_mps):
            link.add(no_motion_factor(chain.last))
            chain.add(chain.last, gtsam.PriorFactorVector(V(chain.last), np.zeros(3), _STOPPED))


def drop_before_start(imu: ImuStream, wheels: WheelStream, fixes: list[GnssFix]) -> bool:
    """Drop samples and fixes that no start can use; True when some were dropped.

    A robot at rest needs only the last seconds to level itself; one that moves for minutes without finding
    its heading uses the newest samples alone.
    """
    newest = imu.t_ns[-1]
    waited_s = (newest - imu.t_ns[0]) * 1e-9
    if waited_s > LONGEST_WAIT_S:
        cut = newest - round(0.5e9 * LONGEST_WAIT_S)
    elif waited_s > 2.0 * WINDOW_AT_REST_S:
        cut = newest - round(1e9 * WINDOW_AT_REST_S)
        turned = wheel_motion(wheels, imu.t_ns[0], newest)
        if turned is None or turned > AT_REST_M:
            return False
    else:
        return False
    imu.forget(cut)
    wheels.forget(cut)
    fixes[:] = [fix for fix in fixes if fix.t_ns >= cut]
    return True


def noise_at_rest(spec: ImuSpec, rate_hz: float, gyro: Array, accel: Array) -> tuple[float, float]:
    """1 sigma of a sample, rad/s and m/s2: the data sheet's, or the vibration where that is more."""
    gyro_white = max(spec.gyro_noise_radps_sqrthz * math.sqrt(rate_hz), shaking(gyro))
    sigma_gyro = min(math.hypot(gyro_white, spec.gyro_bias_sigma_radps), CEILING_RADPS)
    accel_white = max(spec.accel_noise_mps2_sqrthz * math.sqrt(rate_hz), shaking(accel))
    slow = math.hypot(spec.accel_bias_sigma_mps2, GRAVITY_SIGMA_MPS2)
    return sigma_gyro, min(math.hypot(accel_white, slow), CEILING_MPS2)


def wheel_motion(wheels: WheelStream, start_ns: int, end_ns: int) -> float | None:
    """Most that a side moved within the window, m, to and fro included; None where samples are missing."""
    i = bisect.bisect_right(wheels.t_ns, start_ns) - 1
    j = bisect.bisect_right(wheels.t_ns, end_ns)
    if i < 0 or j - i < 2 or wheels.t_ns[j - 1] <= start_ns:
        return None
    left, right = wheels.left_m[i:j], wheels.right_m[i:j]
    return max(max(left) - min(left), max(right) - min(right))
