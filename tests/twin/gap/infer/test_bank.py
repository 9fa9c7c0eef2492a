"""Signatures at simulated sizes, and what they leave of the range of a law."""

from __future__ import annotations

import numpy as np
import pytest

from terrafusion.twin.gap.data.candidates import Candidates, Hypothesis
from terrafusion.twin.gap.infer.bank import DELAYED, SignatureBank, SimulatedSize, model_soil
from terrafusion.twin.gap.infer.explain import _Explainer
from terrafusion.twin.gap.infer.other_drives import learn_offsets
from terrafusion.twin.gap.infer.run_states import learn_state_sigma
from terrafusion.twin.gap.null.evidence import GapEvidence, gather_evidence
from terrafusion.twin.gap.null.score import score
from terrafusion.twin.gap.rollout.residuals import initial_state_sigma
from terrafusion.twin.model.vehicle import load_vehicle
from tests.twin.gap.runs import runs

CANDIDATES = Candidates.of(["wheel_radius", "gyro_bias"])
LAW = CANDIDATES.hypotheses[0]
TOP = float(CANDIDATES.bounds(LAW.columns)[1][0])


@pytest.fixture(scope="module")
def evidence() -> GapEvidence:
    return gather_evidence(runs(980, 1), runs(985, 3), load_vehicle("elevate"), None, CANDIDATES)


def simulated(bank: SignatureBank, of: SignatureBank, law: Hypothesis = LAW) -> set[float]:
    """Sizes whose signatures are others than those of a bank."""
    known = of.signatures[law]
    return {x for x, s in bank.signatures[law].items() if x not in known or known[x] is not s}


def test_sizes_beyond_a_simulated_one_stay_within_the_range(evidence: GapEvidence) -> None:
    """The end of the range, too, is simulated: between two sizes signatures are interpolated."""
    first, soil = SignatureBank.of(evidence), model_soil(evidence)
    near, far = 0.9 * TOP, 0.5 * TOP
    points = [SimulatedSize(LAW, x, soil) for x in (near, 0.95 * near, far)]
    bank = first.with_sizes(evidence, points)
    np.testing.assert_allclose(bank.sizes(LAW), [-TOP, 0.0, far, near, TOP])
    assert simulated(bank, first) == {far, near, TOP}
    again = bank.with_sizes(evidence, [SimulatedSize(LAW, 0.93 * TOP, soil)])
    np.testing.assert_allclose(again.sizes(LAW), [-TOP, 0.0, far, 0.93 * TOP, TOP])
    assert simulated(again, bank) == {0.93 * TOP, TOP}


def test_a_larger_size_to_try_does_not_displace_the_best_one(evidence: GapEvidence) -> None:
    sigma = learn_state_sigma(evidence.references, initial_state_sigma(CANDIDATES))
    robot = learn_offsets([score(r, sigma) for r in evidence.references], CANDIDATES.count)
    own = _Explainer(evidence, sigma, robot, ())
    bank = own.with_first_sizes(own.look(SignatureBank.of(evidence)), {0: [0.9 * TOP]})
    np.testing.assert_allclose(bank.sizes(LAW), [-TOP, 0.0, 0.9 * TOP, TOP])


def test_a_delay_of_commands_is_simulated_at_whole_sizes_from_the_start() -> None:
    """On a robot whose sensitivity had the other sign a dead time of .15 s was found by no later look."""
    candidates = Candidates.of(["dead_time"])
    evidence = gather_evidence(runs(980, 1), runs(985, 3), load_vehicle("elevate"), None, candidates)
    bank = SignatureBank.of(evidence)
    assert all({*DELAYED} < {*bank.sizes(law).tolist()} for law in candidates.hypotheses)
    by_sensitivity = SignatureBank.of(evidence, simulate=False)
    assert not any({*DELAYED} & {*by_sensitivity.sizes(law).tolist()} for law in candidates.hypotheses)
