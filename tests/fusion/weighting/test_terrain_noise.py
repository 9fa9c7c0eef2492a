"""What the terrain detector is given where keyframes are rarer than its updates."""

from __future__ import annotations

import numpy as np
import pytest

from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.terrain.features import Window
from terrafusion.twin.model.vehicle import as_vehicle


@pytest.mark.parametrize("wheels_hz", [5.0, 20.0])
def test_windows_have_the_time_and_acceleration_that_passed(wheels_hz: float) -> None:
    """Steadily 0.2 m/s2 for 20 s; wheels at 5 Hz make keyframes, and so windows, 0.6 s apart."""
    estimator = Estimator(EstimatorConfig(as_vehicle("husky").rig(), "husky"))
    seen: list[Window] = []
    detector = estimator.weights.detector
    update = detector.update
    detector.update = lambda window: (seen.append(window), update(window))[1]  # type: ignore[method-assign]
    estimator.set_start([0.0, 0.0, 0.0], 0.0)
    times = [(t, "imu") for t in np.arange(0.0, 20.0, 0.01)]
    times += [(t, "wheels") for t in np.arange(0.0, 20.0, 1.0 / wheels_hz)]
    for t, sensor in sorted(times):
        t_ns = 10**18 + round(t * 1e9)
        if sensor == "imu":
            estimator.add_imu(t_ns, [0.0, 0.0, 0.0], [0.2, 0.0, 9.81])
        else:
            estimator.add_wheels(t_ns, 0.2 * t, 0.2 * t)
    assert len(seen) > 20
    passed = 0.5 if wheels_hz == 20.0 else 0.6
    assert [w.dt_s for w in seen[1:]] == pytest.approx([passed] * (len(seen) - 1))
    rates = [w.wheel_speed_rate_mps2 for w in seen[3:]]
    assert rates == pytest.approx([0.2] * len(rates), abs=0.02)
