"""What fixes leave in the covariance: heights that are not known, refused fixes, doubts, late fixes."""

from __future__ import annotations

import numpy as np
import pytest

from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimate.estimate import Innovation
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.twin.model.vehicle import load_vehicle


def started(heading_rad: float) -> Estimator:
    """At rest for a second, at a known place."""
    made = Estimator(EstimatorConfig(load_vehicle("elevate").rig(), "elevate"))
    made.set_start([0.0, 0.0, 0.0], heading_rad, yaw_sigma_rad=0.001)
    for i in range(0, 101, 10):
        stand(made, i)
    return made


def stand(estimator: Estimator, count: int) -> None:
    """The next tenth of a second from so many hundredths on."""
    for i in range(count, count + 10):
        estimator.add_wheels(i * 10**7, 0.0, 0.0)
        estimator.add_imu(i * 10**7, [0.0, 0.0, 0.0], [0.0, 0.0, 9.80665])


def test_a_height_that_is_not_known_tells_nothing_however_often() -> None:
    estimator = started(0.0)
    chain = estimator.chain
    chain.restart(np.where(np.arange(chain.dim) == 5, 1e4**2, 0.0))
    before = chain.covariance[5, 5]
    for i in range(1, 60):
        estimator.add_gnss(estimator.latest().t_ns, [0.0, 0.0, np.nan], 0.02)
        stand(estimator, 100 + 10 * i)
    assert np.sqrt(chain.covariance[5, 5]) > 0.5 * np.sqrt(before)


def test_the_innovation_of_a_refused_fix_is_of_the_axes_of_its_sigma(monkeypatch) -> None:
    """A robot that heads north, unsure of its way forward by 4 m, and a fix 4 m to its north."""
    estimator = started(0.5 * np.pi)
    chain = estimator.chain
    chain.restart(np.where(np.arange(chain.dim) == 3, 16.0, 0.0))
    told: list[Innovation] = []
    monkeypatch.setattr(estimator.gnss, "_report", told.append)
    monkeypatch.setattr(estimator.gnss.plausible, "refusal", lambda *_: "out of reach")
    place = estimator.gnss._antenna(chain, chain.last)
    estimator.add_gnss(chain.nodes[-1].t_ns, [place.real, place.imag + 4.0, 0.0], 0.1)
    estimator.gnss.update(chain, estimator.weights.noise)
    assert [one.accepted for one in told] == [False]
    assert told[0].nis == pytest.approx(1.0, abs=0.1)


def test_a_doubt_that_comes_with_no_fix_is_in_the_state(monkeypatch) -> None:
    estimator = started(0.0)
    doubt = np.where(np.arange(estimator.chain.dim) == 3, 4.0, 0.0)

    def doubted(chain, _) -> bool:
        chain.restart(doubt)
        return False

    monkeypatch.setattr(estimator.gnss, "update", doubted)
    stand(estimator, 110)
    assert estimator.latest().covariance[0, 0] > 4.0


def test_fixes_that_come_late_are_no_outage_before_they_are_overdue() -> None:
    estimator = started(0.0)
    now_ns = estimator.latest().t_ns
    estimator.gnss.last_used_ns = now_ns
    for delay_s, outage_from_s in ((0.0, 2.0), (2.5, 4.5)):
        estimator.gnss.delay_s = delay_s
        assert not estimator.gnss.is_outage(now_ns + round((outage_from_s - 0.1) * 1e9))
        assert estimator.gnss.is_outage(now_ns + round((outage_from_s + 0.1) * 1e9))
