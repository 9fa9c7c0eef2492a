"""Rules of the verdict on numbers: what the log checks found, and what the estimator corrected."""

from collections.abc import Iterator

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.metrics.judged_run import FIVE_SIGMA, STRAY_SHARE, Reason, Run, doubtful, since_s

REPORTED = (
    "wheel-radius", "yaw-unrelated", "yaw-contradiction", "imu-forward", "accel-mirrored", "gnss-frozen",
    "sigma-too-small", "standing", "saturated",
)  # fmt: skip
"""Warnings of the log checks that make a result doubtful; errors always do. The others are of quantities that
the estimator estimates itself, such as small scale errors and the receiver's delay, or cost accuracy only. It
does not estimate delays of IMU and wheels: an offset of their clocks counts, too."""
LEARNED = {("imu-forward", "imu"): "imu_yaw_rad", ("clock-offset", "gnss"): "gnss_delay_s"}
"""The number of the robot that settles a finding of the log checks where the estimator corrected it, by code
and channel."""
OF_ACCELEROMETER = ("imu-forward", "accel-mirrored")
"""Findings about axes that a planar graph does not use."""
DELAY_SIGMAS = 2.0
"""A delay of the fixes is likely from so many of its sigmas on (95 %)."""
LEAST_STEP_M = 1e-4
"""Shorter steps between keyframes, and shorter shifts, show no direction."""


def misplaced_truth(run: Run) -> Iterator[Reason]:
    """A truth in another frame than the fixes: no error against it says anything of the estimate."""
    for finding in run.findings if run.scores.against == "truth" else ():
        if finding.code == "truth-frame":
            yield doubtful(f"errors are not judged: {finding.what} ({finding.evidence}); {finding.fix}")


def log_checks(run: Run) -> Iterator[Reason]:
    """Findings of the log checks that the estimator did not settle itself."""
    for finding in run.findings:
        if LEARNED.get((finding.code, finding.channel)) in run.corrections.numbers:
            continue
        if run.imu != "six_axis" and finding.code in OF_ACCELEROMETER:
            continue
        clock = finding.code == "clock-offset" and finding.channel in ("imu", "wheels")
        if finding.severity == "error" or finding.code in REPORTED or clock:
            yield doubtful(
                f"log check, {finding.channel}: {finding.what} ({finding.evidence}); {finding.fix}"
            )


def unknown_wheelbase(run: Run) -> Iterator[Reason]:
    """A car whose wheelbase nobody gave: the body's origin is half of it ahead of the rear axle."""
    if run.rig.drive == "ackermann" and "wheelbase_m" in run.assumed:
        yield doubtful(
            f"the distance of the axles is assumed ({run.rig.wheelbase_m:g} m): an error of it shifts "
            "positions along the robot and passes for another place of the antenna; give `wheelbase_m`, "
            "or let `terrafusion init LOG` measure it"
        )


def delayed(run: Run) -> Iterator[Reason]:
    """Late fixes that were not corrected, by far more than sigma across the path, which holds no delay.

    With truth, the errors themselves are tested instead.
    """
    late, (speed_mps, variance_m2) = run.corrections.uncorrected_delay_s, _motion(run)
    if late is None or not len(speed_mps) or run.scores.against == "truth":
        return
    delay_s, sigma_s = late
    shift_m = abs(delay_s) * speed_mps
    beyond = shift_m**2 > FIVE_SIGMA * variance_m2
    if abs(delay_s) > DELAY_SIGMAS * sigma_s and beyond.mean() > STRAY_SHARE:
        yield doubtful(
            f"the fixes seem {abs(delay_s):.2f} s {'late' if delay_s > 0.0 else 'early'} (1 sigma "
            f"{sigma_s:.2f} s), up to {shift_m[beyond].max():.2f} m of the path, and are not corrected; "
            "give the receiver's delay in the vehicle file, or drive longer"
        )


