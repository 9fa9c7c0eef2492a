"""NMEA 0183 logs: GGA, RMC, GST, VTG and ZDA of any talker, also between other lines and bytes."""

import dataclasses
import math
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core import limits
from terrafusion.datasets.core.arrays import TimesNs
from terrafusion.datasets.core.assumed_sigma import UP_FACTOR
from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import ASSUMED_SIGMA_M
from terrafusion.datasets.readers.delimited import check_lines
from terrafusion.datasets.readers.formats import Request
from terrafusion.datasets.readers.text.fixes import Fixes, gnss_channel
from terrafusion.datasets.readers.text.nmea_sentences import DAY_NS, NmeaEpochs, collect
from terrafusion.datasets.readers.text.row_times import row_times

SENTENCE = re.compile(rb"\$(?:G[PNLABQI]|BD|QZ|IN)(?:GGA|RMC|GST|ZDA|VTG|GLL|GSA|GSV),")
WEEKS_1024_DAYS = 1024 * 7
UNKNOWN_HDOP = 99.0
"""Receivers write 99.99 where they have none."""


def claims(path: Path, head: bytes) -> bool:
    """Whether the name ends in .nmea, or a sentence of a GNSS receiver stands in the first bytes."""
    return (path.suffix.lower() == ".nmea" and bool(head)) or bool(SENTENCE.search(head))


def read(request: Request) -> list[Recording]:
    """The one recording of a log: its GNSS channel."""
    path = request.path
    if path.stat().st_size > limits.TEXT_BYTES:
        raise limits.too_much("MB", limits.TEXT_BYTES / 2**20)
    data = path.read_bytes()
    check_lines(data)
    epochs, notes = collect(data.decode("latin-1"))
    t_ns, date_notes = _dated(epochs)
    times = row_times(request, "gnss", t_ns)
    fixes, more = _fixes(request, epochs, t_ns)
    fixes = dataclasses.replace(fixes.select(times.order), t_ns=times.t_ns)
    gnss, datum, rest = gnss_channel(request, fixes)
    if gnss is None:
        raise DataError("no sentence holds a fix", remedy="record it again under open sky")
    recording = Recording(
        name=path.stem,
        start_ns=max(int(gnss.t_ns[0]), 0),  # no recording starts before 1970
        gnss=gnss,
        datum=datum,
        source="NMEA 0183 log",
        notes=(*notes, *date_notes, *times.notes, *more, *rest),
        clock_jumps=times.jumps,
    )
    return [recording]


def _dated(epochs: NmeaEpochs) -> tuple[NDArray[np.int64], list[str]]:
    """Unix nanoseconds of the epochs: and notes on the source of their date."""
    day, date = epochs.column("day"), epochs.column("date")
    if np.isfinite(date).any():
        first_days = date - day  # the date of the log's first day, as each dated epoch has it
        known = np.flatnonzero(np.isfinite(first_days))
        nearest = known[np.clip(np.searchsorted(known, np.arange(len(day)), side="right") - 1, 0, None)]
        first, changes = first_days[nearest], int((np.diff(first_days[known]) != 0).sum())
        notes = [f"gnss: the date jumps {changes} times beyond midnights"] if changes else []
        off = first[0] - _receipt_days(epochs)
        weeks = round(off / WEEKS_1024_DAYS) if np.isfinite(off) else 0
        if weeks and abs(off - weeks * WEEKS_1024_DAYS) <= 1.0:
            first = first - weeks * WEEKS_1024_DAYS
            notes.append(
                f"gnss: dates are {weeks * 1024} GPS weeks off the log's own time stamps "
                "(the receiver's week counter rolled over); corrected"
            )
        elif abs(off) > 1.0:
            notes.append(f"gnss: dates are {off:.0f} days off the log's own time stamps; not corrected")
    elif np.isfinite(epochs.column("receipt_s")).any():
        first = np.full(len(day), _receipt_days(epochs))
        notes = ["gnss: no sentence has a date; that of the log's own time stamps is taken"]
    else:
        first = np.zeros(len(day))
        notes = ["gnss: no sentence has a date: times are those of day 0, 1970-01-01"]
    return (day + first).astype(np.int64) * DAY_NS + epochs.column("of_day_ns"), notes


def _receipt_days(epochs: NmeaEpochs) -> float:
    """Date of the log's first day by the time stamps in front of the sentences, days since 1970."""
    first = next((epoch for epoch in epochs.epochs if math.isfinite(epoch.receipt_s)), None)
    if first is None:
        return math.nan
    return float(np.rint((first.receipt_s - first.of_day_ns * 1e-9) / 86400.0) - first.day)


def _fixes(request: Request, epochs: NmeaEpochs, t_ns: TimesNs) -> tuple[Fixes, list[str]]:
    """The fixes, with HDOP for the sigmas that no GST gives."""
    notes = []
    fix, hdop = epochs.column("fix").astype(np.uint8), epochs.column("hdop")
    sigma = epochs.column("sigma_enu_m")
    spec = request.rig.sensors.gnss if request.rig else None
    at_one = np.array([spec.sigma_horizontal_m if spec else ASSUMED_SIGMA_M[Fix(k)] for k in range(len(Fix))])
    counted = np.isnan(sigma[:, :2]).any(axis=1) & (fix > Fix.NONE) & (hdop < UNKNOWN_HDOP)
    if counted.any():
        flat = (hdop * at_one[fix])[counted]
        sigma[counted] = np.stack([flat, flat, UP_FACTOR * flat], axis=1)
        used = ", ".join(f"{Fix(k).name.lower()} {at_one[k]:g} m" for k in np.unique(fix[counted]))
        notes.append(f"gnss: {int(counted.sum())} fixes without GST: sigma is HDOP times an assumed {used}")
    if epochs.left_out:
        notes.append(f"gnss: {epochs.left_out} estimated, manual or simulated positions left out")
    velocity = epochs.column("velocity_enu_mps")
    return Fixes(t_ns, epochs.column("llh"), fix, sigma, velocity), notes
