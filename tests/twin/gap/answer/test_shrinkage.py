"""The share of the gap that disappears lies between nothing and all of it."""

from __future__ import annotations

import numpy as np
import pytest

from terrafusion.twin.gap.answer.shrinkage import _share


@pytest.mark.parametrize(("after", "share"), [(0.5, 1.0), (1.0, 1.0), (2.0, 0.5), (4.0, 0.0)])
def test_share_is_between_zero_and_one(after: float, share: float) -> None:
    spread = np.array([-0.1, 0.0, 0.1])
    found, interval = _share(3.0 + spread, after + spread[::-1], 1.0, 0.1)
    assert found == pytest.approx(share)
    assert interval is not None
    assert 0.0 <= interval[0] <= interval[1] <= 1.0
