"""A motor limit that references do not show, or hold, is not what has changed."""

from __future__ import annotations

import pytest

from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.infer.bank import SignatureBank, SimulatedSize, model_soil
from terrafusion.twin.gap.infer.reference_check import ReferenceCheck
from terrafusion.twin.gap.null.evidence import gather_evidence
from terrafusion.twin.model.vehicle import load_vehicle
from tests.twin.gap.runs import runs

KEY, SCALE = "torque_limit/scale", 0.2  # typical size
CANDIDATES = Candidates.of(["torque_limit", "gyro_bias"])
LIMIT, *_, BIAS = CANDIDATES.hypotheses


@pytest.mark.parametrize(
    ("usual", "may_be_old"),
    [({}, {0.4: True, 0.7: False, 0.85: False}), ({KEY: 0.7}, {0.4: True, 0.7: True, 0.85: False})],
    ids=["of strong motors", "of weak motors"],
)
def test_references(usual: dict[str, float], may_be_old: dict[float, bool]) -> None:
    """No drive meets a limit that is 0.4 lower; all meet one that is 0.7 lower."""
    e = gather_evidence(
        runs(970, 1, {KEY: 0.7}), runs(975, 3, usual), load_vehicle("elevate"), None, CANDIDATES
    )
    points = [SimulatedSize(LIMIT, lower / SCALE, model_soil(e)) for lower in may_be_old]
    check = ReferenceCheck(SignatureBank.empty(e).with_sizes(e, points), e)
    assert {lower: check.may_be_old(LIMIT, lower / SCALE) for lower in may_be_old} == may_be_old
    assert not check.may_be_old(BIAS, 1.0)
