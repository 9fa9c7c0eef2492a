"""Magnetometer: heading, with uncertain declination and hard iron.

The field is levelled by the roll and pitch of the graph, and never changes them. Its heading errs by the
declination and by the hard iron in the horizontal plane of the body, which turns with the robot: three
biases (rad, T, T) that are estimated beside the graph (`slow_bias`). With a declination the heading is
absolute, and a robot may start at rest; without, the magnetometer holds the heading of GNSS or of the
start.

Three tests reject a disturbed field: its size must be Earth's, size and dip those of the run so far, and
its heading that of the graph within the sigmas of both. Where it is rejected for long the biases are
reset; after more than `CHANCES` resets the sensor is left out.
"""

import math
from collections.abc import Callable

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X
from numpy.typing import ArrayLike

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.channels import Magnetometer
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.sensors import MagnetometerSpec
from terrafusion.fusion.estimate.estimate import Innovation
from terrafusion.fusion.estimator.alignment import WINDOW_NS, Start
from terrafusion.fusion.estimator.slow_bias import BiasedSensor, SlowBias
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.key_state import POSE, yaw_of
from terrafusion.fusion.inputs.streams import axes_turned

GENERIC = MagnetometerSpec(rate_hz=10.0, noise_t=3e-7, hard_iron_sigma_t=3e-6)
"""For a vehicle whose file has no magnetometer (assumed: calibrated once)."""
VERTICAL_T = 50e-6
"""About the largest vertical field outside the polar regions (World Magnetic Model 2020)."""
INTERVAL_NS = 1_000_000_000
AVERAGING_NS = 200_000_000
"""A keyframe takes the mean of the samples this shortly before it."""
SITE_SIGMA_RAD = 0.05
"""Heading error by iron of the place, independent from one second to the next (assumed: 3 deg)."""
DECLINATION_SIGMA_RAD = 0.03
"""Error of a given declination (assumed; the World Magnetic Model claims about 0.5 deg)."""
UNKNOWN_RAD = math.pi
WALK = np.array([5e-4, 2e-8, 2e-8])
"""Random walks of the biases per sqrt(s) (assumed: other places, load and motor currents)."""
SIZE_SHARE, DIP_RAD = 0.15, 0.15
"""Allowed differences of size (share) and dip (9 deg) from those of the run so far (assumed)."""
FOLLOW_S = 60.0
CHANCES = 3
LEAST_START = 5
FREE_SIGMA = 1e3
ASTRAY_SIGMA = 4.0
ODD_SHARE = 0.1
_NORTH_EAST = np.array([math.sqrt(0.5), math.sqrt(0.5), 0.0])


def yaw_jacobian(R: Array) -> Array:
    """Derivative (3,) of `yaw_of` by a small rotation of the body about its own axes."""
    across = R[0, 0] ** 2 + R[1, 0] ** 2
    d_x = np.array([0.0, -R[0, 2], R[0, 1]])
    d_y = np.array([0.0, -R[1, 2], R[1, 1]])
    return np.asarray((R[0, 0] * d_y - R[1, 0] * d_x) / across)


def heading_factor(k: int, R: Array, turn_rad: float, sigma_rad: float) -> gtsam.NonlinearFactor:
    """Heading of keyframe k: that of `R` (3, 3) plus `turn_rad`; roll and pitch stay free.

    A horizontal direction of the world, seen from the turned body. The error's second part is its vertical
    one (GTSAM's basis of a horizontal unit vector), left free.
    """
    seen = R.T @ (axes_turned(turn_rad) @ _NORTH_EAST)
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([sigma_rad, FREE_SIGMA]))
    return gtsam.AttitudeFactorPose3(X(k), gtsam.Unit3(_NORTH_EAST), noise, gtsam.Unit3(seen))


def wrapped(angle_rad: float) -> float:
    """The angle within -pi to pi."""
    return math.remainder(angle_rad, 2.0 * math.pi)


def levelled(R: Array) -> Array:
    """The rotation without its heading: body to a level frame along the robot."""
    return axes_turned(yaw_of(R)) @ R


