"""Speed, side by side in one run: what depends on the machine is compared, not bounded."""

from __future__ import annotations

import numpy as np
import pytest

from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.graph.batch import BatchSmoother
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.simulate import simulate
from tests.studies.speed import gtsam_graph as speed_gtsam
from tests.studies.speed.gtsam_graph import Graph
from tests.studies.speed.speed import Live, batch_parts, first_part, initial, live


@pytest.fixture(scope="module")
def taken() -> Live:
    """A drive of 15 s with all its factors; of the calibration's states, too, as GTSAM's graph has them."""
    recording = first_part(simulate("figure_eight", terrain="asphalt", seed=5), 15.0)
    config = EstimatorConfig(load_vehicle("elevate").rig(), "elevate", calibrate=True)
    return live(recording, config, keep=True)


def test_every_keyframe_is_timed(taken: Live) -> None:
    assert len(taken.wall_ms) == len(taken.cpu_ms) > 100
    assert taken.seconds >= 1e-3 * sum(taken.wall_ms)
    assert next(taken.lines()).startswith("keyframe, wall: mean ")


def test_the_batch_beats_the_live_pass_and_gtsam_on_the_same_graph(taken: Live) -> None:
    assert taken.archive is not None
    start = initial(taken)
    parts = batch_parts(taken.archive, start)
    ours = sum(cpu for name, (_, cpu) in parts.items() if not name.startswith(" "))
    assert ours < 0.5 * taken.cpu_s
    seconds, error = speed_gtsam.batch(taken.archive, start, Graph.FULL, "GaussNewton")
    assert ours < 0.5 * seconds
    batch = BatchSmoother(taken.archive, start)
    batch.optimise()
    # GTSAM's error is half the sum of squares, and its prior is carried along with the first keyframe.
    assert np.isfinite(error)
    assert batch.linearise() == pytest.approx(2.0 * error, rel=1e-2)
