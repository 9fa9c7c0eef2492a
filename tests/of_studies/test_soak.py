"""A run that is repeated goes on where it ended."""

from __future__ import annotations

import numpy as np

from terrafusion.twin.simulate import simulate
from tests.studies.speed.soak import repeated


def test_a_repeated_drive_goes_on_where_it_ended() -> None:
    again = repeated(simulate("figure_eight", terrain="asphalt", seed=5))
    first, second = next(again), next(again)
    assert first.gnss is not None
    assert second.gnss is not None
    assert second.gnss.t_ns[0] >= first.gnss.t_ns[-1]
    assert np.linalg.norm((second.gnss.enu_m[0] - first.gnss.enu_m[-1])[:2]) < 10.0
    steps = [np.linalg.norm(np.diff(r.gnss.enu_m[:, :2], axis=0), axis=1) for r in (first, second)]  # type: ignore[union-attr]
    np.testing.assert_allclose(steps[0], steps[1], atol=1e-9)