class FieldReference:
    """Size (T) and dip (rad, down positive) of the undisturbed field in the run so far."""

    def __init__(self) -> None:
        self.size_t = 0.0
        self.dip_rad = 0.0
        self._t_ns = 0

    def accepts(self, t_ns: int, level_t: Array) -> bool:
        """Whether a levelled field (3,) resembles those before; accepted fields move the reference slowly."""
        size = float(np.linalg.norm(level_t))
        low, high = Magnetometer.POSSIBLE_T
        if not low <= size <= high:
            return False
        dip = -math.asin(float(level_t[2]) / size)
        if self.size_t == 0.0:
            self.size_t, self.dip_rad, self._t_ns = size, dip, t_ns
        if abs(size - self.size_t) > SIZE_SHARE * self.size_t or abs(dip - self.dip_rad) > DIP_RAD:
            return False
        share = -math.expm1(-(t_ns - self._t_ns) * 1e-9 / FOLLOW_S)
        self.size_t += share * (size - self.size_t)
        self.dip_rad += share * (dip - self.dip_rad)
        self._t_ns = t_ns
        return True

    def forget(self) -> None:
        """The next field becomes the reference."""
        self.size_t = 0.0


class MagnetometerAiding(BiasedSensor[Array]):
    """Turns fields into factors of the newest keyframe; `report` gets every innovation (rad).

    Args:
        spec: noise and hard iron of the sensor; None for a generic one.
        declination_rad: magnetic north, east of true north; None where it is not known.
        report: called with every tested heading.
        tilt_rad: 1 sigma of roll and pitch: a tilt turns the vertical field into the horizontal, like
            hard iron.
    """

    SENSOR, GATE_SIGMA, PATIENCE = "magnetometer", 3.5, 20

    def __init__(
        self,
        spec: MagnetometerSpec | None,
        declination_rad: float | None,
        report: Callable[[Innovation], None],
        tilt_rad: float = 0.0,
    ) -> None:
        super().__init__(report)
        self.spec = spec or GENERIC
        self.declination_rad = declination_rad
        iron = [math.hypot(self.spec.hard_iron_sigma_t, tilt_rad * VERTICAL_T)] * 2
        sigma = UNKNOWN_RAD if declination_rad is None else DECLINATION_SIGMA_RAD
        self.bias = SlowBias.of(np.array([declination_rad or 0.0, 0.0, 0.0]), np.array([sigma, *iron]))
        self.reference = FieldReference()
        self.renewed = 0
        self._last_ns: int | None = None
        self._corrections = 0

    @property
    def disabled(self) -> bool:
        """Whether the sensor is left out for good."""
        return self.renewed > CHANCES

    def add(self, t_ns: int, field_t: ArrayLike) -> None:
        """One field (3,), body axes, tesla."""
        field = np.asarray(field_t, dtype=float)
        if field.shape != (3,):
            raise DataError(f"a field of shape {field.shape}", channel="magnetometer", remedy="give x, y, z")
        if not self.disabled and np.isfinite(field).all():
            self._hold(int(t_ns), field)

    @property
    def ready(self) -> bool:
        """Whether a declination is known and there are samples to start from."""
        return self.declination_rad is not None and len(self._samples) >= LEAST_START

    @property
    def active(self) -> bool:
        """Whether a sample has ever come."""
        return bool(self._samples) or self._last_ns is not None

    def forget_declination(self) -> None:
        """The frame is local: its heading is unrelated to north, whatever declination was given."""
        if self.declination_rad is not None:
            self.declination_rad = None
            self._forget_heading()

    def stationary_heading(self, level: Start, tilt_rad: float) -> tuple[float, float] | None:
        """Heading and its 1 sigma, rad, of a robot at rest whose roll and pitch are known to `tilt_rad`.

        None without a declination, with few samples, or with a field that is not Earth's. The biases are
        then correlated with that heading: later samples are no independent measurement of it.
        """
        if not self.ready or level.gyro_bias_radps is None:
            return None
        still = [(t, field) for t, field in self._samples if 0 <= t - level.t_ns <= WINDOW_NS]
        if len(still) < LEAST_START:  # those of later may be of a robot that turns by then
            return None
        mean = np.mean([field for _, field in still], axis=0)
        R = gtsam.Rot3.RzRyRx(level.roll_rad, level.pitch_rad, 0.0).matrix()
        flat = R @ mean
        if not self.reference.accepts(still[-1][0], flat):
            return None
        yaw, H = self._heading_of_field(R, mean)
        noise = self._noise(flat, len(still), tilt_rad)
        own = self.bias.covariance @ H
        sigma = math.sqrt(float(H @ own) + noise)
        self.bias.cross = -own
        self._last_ns = still[-1][0]
        return wrapped(yaw), sigma

    def update(
        self, chain: Chain, t_ns: int, newest_ns: int, before: Array, after: Array, corrections: int = 0
    ) -> bool:
        """Use the samples up to the newest keyframe; True where a factor was added.

        `before` and `after` (n, n) are the newest keyframe's covariance, without and with the other
        measurements of this keyframe; `corrections` counts the heading corrections by GNSS. The newest IMU
        sample is at `newest_ns`.
        """
        R = chain.state(chain.last).rotation
        jacobian = yaw_jacobian(R)
        before_rad2, after_rad2 = (
            float(jacobian @ P[POSE, POSE][:3, :3] @ jacobian) for P in (before, after)
        )
        self.bias.state_updated(before_rad2, after_rad2)
        if corrections != self._corrections:
            self._corrections = corrections
            self._forget_heading()
        recent = [field for _, field in self._due(t_ns, newest_ns, AVERAGING_NS)]
        if not recent or (self._last_ns is not None and t_ns - self._last_ns < INTERVAL_NS):
            return False
        elapsed = 0.0 if self._last_ns is None else (t_ns - self._last_ns) * 1e-9
        self._last_ns = t_ns
        self.bias.drift(WALK**2 * elapsed)
        tilt = math.sqrt(0.5 * float(after[0, 0] + after[1, 1]))
        return self._measure(chain, t_ns, R, np.mean(recent, axis=0), len(recent), after_rad2, tilt)

    def _measure(
        self, chain: Chain, t_ns: int, R: Array, field: Array, count: int, variance: float, tilt: float
    ) -> bool:
        flat = levelled(R) @ field
        if not self.reference.accepts(t_ns, flat):
            self._refuse()
            return False
        heading, H = self._heading_of_field(R, field)
        innovation = wrapped(heading - yaw_of(R))
        noise = self._noise(flat, count, tilt)
        own = self._gated(self.bias, t_ns, innovation, H, variance, noise)
        if own is None:
            return False
        chain.add(chain.last, heading_factor(chain.last, R, own.innovation, own.sigma))
        return True

    def _heading_of_field(self, R: Array, field: Array) -> tuple[float, Array]:
        """Heading by a field, rad, and its derivative (3,) by the errors of the biases, negated.

        With D the declination, north lies at pi/2 - D; the field less the hard iron points there.
        """
        tilt = levelled(R)
        iron = np.array([self.bias.mean[1], self.bias.mean[2], 0.0])
        x, y, _ = tilt @ (field - iron)
        yaw = 0.5 * math.pi - float(self.bias.mean[0]) - math.atan2(y, x)
        by_field = np.array([-y, x, 0.0]) / (x * x + y * y)
        return yaw, np.array([1.0, *-(by_field @ tilt)[:2]])

    def _noise(self, flat: Array, count: int, tilt_rad: float) -> float:
        """Variance of a heading: noise of the samples, iron of the place, tilt times the vertical field."""
        across = max(float(np.hypot(flat[0], flat[1])), 1e-9)
        dip = float(flat[2]) / across
        return self.spec.noise_t**2 / across**2 / count + SITE_SIGMA_RAD**2 + (dip * tilt_rad) ** 2

    def _has_jumped(self) -> None:
        self.renewed += 1
        self.reference.forget()
        self._forget_heading()
        if self.disabled:
            self._samples.clear()

    def _forget_heading(self) -> None:
        self.bias.forget(np.array([UNKNOWN_RAD**2, 0.0, 0.0]))

    def notes(self) -> list[str]:
        """How many headings were used and rejected, and why, in sentences."""
        if not self.used and not self.refused:
            return []
        notes = [f"magnetometer: {self.used} headings, one a second, were used, {self.refused} refused"]
        if self.refused > ODD_SHARE * (self.used + self.refused):
            why = "a wrong declination, " if self.declination_rad is not None else ""
            why += "iron of the robot or of the ground"
            notes.append(f"magnetometer: many headings disagree with the drive: {why}")
        sigma = math.sqrt(float(self.bias.covariance[0, 0]))
        astray = wrapped(float(self.bias.mean[0]) - (self.declination_rad or 0.0))
        if self.declination_rad is not None and abs(astray) > ASTRAY_SIGMA * max(
            sigma, DECLINATION_SIGMA_RAD
        ):
            notes.append(
                f"magnetometer: the declination given is off by {math.degrees(astray):.0f} deg "
                f"(1 sigma {math.degrees(sigma):.0f}), or the robot's iron turns its heading"
            )
        iron = self.bias.mean[1:]
        if np.hypot(*iron) > ASTRAY_SIGMA * self.spec.hard_iron_sigma_t:
            notes.append(f"magnetometer: hard iron of {np.hypot(*iron) * 1e6:.0f} uT was found; calibrate it")
        if self.disabled:
            notes.append("magnetometer: left out, its headings do not turn as the robot does")
        return notes
