"""Aligns the twin's track in each window with the GNSS track.

The pose at a window's start comes from wheels and gyro and is off by tenths of a radian where these are at
fault. A linearisation about that pose would show a gyro bias in GNSS positions. On level ground the track
turns and shifts as a whole, so it is aligned with the fixes by a rigid transform instead. Tracks are complex
here: east + i north.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.calibrate.log import PreparedLog, window_of
from terrafusion.twin.gap.data.samples import Indices

EAST_NORTH = (("gnss_east_m", "gnss_north_m"), ("gnss_v_e_mps", "gnss_v_n_mps"))
"""Channels of positions (rotated and shifted) and of velocities (rotated only)."""
HEADING_SIGMA_RAD = 0.5  # 1 sigma of the initial heading (assumed): keeps it in a window without motion

Track = NDArray[np.complex128]


def alignment_angles(log: PreparedLog, values: Sequence[Array]) -> Array:
    """Angles (W,), rad, that rotate predicted tracks, one array a channel of `log.observed`, onto the
    observed.

    Least squares over rotation and shift of each window (Umeyama 1991, without scale), positions and
    velocities together.
    """
    turn = np.full(len(log.windows), HEADING_SIGMA_RAD**-2.0, dtype=complex)
    for pair, east, north, window in tracks(log):
        observed, predicted = _observed(log, east, north), values[east] + 1j * values[north]
        if pair == EAST_NORTH[0]:
            observed, predicted = (z - _means(z, window, len(turn))[window] for z in (observed, predicted))
        sigma = float(np.median(log.observed[east].sigma))
        np.add.at(turn, window, predicted.conj() * observed / sigma**2)
    return np.angle(turn)


def aligned_start(log: PreparedLog, values: Sequence[Array], start: Array) -> Array:
    """Poses (W, 3) at the windows' starts that align the predictions, made from the poses `start`."""
    out, turn = start.copy(), alignment_angles(log, values)
    out[:, 2] += turn
    for pair, east, north, window in tracks(log):
        if pair == EAST_NORTH[0]:
            observed, predicted = _observed(log, east, north), values[east] + 1j * values[north]
            before, after = (_means(z, window, len(out)) for z in (predicted, observed))
            place = after + np.exp(1j * turn) * (start[:, 0] + 1j * start[:, 1] - before)
            seen = np.unique(window)
            out[seen, 0], out[seen, 1] = place[seen].real, place[seen].imag
    return out


def moved(log: PreparedLog, values: Sequence[Array], old: Array, new: Array) -> list[Array]:
    """Predicted channels (n,) from other poses (W, 3) at the windows' starts than the old ones: on a level
    plane a run shifts and turns as a whole."""
    turn = new[:, 2] - old[:, 2]
    before, after = (pose[:, 0] + 1j * pose[:, 1] for pose in (old, new))
    return rotated(log, values, turn, after - np.exp(1j * turn) * before)


def rotated(
    log: PreparedLog, channels: Sequence[Array], angle: Array, shift: Track | None = None
) -> list[Array]:
    """Channels (n, ...) with the east and north ones of each window rotated by an angle (W,), and positions
    shifted (W,)."""
    out = list(channels)
    for pair, east, north, window in tracks(log):
        at = angle[window].reshape(-1, *[1] * (channels[east].ndim - 1))
        turned = np.exp(1j * at) * (channels[east] + 1j * channels[north])
        if shift is not None and pair == EAST_NORTH[0]:
            turned = turned + shift[window]
        out[east], out[north] = turned.real, turned.imag
    return out


def window_index(log: PreparedLog, channel: int) -> Indices:
    """Number (n,) of the window of each sample of a channel."""
    return np.clip(window_of(log.observed[channel], log.windows), 0, len(log.windows) - 1)


def tracks(log: PreparedLog) -> list[tuple[tuple[str, str], int, int, Indices]]:
    """Of `EAST_NORTH` what the log has, with the indices of both channels and the window of each sample."""
    index = {o.channel: i for i, o in enumerate(log.observed)}
    known = [pair for pair in EAST_NORTH if {*pair} <= index.keys()]
    return [(pair, index[pair[0]], index[pair[1]], window_index(log, index[pair[0]])) for pair in known]


def _observed(log: PreparedLog, east: int, north: int) -> Track:
    return log.observed[east].value + 1j * log.observed[north].value


def _means(track: Track, window: Indices, count: int) -> Track:
    """Mean (W,) in each window; zero in one without samples."""
    out = np.zeros(count, dtype=complex)
    np.add.at(out, window, track)
    return np.asarray(out / np.maximum(np.bincount(window, minlength=count), 1), dtype=complex)
