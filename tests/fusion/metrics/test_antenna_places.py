"""Where the antenna was taken to be over a drive."""

from __future__ import annotations

import numpy as np

from terrafusion.fusion.estimate.antenna import AntennaPlaces


def test_places_of_the_antenna_follow_each_other() -> None:
    first = AntennaPlaces.fixed((0.0, 0.0, 0.0)).then(100, (1.0, 0.0, 0.0))
    assert first.then(150, (1.0, 0.0, 0.0)) is first
    both = first.then(200, (2.0, 0.0, 0.0))
    assert both.at(np.array([-5, 99, 100, 199, 200, 300]))[:, 0].tolist() == [0.0, 0.0, 1.0, 1.0, 2.0, 2.0]
    assert both.then(100, (3.0, 0.0, 0.0)).at(np.array([250]))[0, 0] == 3.0, "a later thought replaces"


def test_late_stamps_are_those_of_earlier_measurements() -> None:
    places = AntennaPlaces.fixed((0.0, 0.0, 0.0)).then(100, (0.0, 0.0, 0.0), 30)
    assert places.measured_ns(np.array([50, 99, 100, 150])).tolist() == [50, 99, 70, 120]


def test_places_of_days_take_bounded_memory() -> None:
    places = AntennaPlaces.fixed((0.0, 0.0, 0.0))
    for k in range(1, 5001):
        places = places.then(k, (float(k), 0.0, 0.0), k)
    assert len(places.since_ns) == len(places.lever_m) == len(places.late_ns) <= 1000
    assert places.at(np.array([5000]))[0, 0] == 5000.0
    past = np.arange(5001)
    assert (np.abs(places.at(past)[:, 0] - past) < 20).all()
    assert (np.diff(places.since_ns) > 0).all()
