"""Delayed readings: an observed sample is made of the twin's run as it was a delay earlier.

The catalogue's law of a delay is first order, y - e dy/dt: enough for a sensitivity, but wrong for a delay of
a third of a second. A fit through the twin uses the delay itself. IMU readings continue across windows;
positions are reset at each window and are extrapolated before its start.
"""

import dataclasses
from collections.abc import Mapping

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.calibrate.log import PreparedLog, window_of
from terrafusion.twin.calibrate.observations import Observed
from terrafusion.twin.calibrate.predict import averaging
from terrafusion.twin.effects.sensing import CLOCK_S, IMU
from terrafusion.twin.gap.data.samples import Indices, drop_zero_weights, sample_map
from terrafusion.twin.sensors.effects import CLOCK_DRIFT, DELAYS


def delayed_samples(log: PreparedLog, effects: Mapping[str, float]) -> list[tuple[Indices, Array]]:
    """`SampleMap.fine` of the log with the delays among the effects."""
    delays = {key: effects[key] for key in DELAYS if effects.get(key, 0.0) != 0.0}
    out = list(sample_map(log).fine)
    for i, observed in enumerate(log.observed):
        delay_s = _delay_s(observed, delays)
        if delay_s.any():
            before = dataclasses.replace(
                observed, begin_s=observed.begin_s - delay_s, end_s=observed.end_s - delay_s
            )
            window = window_of(before if observed.channel in IMU else observed, log.windows)
            out[i] = drop_zero_weights(*averaging(before, log, np.maximum(window, 0)))
    return out


def _delay_s(observed: Observed, delays: Mapping[str, float]) -> Array:
    """Delay (n,) of each sample of a channel, s."""
    middle = 0.5 * (observed.begin_s + observed.end_s)
    out = np.zeros(len(middle))
    for key, value in delays.items():
        if observed.channel in DELAYS[key]:
            out += value * (middle / CLOCK_S if key == CLOCK_DRIFT else 1.0)
    return out
