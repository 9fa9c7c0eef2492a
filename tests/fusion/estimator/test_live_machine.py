"""A small fixed part of the fuzzing of the live API."""

from __future__ import annotations

from hypothesis import HealthCheck, settings

from tests.fusion.estimator.live_machine import LiveMachine

TestLive = LiveMachine.TestCase
TestLive.settings = settings(
    max_examples=30, stateful_step_count=12, deadline=None, suppress_health_check=list(HealthCheck)
)
