"""Answers do not depend on the order in which references are given."""

from __future__ import annotations

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