def refuted(run: Run) -> Iterator[Reason]:
    """Results with numbers that the drive refuted later: their sigma does not include the difference.

    The angle of an IMU bends all that came before it was known; another antenna or delay shifts a result by
    a known vector, and is tested against the variance along it. With truth, the errors themselves are tested
    instead.
    """
    path = run.estimate.trajectory
    t_ns, P = path.t_ns[1:], path.covariance
    if run.scores.against == "truth" or P is None or not len(t_ns):
        return
    wrong, names = np.zeros(len(t_ns), dtype=bool), []
    if run.corrections.imu_since_ns is not None:
        wrong |= t_ns < run.corrections.imu_since_ns
        names += ["the angle of the IMU"] if wrong.any() else []
    if run.corrections.antenna is not None:
        lever_m, shift_s = run.corrections.antenna.later_shift(t_ns)
        shifts_m = {
            "the antenna's place": _level(lever_m, path.yaw_rad()[1:]),
            "the delay of the fixes": run.estimate.velocity_mps[1:, :2] * shift_s[:, None],
        }
        for name, off_m in shifts_m.items():
            beyond = (off_m**2).sum(axis=1) > FIVE_SIGMA * _variance_m2(P[1:, :2, :2], off_m)
            wrong |= beyond
            names += [name] if beyond.any() else []
    if wrong.mean() > STRAY_SHARE:
        until_s = since_s(run, int(t_ns[wrong][-1]))
        yield doubtful(
            f"up to {until_s:.0f} s the results rest on numbers that the drive then refuted "
            f"({', '.join(names)}), and sigma does not include that; write what it showed to a vehicle file "
            "(`terrafusion calibrate LOG --sensors`) and replay the log with it"
        )


def unconfirmed_imu(run: Run) -> Iterator[Reason]:
    """An IMU that may be turned by a quarter for all that vehicle file and drive tell, where that matters.

    It would measure a change of velocity to the side: within a second, half of it times a second and the
    chord of a quarter turn.
    """
    sigma_rad, (_, variance_m2) = run.corrections.imu_sigma_rad, _motion(run)
    known = sigma_rad is None or 2.0 * sigma_rad < 0.5 * np.pi
    if known or run.scores.against == "truth" or not len(variance_m2):
        return
    t_ns, velocity_mps = run.estimate.trajectory.t_ns, run.estimate.velocity_mps[:, :2]
    later = np.minimum(np.searchsorted(t_ns, t_ns[1:] + 1_000_000_000), len(t_ns) - 1)
    off_m = np.linalg.norm(velocity_mps[later] - velocity_mps[1:], axis=1) / np.sqrt(2.0)
    beyond = off_m**2 > FIVE_SIGMA * variance_m2
    if beyond.mean() > STRAY_SHARE:
        yield doubtful(
            "neither vehicle file nor drive show how the IMU is turned about its vertical axis: a quarter "
            f"turn would move results by up to {off_m[beyond].max():.1f} m, beyond their sigma; give "
            "`imu_yaw_rad` in the vehicle file, or drive longer, with changes of speed and turns"
        )


def _motion(run: Run) -> tuple[Array, Array]:
    """Speeds (N - 1,) m/s between keyframes, and variances m2 of the next positions; empty if unknown.

    The variances are those across the motion: along it they hold the doubt of the fixes' delay.
    """
    path = run.estimate.trajectory
    if path.covariance is None or len(path) < 2:
        return np.zeros(0), np.zeros(0)
    east_m, north_m = np.diff(path.position_m[:, :2], axis=0).T
    variance_m2 = _variance_m2(path.covariance[1:, :2, :2], np.stack([-north_m, east_m], axis=1))
    return np.hypot(east_m, north_m) / (np.diff(path.t_ns) * 1e-9), variance_m2


def _variance_m2(P: Array, along_m: Array) -> Array:
    """Variances (N,) by covariances P (N, 2, 2) along vectors (N, 2), the mean of both axes for those of no
    direction.
    """
    length_m = np.hypot(*along_m.T)
    unit = along_m / np.maximum(length_m, LEAST_STEP_M)[:, None]
    variance_m2 = np.einsum("ni,nij,nj->n", unit, P, unit)
    none = length_m < LEAST_STEP_M
    variance_m2[none] = P[none].trace(axis1=1, axis2=2) / 2.0
    return np.asarray(variance_m2)


def _level(lever_m: Array, yaw_rad: Array) -> Array:
    """Vectors (N, 3) of the body, which heads yaw (N,), east and north (N, 2)."""
    turned = (lever_m[:, 0] + 1j * lever_m[:, 1]) * np.exp(1j * yaw_rad)
    return np.stack([turned.real, turned.imag], axis=1)
