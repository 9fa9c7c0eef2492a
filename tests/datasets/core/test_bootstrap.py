"""Resampling of rows and groups, and the interval of a resampled statistic."""

from __future__ import annotations

import numpy as np

from terrafusion.datasets.core.bootstrap import percentile_interval, resampled_rows
from tests.studies.twin_field.resampled_groups import resampled_groups


def test_rows_are_drawn_with_replacement_and_repeatably() -> None:
    rows = resampled_rows(5, 200, seed=3)
    assert rows.shape == (200, 5)
    assert np.array_equal(rows, resampled_rows(5, 200, seed=3))
    assert set(rows.ravel().tolist()) == set(range(5))
    assert any(len(set(row.tolist())) < 5 for row in rows)


def test_rows_of_a_group_are_drawn_together() -> None:
    group = np.array(["a", "a", "b", "c", "c", "c"])
    for rows in resampled_groups(group, 50, seed=1):
        names, counts = np.unique(group[rows], return_counts=True)
        size = {"a": 2, "b": 1, "c": 3}
        assert all(count % size[str(name)] == 0 for name, count in zip(names, counts, strict=True))


def test_the_interval_leaves_the_tails_out() -> None:
    assert percentile_interval(np.arange(101.0)) == (2.5, 97.5)
    assert percentile_interval(np.arange(101.0), 10.0) == (10.0, 90.0)
