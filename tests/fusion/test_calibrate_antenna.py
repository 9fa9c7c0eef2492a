"""`--calibrate` of a robot whose antenna nobody measured."""

from __future__ import annotations

import pytest

from terrafusion.datasets.core.recording import Overrides
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.config.sensor_config import sensor_config_of
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.graph.key_state import LINEAR
from terrafusion.twin.model.vehicle import load_vehicle, with_overrides
from terrafusion.twin.simulate import simulate


def test_an_assumed_antenna_that_is_far_off_is_found_within_its_sigma() -> None:
    log = simulate("figure_eight", terrain="asphalt", seed=1)
    wrong = with_overrides(load_vehicle("elevate"), Overrides(antenna_m=(-0.3, 0.2, 0.35)))
    inputs = sensor_config_of(log, log.gnss)
    estimator = Estimator(EstimatorConfig(wrong.rig(), wrong.name, inputs=inputs, calibrate=True))
    for message in log.messages():
        estimator.add(message)
    estimator.finish()
    state = estimator.latest()
    assert state is not None
    assert state.linear is not None
    assert state.linear_sigma is not None
    for name, off_m in (("antenna_x_m", 0.3), ("antenna_y_m", -0.2)):
        at = LINEAR.index(name)
        sigma_m = float(state.linear_sigma[at])
        assert sigma_m < 0.05
        assert float(state.linear[at]) == pytest.approx(off_m, abs=2.0 * sigma_m)
