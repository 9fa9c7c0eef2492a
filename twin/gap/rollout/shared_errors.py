"""Errors that wheels and gyro share.

A side's wheels that turn faster than the twin's turn the robot, too: one cause shows in two channels. What
the measured wheels say of the turn rate is subtracted from it in proportion to a gain that the references
teach. What is left is an innovation: the error of the gyro given that of the wheels. The map is linear and
has an inverse, so that errors and sensitivities keep all they say; where wheels have noise of their own only,
the gain is zero. Fixes share the gyro's errors by `measured_turns`.
"""

from collections.abc import Iterable, Mapping, Sequence

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.calibrate.log import PreparedLog
from terrafusion.twin.calibrate.noise import ResidualNoise
from terrafusion.twin.gap.data.samples import interpolated
from terrafusion.twin.gap.rollout.measured_turns import GYRO

WHEELS = "wheel_left_radps", "wheel_right_radps"
LEAST_EXPLAINED = 0.1
"""Share of the gyro's squared errors that the wheels must explain (assumed): less is chance, and would carry
their own noise over."""


class ChannelNoise(dict[str, ResidualNoise]):
    """Noise by channel, of what is left without the shared errors; `turn` is the gain: turn rate by the
    difference of the wheels' speeds."""

    def __init__(self, channels: Mapping[str, ResidualNoise], turn: float = 0.0) -> None:
        super().__init__(channels)
        self.turn = turn


def without_shared(log: PreparedLog, turn: float, columns: Sequence[Array]) -> list[Array]:
    """Columns (n, k) of all channels, one array each, the gyro's without what the wheels show of them."""
    out = list(columns)
    if turn != 0.0 and (found := _shown(log, columns)) is not None:
        gyro, shown = found
        out[gyro] = columns[gyro] - turn * shown
    return out


def with_shared(log: PreparedLog, turn: float, columns: Sequence[Array]) -> list[Array]:
    """The columns (n, k) that `without_shared` made these of."""
    return without_shared(log, -turn, columns)


def learn_gain(errors: Iterable[tuple[PreparedLog, Sequence[Array]]]) -> float:
    """By least squares over errors of runs, one array (n,) a channel; zero where it explains too little."""
    inner = square = total = 0.0
    for log, own in errors:
        if (found := _shown(log, own)) is not None:
            gyro, shown = found
            inner, square = inner + float(shown @ own[gyro]), square + float(shown @ shown)
            total += float(own[gyro] @ own[gyro])
    return inner / square if inner**2 > LEAST_EXPLAINED * square * total else 0.0


def _shown(log: PreparedLog, columns: Sequence[Array]) -> tuple[int, Array] | None:
    """Index of the gyro, and the difference (m, ...) of the columns of both sides' wheels at its samples;
    None where one of them is missing."""
    at = {o.channel: i for i, o in enumerate(log.observed)}
    if not {*WHEELS, GYRO} <= at.keys():
        return None
    middle = [0.5 * (log.observed[at[c]].begin_s + log.observed[at[c]].end_s) for c in (*WHEELS, GYRO)]
    left, right = (interpolated(middle[2], middle[i], columns[at[c]]) for i, c in enumerate(WHEELS))
    return at[GYRO], right - left
