"""What diagnoses of the same references have in common, computed once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import joblib
import pytest

from terrafusion.twin.calibrate.log import PreparedLog
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.gap.null import evidence
from terrafusion.twin.gap.null.reference_twin import RUNS, set_to_references
from terrafusion.twin.gap.rollout.residuals import LinearisationCache

FITTED: dict[str, Model] = {}


@pytest.fixture(scope="module")
def fitted_once() -> Iterator[None]:
    """The twin is set to references of one content once in a process: two fifths of a diagnosis."""

    def remembered(
        logs: Sequence[PreparedLog], cache: LinearisationCache, channels: Sequence[str], jobs: int
    ) -> Model:
        c = cache.candidates
        key = joblib.hash([logs[:RUNS], cache.model, c.keys, c.scale, c.low, c.high, c.base, channels])
        if key not in FITTED:
            FITTED[key] = set_to_references(logs, cache, channels, jobs)
        return FITTED[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evidence, "set_as_before", remembered)
        yield
