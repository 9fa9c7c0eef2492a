"""Changes of a command lie anywhere between two logged ones: what that does to the errors is no finding."""

from __future__ import annotations

import dataclasses

import numpy as np

from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.data.logs import prepared
from terrafusion.twin.gap.null.channel_noise import learn_noise
from terrafusion.twin.gap.rollout.residuals import LinearisationCache, run_residuals, whitened, with_timing
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.scenario.scenario import DriveSegment
from tests.twin.gap.runs import DRIVE, run

CANDIDATES = Candidates.of(["wheel_radius"])


def between_samples(by_s: float) -> Recording:
    """A run whose commands change so much after whole tenths of a second."""
    first, *rest = DRIVE.drive
    later = (DriveSegment(first.duration_s + by_s, first.v_mps, first.yaw_rate_radps), *rest)
    return run(3, drive=dataclasses.replace(DRIVE, drive=later))


def test_wheel_errors_at_unlogged_steps_stay_within_their_sigma() -> None:
    references, judged = [run(1), run(2)], between_samples(0.5 / 30.0)
    logs, model, _ = prepared([*references, judged], load_vehicle("elevate"), "loose_sand")
    channels = tuple(o.channel for o in logs[0].observed)
    residuals = [run_residuals(log, LinearisationCache(model, CANDIDATES), channels) for log in logs]
    noise = learn_noise(residuals[:2], residuals[2:], CANDIDATES)

    def square(timed: bool) -> float:
        one = residuals[2]
        observed = one.log.observed
        if not timed:
            observed = tuple(dataclasses.replace(o, timing=None) for o in observed)
        white = whitened(dataclasses.replace(one, log=dataclasses.replace(one.log, observed=observed)), noise)
        wheels = [i for i, name in enumerate(channels) if name.startswith("wheel")]
        return float(np.mean(white.error[np.isin(white.channel, wheels)] ** 2))

    print(square(timed=False), square(timed=True))
    assert square(timed=False) > 2.0
    assert square(timed=True) < 1.5


def test_only_changes_of_the_input_within_a_window_count() -> None:
    (log,), _, _ = prepared([run(1)], load_vehicle("elevate"), "loose_sand")
    assert log.input_step_s > 0.0
    steady = with_timing(log, [np.zeros(len(o.value)) for o in log.observed])
    assert all(o.timing is not None and not o.timing.any() for o in steady.observed)
    followed = dataclasses.replace(log, input_step_s=0.0)
    assert with_timing(followed, [o.value for o in log.observed]) is followed
