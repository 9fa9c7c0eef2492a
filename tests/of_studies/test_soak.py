"""A run that is repeated goes on where it ended; minutes of it leave memory and snapshots as they were."""

from __future__ import annotations

import numpy as np

from terrafusion.twin.simulate import simulate
from tests.studies.soak import MOST_LARGER, MOST_MB, Soak, repeated, soak


def test_a_repeated_drive_goes_on_where_it_ended() -> None:
    again = repeated(simulate("figure_eight", terrain="asphalt", seed=5))
    first, second = next(again), next(again)
    assert first.gnss is not None
    assert second.gnss is not None
    assert second.gnss.t_ns[0] >= first.gnss.t_ns[-1]
    assert np.linalg.norm((second.gnss.enu_m[0] - first.gnss.enu_m[-1])[:2]) < 10.0
    steps = [np.linalg.norm(np.diff(r.gnss.enu_m[:, :2], axis=0), axis=1) for r in (first, second)]  # type: ignore[union-attr]
    np.testing.assert_allclose(steps[0], steps[1], atol=1e-9)


def test_minutes_of_live_data_leave_memory_and_snapshots_bounded() -> None:
    found = soak(180.0, False, "figure_eight")
    assert found.end_s[-1] >= 180.0
    assert len(found.cpu_ms) > 1500
    assert found.used_mb[-1] - found.used_mb[0] < MOST_MB
    assert max(found.dump_kb) < MOST_LARGER * found.dump_kb[0]


def test_growth_and_slower_calls_miss_the_targets() -> None:
    at_s = [0.1 * i for i in range(12_000)]
    steady = Soak([600.0, 1200.0], [100.0, 101.0], [50.0, 50.0], at_s, [1.0] * len(at_s))
    assert "x: targets met" in list(steady.lines("x"))
    for worse in (
        {"used_mb": [100.0, 116.0]},
        {"cpu_ms": [1.0 if t < 600.0 else 1.3 for t in at_s]},
        {"dump_kb": [50.0, 61.0]},
    ):
        assert "x: targets missed" in list(Soak(**{**vars(steady), **worse}).lines("x"))
