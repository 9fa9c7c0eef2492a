"""Checks of one recording, run once: `repair` begins and ends with what a test asks before and after it."""

from __future__ import annotations

import pytest

from terrafusion.datasets.checks import run
from terrafusion.datasets.checks.finding import CheckContext, Finding


@pytest.fixture
def checked_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Findings of one recording, the object itself, beside one rig are computed once in a test."""
    known: list[tuple[CheckContext, list[Finding]]] = []
    compute = run._findings

    def remembered(context: CheckContext) -> list[Finding]:
        for before, findings in known:
            if before.recording is context.recording and before.rig == context.rig:
                return findings
        known.append((context, compute(context)))
        return known[-1][1]

    monkeypatch.setattr(run, "_findings", remembered)
