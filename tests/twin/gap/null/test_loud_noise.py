"""Noise that is louder on a drive than on the references' is no gap."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.infer.detection import detect
from terrafusion.twin.gap.infer.other_drives import learn_offsets
from terrafusion.twin.gap.infer.run_states import learn_state_sigma
from terrafusion.twin.gap.null import evidence as gathering
from terrafusion.twin.gap.null.score import score
from terrafusion.twin.gap.rollout.residuals import initial_state_sigma
from terrafusion.twin.model.vehicle import load_vehicle
from tests.twin.gap.runs import runs

pytestmark = pytest.mark.usefixtures("fitted_once")

CANDIDATES = Candidates.of(["gyro_bias", "gyro_scale", "track_width"])


def shaken(run: Recording) -> Recording:
    """With a gyro that is noisier from the middle of the run on."""
    assert run.imu is not None
    gyro = run.imu.gyro_radps.copy()
    late = np.arange(len(gyro)) > len(gyro) // 2
    gyro[late, 2] += np.random.default_rng(1).normal(0.0, 0.6, late.sum())
    return dataclasses.replace(run, imu=dataclasses.replace(run.imu, gyro_radps=gyro))


def p_values(judged: list[Recording], references: list[Recording]) -> tuple[float, float]:
    """Medians over runs, each judged alone: p of a gap, and the mean squared white error of the yaw rate."""
    found = gathering.gather_evidence(judged, references, load_vehicle("elevate"), None, CANDIDATES, jobs=1)
    sigma = learn_state_sigma(found.references, initial_state_sigma(CANDIDATES))
    offsets = learn_offsets([score(r, sigma) for r in found.references], CANDIDATES.count)
    yaw = [run.error[run.channel == found.channels.index("yaw_rate_radps")] for run in found.runs]
    p = [detect([score(run, sigma)], offsets, CANDIDATES, 0).p_value for run in found.runs]
    return float(np.median(p)), float(np.median([np.mean(own**2) for own in yaw]))


def test_louder_noise_is_no_gap(monkeypatch: pytest.MonkeyPatch) -> None:
    references, loud = runs(960, 5), [shaken(run) for run in runs(950, 5)]
    p, square = p_values(loud, references)
    assert p > 0.05
    assert square < 5.0
    monkeypatch.setattr(gathering, "with_loud_noise", lambda run, white, usual: run)
    p, square = p_values(loud, references)
    assert p <= 0.05
    assert square > 10.0
