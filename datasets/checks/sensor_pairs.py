"""Pairs of channels that observe the same motion, and the lag between them.

The command is not among them: the robot follows it with a delay.
"""

from terrafusion.datasets.checks.finding import CheckContext, period_s
from terrafusion.datasets.checks.motion import Signal, speeds, yaw_rates
from terrafusion.datasets.core.lag import Lag, lag_between
from terrafusion.datasets.core.recording import Recording

Pair = tuple[str, str]
"""Two channels, the second measured against the first."""
SensorPairs = dict[Pair, tuple[Signal, Signal]]
"""Their measurements of one quantity."""

YAW_PAIRS: tuple[Pair, ...] = (("imu", "wheels"), ("truth", "imu"))
SPEED_PAIRS: tuple[Pair, ...] = (("truth", "wheels"), ("gnss", "wheels"), ("truth", "gnss"))
LEAST_R = 0.7
NEAR_S, FAR_S = 2.0, 20.0
"""Lags are searched within the first reach; where nothing correlates there, within the second."""
FAR_R = 0.87
"""Least correlation of a lag within the second reach."""


def signal_pairs(context: CheckContext) -> SensorPairs:
    """The signals of all pairs that the recording has."""
    radius = context.wheel_radius_m() or 1.0
    found = {}
    for signals, pairs in (
        (yaw_rates(context.recording, radius), YAW_PAIRS),
        (speeds(context.recording, radius), SPEED_PAIRS),
    ):
        for one, other in pairs:
            if one in signals and other in signals:
                found[one, other] = signals[one], signals[other]
    return found


def near_lag(one: Signal, other: Signal, reach_s: float = NEAR_S, least_r: float = LEAST_R) -> Lag | None:
    """Lag of the second signal within the reach, where they correlate."""
    if not min(len(one[0]), len(other[0])):
        return None
    origin = one[0][0]
    t_one, t_other = (one[0] - origin) * 1e-9, (other[0] - origin) * 1e-9
    return lag_between(t_one, one[1], t_other, other[1], reach_s=reach_s, least_r=least_r)


def far_lag(one: Signal, other: Signal) -> Lag | None:
    """Lag of the second signal within the near reach, else within the far one."""
    near = near_lag(one, other)
    return near if near is not None else near_lag(one, other, FAR_S, FAR_R)


def odd_one(recording: Recording, off: set[Pair], measured: set[Pair]) -> str:
    """The channel that disagrees with the largest share of the others, of equals with most of them, of
    equals the one of lowest rate."""

    def oddness(name: str) -> tuple[float, int, float]:
        count = sum(name in pair for pair in off)
        period = period_s(getattr(recording, name).t_ns)
        return count / sum(name in pair for pair in measured), count, period

    return max(sorted({name for pair in off for name in pair}), key=oddness)


def reason(name: str, off: set[Pair]) -> str:
    """Why this channel is changed and no other, in words."""
    others = sorted(pair[0] if pair[1] == name else pair[1] for pair in off if name in pair)
    return f"it disagrees with {' and '.join(others)}" if len(others) > 1 else f"{others[0]} is not changed"
