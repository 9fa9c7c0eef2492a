"""Self-calibration while driving."""

from __future__ import annotations

import dataclasses

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.calibration.motion import Drive
from terrafusion.fusion.calibration.numbers import GNSS_DELAY, NUMBERS, Knowledge
from terrafusion.fusion.calibration.online import MOST_NODES, SelfCalibration
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.twin.simulate import simulate
from tests.fusion.calibration.test_fit import NOISE, PRIOR, STEP_S, TRUE, figure


def driven(drive: Drive, learning: SelfCalibration, begin_ns: int = 0) -> list[Knowledge]:
    """Gives a drive sample by sample; what was known after each step."""
    known, j, z, yaw = [], 0, 0j, 0.0
    for i, t_s in enumerate(drive.t_s):
        t_ns = begin_ns + round(t_s * 1e9)
        distance = float(drive.distance_m[i - 1]) if i else 0.0
        turn = float(drive.turn_rad[i - 1]) if i else 0.0
        yaw += turn
        z += distance * np.exp(1j * yaw)
        learning.drive(t_ns, distance, turn, np.array([z.real, z.imag]), yaw)
        while j < len(drive.fix) and drive.fix_t_s[j] <= t_s:
            fix = np.array([drive.fix[j].real, drive.fix[j].imag, 0.0])
            learning.fix(begin_ns + round(drive.fix_t_s[j] * 1e9), fix, float(drive.fix_sigma_m[j]))
            j += 1
        if learning.advance():
            known.append(learning.known)
    return known


def test_numbers_are_found_while_driving_and_their_sigmas_shrink() -> None:
    known = driven(figure(240.0, fix_sigma_m=0.05, slip=0.01), SelfCalibration(PRIOR, NOISE, 0j))
    error = np.abs(known[-1].mean - TRUE)[:6]
    assert (error < 4.0 * known[-1].sigma[:6] + [2e-3, 2e-4, 3e-3, 0.02, 0.02, 0.02]).all()
    assert (known[-1].sigma[:6] < 0.4 * known[0].sigma[:6]).all()


def test_numbers_that_are_far_off_are_found_without_waiting_for_more_ground() -> None:
    """Fixes 1.5 s later than those of the drive, in 40 s; with a step every 4 s .25 s of them are left."""
    drive = figure(40.0, fix_sigma_m=0.03)
    drive = dataclasses.replace(drive, fix_t_s=drive.fix_t_s + 1.5)
    known = driven(drive, SelfCalibration(PRIOR, NOISE, 0j))[-1]
    assert abs(known.mean[GNSS_DELAY] - TRUE[GNSS_DELAY] - 1.5) < 0.1


def test_a_long_drive_is_cut_into_stretches_and_keeps_what_it_learned() -> None:
    learning = SelfCalibration(PRIOR, NOISE, 0j)
    known = driven(figure(600.0, fix_sigma_m=0.05), learning)
    assert len(learning._first) < MOST_NODES + 2
    assert np.allclose(known[-1].mean[:6], TRUE[:6], atol=[3e-3, 3e-4, 6e-3, 0.03, 0.03, 0.03])


def test_missing_samples_end_a_stretch_but_not_what_was_learned() -> None:
    learning = SelfCalibration(PRIOR, NOISE, 0j)
    driven(figure(200.0, fix_sigma_m=0.05), learning)
    before = learning.known
    learning.drive(10**12, None, 0.0, np.zeros(2), 0.0)
    assert learning.known is before
    again = driven(figure(120.0, fix_sigma_m=0.05, seed=1), learning, 2 * 10**12)
    assert (again[-1].sigma < PRIOR.sigma).all()


def test_a_wrong_heading_takes_back_its_stretch() -> None:
    learning = SelfCalibration(PRIOR, NOISE, 0j)
    driven(figure(60.0, fix_sigma_m=0.05), learning)
    assert not same(learning.known.mean, PRIOR.mean)
    learning.restart(learning.before)
    assert same(learning.known.mean, PRIOR.mean)


def test_equal_input_gives_equal_bits() -> None:
    runs = [driven(figure(120.0, 0.0 * TRUE, 0.3), SelfCalibration(PRIOR, NOISE, 0j)) for _ in range(2)]
    assert all(same(a.mean, b.mean) for a, b in zip(*runs, strict=True))


def same(a: Array, b: Array) -> bool:
    """Whether two vectors of numbers have the same bits."""
    return len(a) == len(NUMBERS) and a.tobytes() == b.tobytes()


def test_a_step_takes_many_short_slices() -> None:
    drive = figure(400.0, fix_sigma_m=0.05)
    learning = SelfCalibration(PRIOR, NOISE, 0j)
    driven(drive, learning)
    while learning._work is None:
        t_ns = learning._start_ns + round((learning._now_s + 0.1) * 1e9)
        learning.drive(t_ns, 0.1, 0.0, np.zeros(2), 0.0)
        learning.advance()
    known, slices = learning.known, 0
    while learning._work is not None:
        assert learning.known is known
        assert learning.advance() == (learning._work is None)
        slices += 1
    assert learning.known is not known
    assert slices > 3
    assert slices * STEP_S < 4.0


def test_an_estimator_restored_within_a_step_learns_the_same() -> None:
    messages = list(simulate("figure_eight", terrain="asphalt", seed=5).messages())
    estimator = Estimator.for_vehicle("elevate")
    learning = estimator.learned.calibration
    assert learning is not None
    for place, message in enumerate(messages):  # noqa: B007
        estimator.add(message)
        if learning._work is not None and learning._work.done_nodes:
            break
    again = Estimator.restore(estimator.config, estimator.dump())
    for message in messages[place + 1 : place + 400]:
        estimator.add(message)
        again.add(message)
    assert learning._work is None
    assert again.learned.calibration is not None
    assert same(again.learned.calibration.known.mean, learning.known.mean)
    assert not same(learning.known.mean, learning.prior.mean)
