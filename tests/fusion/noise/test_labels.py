"""Ground labels told in place of the detector's."""

from __future__ import annotations

import numpy as np
import pytest

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.fusion.benchmark.outage_plan import until
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.noise.labels import GroundLabels
from terrafusion.fusion.noise.policy import load_policy
from terrafusion.fusion.replay import replay
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.run_recording import START_NS
from terrafusion.twin.simulate import simulate

CLASSES = load_policy().names()
SWITCH_NS = START_NS + 15 * 10**9
LABELS = GroundLabels((START_NS, SWITCH_NS), ("mud", "asphalt"))


def test_a_label_holds_until_the_next_and_the_first_before_it() -> None:
    assert [LABELS.at(t) for t in (0, START_NS, SWITCH_NS - 1, SWITCH_NS)] == ["mud", "mud", "mud", "asphalt"]


def test_a_ground_the_policy_does_not_know_is_unknown() -> None:
    p = GroundLabels((0,), ("lava",)).probabilities(5, CLASSES)
    assert p[CLASSES.index("unknown")] == 1.0
    assert p.sum() == 1.0


@pytest.mark.parametrize(("times", "names"), [((), ()), ((1,), ("mud", "mud")), ((2, 1), ("mud", "snow"))])
def test_labels_that_do_not_fit_their_times_are_refused(times, names) -> None:
    with pytest.raises(ConfigError, match="ground labels at"):
        GroundLabels(times, names)


def test_the_estimator_takes_the_row_of_the_label() -> None:
    recording = until(simulate("figure_eight", terrain="loose_sand", seed=1), 45.0)
    labels = GroundLabels((START_NS,), ("loose_sand",))
    told = replay(recording, settings={"labels": labels}).estimate
    after = told.trajectory.t_ns > told.trajectory.t_ns[0]
    assert set(told.dominant_terrain()[after]) == {"loose_sand"}
    row = load_policy().classes["loose_sand"]
    settled = told.trajectory.t_ns > SWITCH_NS
    np.testing.assert_allclose(told.weights["side_slip_sigma"][settled], row.side_slip_sigma, rtol=1e-12)


def test_a_label_that_the_wheels_contradict_is_not_followed_for_long() -> None:
    recording = until(simulate("figure_eight", terrain="loose_sand", seed=1), 45.0)
    told = replay(recording, settings={"labels": LABELS}).estimate
    after = told.trajectory.t_ns > SWITCH_NS
    assert (told.dominant_terrain()[after] != "asphalt").mean() > 0.9


def test_a_dump_with_labels_goes_on() -> None:
    config = EstimatorConfig(load_vehicle("elevate").rig(), "elevate", labels=LABELS)
    estimator = Estimator(config)
    data = estimator.dump()
    assert Estimator.restore(config, data).dump() == data
