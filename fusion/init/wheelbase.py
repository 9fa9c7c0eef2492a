"""Distance of the axles of a robot that steers, by its steering angles and the gyro."""

import numpy as np

from terrafusion.datasets.core.recording import Recording

STEP_S, MEAN_OVER = 0.1, 5
"""Channels are compared by means over so many steps: half a second."""
LEAST_MPS, LEAST_MEANS = 0.2, 20
"""Slower means show nothing, and fewer are too few (assumed)."""
LEAST_R, LEAST_SIGMA = 0.95, 0.15
"""Correlation below which the angles are no measurement of these wheels, such as late commands; and the least
relative 1 sigma: tyres that slip make the distance seem larger, by 3 to 40 % with the ground (assumed)."""


def measured_wheelbase(recording: Recording, wheel_radius_m: float) -> tuple[float, float] | None:
    """Distance of the axles, m, and its 1 sigma; None where the log does not show it.

    By the bicycle model without side-slip (Rajamani 2012, Vehicle Dynamics and Control, ch. 2.2),

        v (tan front - tan rear) = L (r - b) + v c,

    with the speed v of the wheels, the yaw rate r, the gyro's bias b and the zero error c of the steering; L,
    L b and c by least squares. The angle of a steering wheel shows only L times its ratio.
    """
    steering, wheels, imu = recording.steering, recording.wheels, recording.imu
    if steering is None or wheels is None or imu is None or steering.names == ("steering_wheel",):
        return None
    streams = (
        (steering.t_ns, np.tan(steering.axle_angles_rad()) @ (1.0, -1.0)),
        (wheels.t_ns, wheels.side_speeds_mps(wheel_radius_m).mean(axis=1)),
        (imu.t_ns, imu.gyro_radps[:, 2]),
    )
    known = [(t_ns[np.isfinite(x)], x[np.isfinite(x)]) for t_ns, x in streams]
    if any(len(t_ns) < LEAST_MEANS for t_ns, _ in known):
        return None
    begin, end = max(t_ns[0] for t_ns, _ in known), min(t_ns[-1] for t_ns, _ in known)
    count = int((end - begin) * 1e-9 / STEP_S) // MEAN_OVER * MEAN_OVER
    if count < LEAST_MEANS * MEAN_OVER:
        return None
    at_ns = begin + (np.arange(count) * STEP_S * 1e9).astype(np.int64)
    tangent, speed, rate = (np.interp(at_ns, t_ns, x) for t_ns, x in known)
    y, v, r = (x.reshape(-1, MEAN_OVER).mean(axis=1) for x in (speed * tangent, speed, rate))
    moving = np.abs(v) > LEAST_MPS
    y, X = y[moving], np.stack([r, -np.ones(len(r)), v], axis=1)[moving]
    if len(y) < LEAST_MEANS or np.ptp(X[:, 0]) == 0.0:
        return None
    found, _, rank, _ = np.linalg.lstsq(X, y, rcond=None)
    left, turned = y - X @ found, y - X[:, 1:] @ found[1:]
    length_m, explained = float(found[0]), 1.0 - float(left @ left) / max(float(turned @ turned), 1e-12)
    if rank < X.shape[1] or length_m <= 0.0 or explained < LEAST_R**2:
        return None
    variance = float(left @ left) / (len(y) - X.shape[1]) * np.linalg.inv(X.T @ X)[0, 0]
    return length_m, float(np.hypot(np.sqrt(variance), LEAST_SIGMA * length_m))
