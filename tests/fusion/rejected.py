"""Rejected measurements of an estimate, as `metrics.json` counts them."""

from __future__ import annotations

from terrafusion.fusion.estimate.estimate import Estimate


def rejected_counts(estimate: Estimate) -> dict[str, int]:
    """Measurements rejected by a gate, by sensor: `gnss` with velocities, `wheels` with side-slip."""
    counts = {"gnss": 0, "wheels": 0}
    for innovation in estimate.innovations:
        if not innovation.accepted:
            sensor = next((name for name in counts if innovation.sensor.startswith(name)), innovation.sensor)
            counts[sensor] = counts.get(sensor, 0) + 1
    return counts
