"""Answers depend neither on the order in which references are given, nor on where and when runs were made."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.gap.diagnose import diagnose
from terrafusion.twin.model.vehicle import load_vehicle
from tests.twin.gap.runs import runs

EFFECTS = ("wheel_radius", "gyro_bias", "imu_time_offset", "mass")


def test_the_order_of_references_does_not_matter() -> None:
    """The soil is that of a few of them, and groups of them show what laws gain by chance."""
    judged, references = runs(300, 2, {"wheel_radius/scale": 0.03}), runs(100, 6)
    first, second = (
        diagnose(judged, some, load_vehicle("elevate"), effects=EFFECTS).to_json()
        for some in (references, references[::-1])
    )
    assert first["named"]
    assert first.pop("reference_runs") == [r.name for r in references]
    assert second.pop("reference_runs") == [r.name for r in references[::-1]]
    assert first == second


def elsewhere(run: Recording) -> Recording:
    """The same run a day later, 1 km away, in a frame that is turned by a quarter."""
    later_ns, turned = 86_400_000_000_000, np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    later = {name: dataclasses.replace(c, t_ns=c.t_ns + later_ns) for name, c in run.channels().items()}
    fixes = later["gnss"]
    velocity = fixes.velocity_enu_mps
    later["gnss"] = dataclasses.replace(
        fixes, enu_m=fixes.enu_m @ turned + [900.0, -500.0, 0.0],
        velocity_enu_mps=None if velocity is None else velocity @ turned,
    )  # fmt: skip
    return dataclasses.replace(run, start_ns=run.start_ns + later_ns, truth=None, **later)


def test_where_and_when_runs_were_made_does_not_matter() -> None:
    """Three references set the twin: they are the same ones on another day and place."""
    judged, references = runs(300, 2, {"wheel_radius/scale": 0.03}), runs(100, 6)
    first, second = (
        diagnose([*map(move, judged)], [*map(move, references)], load_vehicle("elevate"), effects=EFFECTS)
        for move in (lambda run: dataclasses.replace(run, truth=None), elsewhere)
    )
    assert [r.name for r in second.evidence.references] == [r.name for r in first.evidence.references]
    assert first.verdict.named
    assert second.verdict.named == first.verdict.named
    assert second.detection.statistic == pytest.approx(first.detection.statistic, rel=1e-3)
    for one, other in zip(first.verdict.causes, second.verdict.causes, strict=True):
        assert other.effect == one.effect
        np.testing.assert_allclose(other.value, one.value, rtol=1e-3, atol=1e-6)
