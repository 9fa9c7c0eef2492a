"""Where no compiler is found the diagnosis runs in CasADi's virtual machine, which is not safe in threads."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.twin.effects import catalogue
from terrafusion.twin.effects.form import Form, one
from terrafusion.twin.engine import compiler, native
from terrafusion.twin.engine.integrate import compiled
from terrafusion.twin.engine.reader import reader
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.null import evidence as gathering
from terrafusion.twin.gap.null import reference_twin
from terrafusion.twin.gap.null.evidence import GapEvidence, gather_evidence
from terrafusion.twin.model.vehicle import load_vehicle
from tests.twin.gap.runs import DRIVE, run, runs


@pytest.mark.skipif(not compiled(), reason="no C compiler")
def test_evidence_is_the_same_from_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("RUNS", "FIRST_STEPS", "STEPS"):  # the virtual machine takes seconds for a step of the fit
        monkeypatch.setattr(reference_twin, name, 1)
    monkeypatch.setattr(gathering, "set_as_before", reference_twin.set_to_references)
    monkeypatch.setattr(reference_twin, "STARTS", {})
    monkeypatch.setattr(reference_twin, "LIMITS", ())
    short = dataclasses.replace(DRIVE, duration_s=6.5, drive=DRIVE.drive[:3])
    judged, *references = (run(number, drive=short) for number in (970, 975, 976))
    given, candidates = ([judged], references), Candidates.of(["gyro_bias"])

    def evidence() -> GapEvidence:
        return gather_evidence(*given, load_vehicle("elevate"), None, candidates, jobs=2)

    fast = evidence()
    monkeypatch.setattr(compiler, "find_compiler", lambda: None)
    native.forget()
    reader.cache_clear()
    try:
        slow = evidence()
    finally:
        native.forget()
        reader.cache_clear()
    assert (fast.jobs, slow.jobs) == (2, 1)
    for mine, its in zip([*fast.runs, *fast.references], [*slow.runs, *slow.references], strict=True):
        difference = mine.rows - its.rows  # in units of the noise
        assert 0.0 < np.abs(difference).max() < 0.1
        assert np.sqrt(np.mean(difference**2)) < 3e-3


def test_an_effect_that_is_not_written_as_c_has_one_thread() -> None:
    import casadi as ca

    body = {"body": lambda q, e: {"body_force_x_n": q["body_force_x_n"] - ca.if_else(q["u"] > 0.5, e, 0.0)}}
    catalogue.register(Form("trailer", "brake", one("N", 10.0, 0.0, 200.0), body, "force e beyond 0.5 m/s"))
    given = runs(970, 1), runs(975, 1), load_vehicle("elevate"), None
    assert gather_evidence(*given, Candidates.of(["trailer"]), jobs=2).jobs == 1
