"""Numbers that nothing on a ground robot reaches."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from terrafusion.datasets.doctor.finding import Finding, Patient

LIMITS = {
    ("command", "_mps"): 100.0,
    ("command", "_radps"): 100.0,
    ("wheels", "_mps"): 100.0,
    ("wheels", "_radps"): 1000.0,
    ("imu", "_radps"): 100.0,
    ("imu", "_mps2"): 2000.0,
    ("gnss", "_m"): 2e7,
    ("gnss", "_mps"): 1e4,
    ("motor", "_a"): 1e5,
    ("motor", "_v"): 1e5,
    ("truth", "_m"): 2e7,
}
"""Magnitudes that nothing on a ground robot reaches, by channel and unit. MEMS gyros end at 70 rad/s
(4000 deg/s), accelerometers at 2000 m/s2 (200 g); projected coordinates at 1e7 m."""


def check_magnitude(patient: Patient) -> Iterator[Finding]:
    """Numbers that no robot reaches: a wrong unit, or memory read as numbers."""
    recording = patient.recording
    tables = {name: (channel.t_ns, channel.columns()) for name, channel in recording.channels().items()}
    if recording.truth is not None and len(recording.truth):
        position = dict(zip(("x_m", "y_m", "z_m"), recording.truth.position_m.T, strict=True))
        tables["truth"] = recording.truth.t_ns, position
    for name, (t_ns, columns) in tables.items():
        for column, values in columns.items():
            limit = LIMITS.get((name, column[column.rindex("_") :] if "_" in column else ""))
            bad = np.flatnonzero(np.abs(values) > limit) if limit is not None else np.zeros(0, dtype=int)
            if bad.size:
                at_s = patient.since_start_s(t_ns[bad[0]])
                yield Finding(
                    "impossible-value",
                    "error",
                    name,
                    f"{column} is {values[bad[0]]:g}, beyond anything possible",
                    f"at t = {at_s:.3f} s; {bad.size} of {len(values)} values beyond {limit:g}",
                    "is the unit right? mend these rows, or leave the cells empty",
                )
