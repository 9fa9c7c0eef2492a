"""Scores of the diagnosis' development sets."""

from __future__ import annotations

from terrafusion.twin.gap.infer.calibration import calibration_head
from tests.studies.gap_sets import certainty, certainty_text, scores


def test_sets_without_a_detected_cause_have_no_certainty_to_score() -> None:
    clean = [{"number": 3, "truth": {}, "p": p, "other_drives": False} for p in (0.6, 0.01)]
    assert scores(clean, calibration_head())["false alarms"].hits == 1
    assert certainty_text(certainty(clean, calibration_head())) == "no set of known cause was detected"
