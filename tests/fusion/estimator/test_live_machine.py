"""A small fixed part of the fuzzing of the live API."""

from __future__ import annotations

from hypothesis import HealthCheck, settings

from tests.fusion.estimator.live_machine import LiveMachine

TestLive = LiveMachine.TestCase
TestLive.settings = settings(
    max_examples=12, stateful_step_count=10, deadline=None, suppress_health_check=list(HealthCheck)
)
