"""How much of a receiver's noise is new at every fix, heard from fixes along a dead-reckoned path."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from terrafusion.fusion.estimator.dead_reckoning import LEAST_DIFFERENCES, MOST_DIFFERENCES, DeadReckoning
from terrafusion.fusion.estimator.fix_noise import ALL_NEW
from terrafusion.fusion.inputs.validation import GnssFix

STEP_NS, FIX_EVERY = 100_000_000, 5
CLAIM_M = 0.1


def tracked(
    noise_m: np.ndarray,
    *,
    speed_mps: float = 1.0,
    heading_rad: float = 0.0,
    origin_m: complex = 0j,
    order: np.ndarray | None = None,
) -> DeadReckoning:
    """A robot straight on; fix i, twice a second, is `noise_m` (n, 2) off. `order` is that of arrival."""
    track, n = DeadReckoning(np.zeros(3)), len(noise_m)
    turn = np.exp(1j * heading_rad)

    def fix(i: int) -> GnssFix:
        at = origin_m + turn * (speed_mps * i * FIX_EVERY * STEP_NS * 1e-9 + complex(*noise_m[i]))
        enu = np.array([at.real, at.imag, 0.0])
        return GnssFix(i * FIX_EVERY * STEP_NS, enu, np.full(3, CLAIM_M))

    for k in range(n * FIX_EVERY):
        track._append(k * STEP_NS, complex(speed_mps * k * STEP_NS * 1e-9), 0.0)
        if k % FIX_EVERY == 0 and order is None:
            track.add(fix(k // FIX_EVERY))
    for i in order if order is not None else ():
        track.add(fix(int(i)))
    track._yaw_chain = heading_rad
    return track


def white(n: int, share: float, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(0.0, CLAIM_M * np.sqrt(share), (n, 2))


@pytest.mark.parametrize("share", [0.1, 0.3, 1.0])
def test_the_share_of_white_noise_is_found(share: float) -> None:
    found = [tracked(white(300, share, seed)).white_share() for seed in range(20)]
    error = np.std(found, ddof=1) / np.sqrt(len(found))
    assert np.mean(found) == pytest.approx(share, abs=3.5 * error)
    assert np.std(found) < 0.15 * share


def test_an_error_that_drifts_is_hardly_new() -> None:
    rng, keep = np.random.default_rng(4), np.exp(-0.5 / 60.0)
    drift = np.zeros((300, 2))
    for i in range(1, len(drift)):
        drift[i] = keep * drift[i - 1] + rng.normal(0.0, 3.0 * CLAIM_M * np.sqrt(1.0 - keep**2), 2)
    assert tracked(drift).white_share() < 0.15
    assert tracked(np.tile([5.0, -3.0], (300, 1))).white_share() == pytest.approx(0.0, abs=1e-9)


def test_white_receivers_are_seldom_taken_to_drift() -> None:
    """Half a minute of fixes; Wilson's upper end of the rate below a fifth."""
    n, missed = 200, sum(tracked(white(60, 1.0, seed)).white_share() <= ALL_NEW for seed in range(200))
    z, p = 1.96, missed / n
    upper = (p + z**2 / (2 * n) + z * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))) / (1 + z**2 / n)
    assert upper < 0.2


def test_wild_fixes_say_no_more_than_others() -> None:
    noise = white(300, 0.3, 5)
    noise[::30] += 50.0
    assert tracked(noise).white_share() < 1.5
    noise[:] = 1e6 * white(300, 1.0, 5)  # none of them below the cap: nothing is known
    assert np.isnan(tracked(noise).white_share())


@settings(max_examples=25, deadline=None)
@given(order=st.permutations(range(40)), heading=st.floats(-3.1, 3.1), x=st.floats(-1e4, 1e4))
def test_neither_order_nor_heading_nor_place_matter(order: list[int], heading: float, x: float) -> None:
    noise = white(40, 0.5, 6)
    here = tracked(noise, order=np.arange(40)).white_share()
    there = tracked(noise, heading_rad=heading, origin_m=complex(x, -x), order=np.array(order)).white_share()
    assert there == pytest.approx(here, rel=1e-6)


def test_few_fixes_and_paths_that_slip_may_bend_tell_nothing() -> None:
    assert np.isnan(tracked(white(int(LEAST_DIFFERENCES), 1.0, 1)).white_share())
    assert np.isnan(tracked(white(300, 1.0, 1), speed_mps=20.0).white_share())


def test_old_fixes_are_remembered_and_forgotten() -> None:
    """Longer than the path is kept; what a receiver was like long ago fades."""
    track = tracked(white(2000, 1.0, 2))
    assert len(track.pairs) < 100
    assert track._forgotten[1] == pytest.approx(MOST_DIFFERENCES, rel=0.05)
    changed = np.concatenate([white(300, 1.0, 2), white(1500, 0.1, 3)])
    assert tracked(changed[:330]).white_share() > 0.8
    assert tracked(changed).white_share() < 0.2
