"""How far the gap shrinks on runs that the effect was not fitted to.

Each judged run is left out in turn, the effect is fitted to the others, and the twin is run with it on the
one left out, with theta and poses fitted anew in both arms. A single run is scored on itself, without an
interval.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.gap.infer.other_drives import RobotOffsets
from terrafusion.twin.gap.infer.refit import RunWithEffects, whitened_errors
from terrafusion.twin.gap.infer.single_effects import Fitted
from terrafusion.twin.gap.null.evidence import GapEvidence
from terrafusion.twin.gap.rollout.nuisance import CHANNEL_NAMES
from terrafusion.twin.gap.rollout.residuals import WhitenedRun, physical_error

METRIC = "mean squared whitened error with soil, offsets and pose adapted, on runs left out of the fit"
ABOVE_FLOOR = 3.0  # standard deviations of the floor (assumed) above which a gap has a share
NOTHING = 0.1  # share of the gap (assumed) that an effect removes at least, if it is a cause
FREE = 10.0  # factor on theta's 1 sigma where it alone is recalibrated (assumed: nearly free)


LeftOut = Callable[[Fitted], list[tuple[Array, ...]]]


@dataclass(frozen=True, eq=False)
class Shrinkage:
    """Mean squared errors before and after.

    Attributes:
        before, after, floor: without and with the effect, and of the references; after is at least the floor,
            or before where that is less.
        share, interval: of the gap above the floor that the effect removes, with its 95 % interval, 0 to 1.
        recalibrated: error with theta alone fitted more freely.
        channels: root mean squares (before, after, floor) by channel.
        physical: the same in the unit of each channel (`CHANNEL_UNITS`).
        errors_after, errors_before: whitened errors of each run.
    """

    before: float
    after: float
    floor: float | None
    share: float | None
    interval: tuple[float, float] | None
    recalibrated: float
    channels: dict[str, tuple[float, float, float | None]]
    physical: dict[str, tuple[float, float, float | None]]
    errors_after: list[Array]
    errors_before: list[Array]

    def nothing_removed(self) -> bool:
        """Whether the twin with the effect is, with 95 % confidence, as far from runs left out of the fit; or
        a single run from the one it was fitted to."""
        most = self.share if self.interval is None else self.interval[1]
        return most is not None and most < NOTHING


def own_error(run: WhitenedRun, robot: RobotOffsets) -> Array:
    """The run's whitened error (n,) less what is common to the references."""
    return run.error - run.by_parameter @ robot.mean


def shrinkage(
    evidence: GapEvidence, sigma: Array, robot: RobotOffsets, fit: Fitted | None, left_out: LeftOut
) -> Shrinkage:
    """Shrinkage by fitted effects; zero without any. `left_out` is that of the explanation."""
    runs, references = evidence.runs, evidence.references
    was = [own_error(run, robot) for run in runs]
    now = was if fit is None else _errors_left_out(evidence, sigma, robot, fit, left_out(fit), was)
    free = [_mean_square(r.without_states(FREE * sigma, e)) for r, e in zip(runs, was, strict=True)]
    arms = [
        [(r, r.without_states(sigma, e)) for r, e in zip(some, errors, strict=True)]
        for some, errors in (
            (runs, was),
            (runs, now),
            (references, [own_error(r, robot) for r in references]),
        )
    ]
    before, after, floors = (np.array([_mean_square(error) for _, error in arm]) for arm in arms)
    floor = float(floors.mean()) if len(floors) else None
    spread = float(floors.std(ddof=1)) if len(floors) > 1 else None
    share, interval = _share(before, after, floor, spread)
    least = min(floor, float(before.mean())) if floor is not None else 0.0
    physical = [[(r, physical_error(r, evidence.noise, e)) for r, e in arm] for arm in arms]
    return Shrinkage(
        float(before.mean()), max(float(after.mean()), least), floor, share, interval, float(np.mean(free)),
        _by_channel(evidence, arms), _by_channel(evidence, physical), now, was,
    )  # fmt: skip


def _mean_square(error: Array) -> float:
    return float(error @ error) / max(len(error), 1)


def _by_channel(
    evidence: GapEvidence, arms: Sequence[Sequence[tuple[WhitenedRun, Array]]]
) -> dict[str, tuple[float, float, float | None]]:
    """Root mean squares of errors of the judged runs, before and after, and of the references."""
    names = np.array([CHANNEL_NAMES[c] for c in evidence.channels])

    def rms(arm: Sequence[tuple[WhitenedRun, Array]], name: str) -> float:
        joined = np.concatenate([error[names[run.channel] == name] for run, error in arm])
        return float(np.sqrt(np.mean(joined**2)))

    before, after, normal = arms
    return {
        name: (rms(before, name), rms(after, name), rms(normal, name) if normal else None)
        for name in dict.fromkeys(names.tolist())
    }


def _errors_left_out(
    evidence: GapEvidence, sigma: Array, robot: RobotOffsets, fit: Fitted, values: list[tuple[Array, ...]],
    was: list[Array],
) -> list[Array]:  # fmt: skip
    """Errors of each run with the effect at its values fitted to the other runs, on the better of two soils:
    the one that fits the run without the effect may hold a part of it, the references' holds none. Without
    the effect the first is the better one: its search begins at the second."""
    runs, tried = evidence.runs, list[RunWithEffects]()
    for i, x in enumerate(values):
        effects = evidence.candidates.changed(fit.columns, np.concatenate(x))
        tried += [RunWithEffects(i, effects), RunWithEffects(i, effects, np.zeros(len(evidence.soil_limit)))]
    found = whitened_errors(evidence, tried)
    out = list[Array]()
    for run, before, *both in zip(runs, was, found[::2], found[1::2], strict=True):
        errors = [e - run.by_parameter @ robot.mean for e in both if e is not None]
        left = [_mean_square(run.without_states(sigma, e)) for e in errors]
        out.append(errors[int(np.argmin(left))] if errors else before)
    return out


def _share(
    before: Array, after: Array, floor: float | None, spread: float | None
) -> tuple[float | None, tuple[float, float] | None]:
    if floor is None or spread is None:
        return None, None
    if before.mean() - floor <= ABOVE_FLOOR * spread / np.sqrt(len(before)):
        return None, None
    each = (before - after) / (before.mean() - floor)
    half = 0.0
    if len(each) > 1:
        from scipy.special import stdtrit

        half = float(stdtrit(len(each) - 1, 0.975) * each.std(ddof=1) / np.sqrt(len(each)))
    share, low, high = np.clip(each.mean() + half * np.array([0.0, -1.0, 1.0]), 0.0, 1.0).tolist()
    return share, (low, high) if len(each) > 1 else None
