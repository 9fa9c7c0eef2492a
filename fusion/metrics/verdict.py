"""The verdict on a run: good, doubtful or not to be used, with its reasons and what to do about each.

Tests of what the run itself shows, most of them chi-square tests of its errors or innovations against its
own covariance. The limits are constants below; docs/reference/verdict.md lists the rules.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.checks import CheckContext
from terrafusion.datasets.checks.motion import runs
from terrafusion.datasets.checks.path import scales
from terrafusion.datasets.checks.scale import SMALL, is_firm
from terrafusion.datasets.core.channels import Gnss
from terrafusion.datasets.core.sensors import NO_SIGMA
from terrafusion.fusion.estimate.estimate import JUMPED, STATUS, Innovation
from terrafusion.fusion.metrics.consistency import ALL, CONFIDENCE, Consistency
from terrafusion.fusion.metrics.error_series import MIN_STEP_M, Errors, known_keyframes, travelled_m
from terrafusion.fusion.metrics.health import examine_estimate
from terrafusion.fusion.metrics.judged_run import (
    DOUBTFUL,
    FIVE_SIGMA,
    GOOD,
    STRAY_SHARE,
    UNUSABLE,
    Reason,
    Run,
    doubtful,
    gnss_innovations,
    since_s,
)
from terrafusion.fusion.metrics.verdict_of_numbers import (
    delayed,
    log_checks,
    misplaced_truth,
    refuted,
    unconfirmed_imu,
    unknown_wheelbase,
)

WORDS = {GOOD: "good", DOUBTFUL: "doubtful", UNUSABLE: "not to be used"}

FAR_M, FAR_SHARE = 10.0, 0.05
"""An error of more than 10 m is never good; if it is also more than this share of the distance, plain dead
reckoning is usually no worse."""
SIGMA_RATIO = 2.0
"""A sigma is called too small if the errors, after allowing for chance, still show it this many times too
small: a factor that matters to whoever uses it."""
OUTAGE_NS = 2_000_000_000
"""A fix this old no longer carries the position, as for the status."""
FAR_STEP = 6.0
"""Sigmas of fixes between the corners of their path, whose length their noise would else increase."""
NIS_95 = 5.991
"""Chi-square quantile of 95 % for 2 degrees of freedom."""
GATE_NIS = 13.816
"""Chi-square quantile of 99.9 % for 2 degrees of freedom: the gate of the fixes."""
SIGNIFICANT_Z = 3.0
"""Standard errors by which a share must exceed its expectation."""
IN_A_ROW = 5
"""Fixes beyond the gate one after the other from which on they are no outliers but contradict: the chance of
it, at a gate of 99.9 %, is 1e-15 for independent errors."""
JUMP_FIXES, SAME_OFFSET, JUMP_NS = 1, 0.25, 1_000_000_000
"""Fixes rejected at one offset, within this share of it, before one is followed there; and the time after
which the status tells of it."""
FAR_BELOW = 0.3  # innovations over their sigma below which a sigma that no fix reports may be far too large
REJECTED_SHARE, MOST_REJECTED = 0.1, 0.5
"""Shares of fixes rejected beyond which the estimate rests on few of them, and on the minority."""
CLEARLY_WORSE, CLEARLY_M, FAR_WORSE, FAR_WORSE_M = 1.5, 0.1, 2.0, 0.5
"""Ratio and difference of errors from which on an estimate is called worse than a baseline: the first pair
where its covariance does not allow the errors, the second where it does (slow errors of a receiver can favour
dead reckoning by chance on a short drive)."""
LEAST_OUTAGES = 5
"""So many outages, all worse than dead reckoning, are no chance (1 in 32)."""
MOST_PATH_RATIO = 2.0
"""Estimated over rolled path that no wrong radius explains (assumed): fixes have moved the estimate about."""
SIGMA_KNOWN_M, YAW_SIGMA_KNOWN_RAD = 10.0, 0.5
"""Position and heading are unknown for navigation beyond these 1 sigmas."""


@dataclass(frozen=True)
class Verdict:
    """`value` is "good", "doubtful" or "not_to_be_used"; `reasons` are sentences, the gravest first."""

    value: str
    reasons: tuple[str, ...]

    def words(self) -> str:
        """The value as people write it."""
        return WORDS[self.value]

    def lines(self) -> list[str]:
        """The verdict as lines of text."""
        return [f"verdict: {self.words()}", *(f"  {reason}" for reason in self.reasons)]


def judge(run: Run) -> Verdict:
    """The verdict on a run: the gravest of its reasons; if there are none, on what `good` rests."""
    reasons = list(misplaced_truth(run)) or [reason for test in TESTS for reason in test(run)]
    for value in (UNUSABLE, DOUBTFUL):
        if any(reason[0] == value for reason in reasons):
            ordered = sorted(reasons, key=lambda reason: reason[0] != UNUSABLE)
            return Verdict(value, tuple(_sentence(text) for _, text in ordered))
    return Verdict(GOOD, tuple(map(_sentence, _supports(run))))


def _sound(run: Run) -> Iterator[Reason]:
    wheels = run.recording.wheels
    if wheels is None or not len(run.estimate.trajectory):
        return
    health = examine_estimate(run.estimate, wheels, run.rig.wheel_radius_m)
    if not health.why:
        return
    ratio = health.path_ratio()
    # A path a little too long for the wheels may still be right: then it is the radius that is not.
    mild = ratio is not None and ratio < MOST_PATH_RATIO and "path" in health.why
    yield (
        DOUBTFUL if mild else UNUSABLE,
        f"the estimate is not plausible: {health.why}; check wheel radius, fixes and stamps with "
        "`terrafusion inspect`",
    )


def _started(run: Run) -> Iterator[Reason]:
    status = run.estimate.status.astype(str)
    if not len(status):
        return
    if status[-1] in ("waiting", "aligning"):
        yield UNUSABLE, f"the estimator never started: {STATUS[status[-1]]}; use a longer drive"
    elif run.used is not None and len(run.used) and (status == "no_gnss").all():
        yield (
            UNUSABLE,
            "the fixes never placed the path: its start and heading are arbitrary; use a longer drive, or "
            "look at the fixes with `terrafusion inspect`",
        )


def _error(run: Run) -> Iterator[Reason]:
    ate, travelled = _error_m(run), run.estimate.trajectory.path_length_m()
    if ate is None or ate <= FAR_M:
        return
    share = 100.0 * ate / max(travelled, 1e-9)
    value = UNUSABLE if ate > FAR_SHARE * travelled else DOUBTFUL
    yield (
        value,
        f"the position error is {ate:.1f} m RMS against {_reference(run)}, {share:.0f} % of the distance; "
        "check vehicle file and log with `terrafusion inspect`",
    )


def _outages(run: Run) -> Iterator[Reason]:
    for outage in run.scores.outages:
        end = outage.end_error_m
        if end is not None and end > FAR_M:
            share = f", {outage.percent:.0f} % of the distance" if outage.percent is not None else ""
            yield doubtful(
                f"{outage.seconds:g} s without GNSS from {outage.start_s:g} s on end {end:.1f} m off{share}; "
                "expect as much wherever fixes are missing for so long"
            )


def _five_sigma(run: Run) -> Iterator[Reason]:
    errors = run.scores.errors
    if errors is None:
        return
    square = 2.0 * errors.nees()
    known = np.isfinite(square)
    beyond = known & (square > FIVE_SIGMA)
    share = beyond.sum() / max(known.sum(), 1)
    if share <= STRAY_SHARE:
        return
    worst = int(np.argmax(np.where(beyond, errors.distance_m(), -1.0)))
    off_m = float(errors.distance_m()[worst])
    travelled = run.estimate.trajectory.path_length_m()
    value = UNUSABLE if share > 0.5 and off_m > min(FAR_M, FAR_SHARE * travelled) else DOUBTFUL
    yield (
        value,
        f"the error exceeds five times its own sigma {100.0 * share:.0f} % of the time, up to {off_m:.1f} m "
        f"at {since_s(run, int(errors.t_ns[worst])):.0f} s: "
        + (
            _other_slip(run, errors, worst)
            or "sigma is wrong there; compare vehicle file, IMU mounting and stamps with the log "
            "(`terrafusion inspect`)"
        ),
    )


def _other_slip(run: Run, errors: Errors, worst: int) -> str:
    """How slip explains at least half of the error at row `worst` after a time without fixes; else ""."""
    t_ns = errors.t_ns
    fixes_ns = np.zeros(0, dtype=np.int64) if run.used is None else run.used.t_ns
    before_ns = fixes_ns[fixes_ns <= t_ns[worst]]
    if not len(before_ns) or t_ns[worst] - before_ns[-1] < OUTAGE_NS:
        return ""
    rows = (t_ns >= before_ns[-1]) & (t_ns <= t_ns[worst])
    step_m = max(MIN_STEP_M, 0.0 if run.scores.against == "truth" else FAR_STEP * _fix_sigma_m(run.used))
    moved, ours = (travelled_m(p[rows], step_m)[-1] for p in (errors.reference_m, errors.estimate_m))
    if abs(ours - moved) < 0.5 * errors.distance_m()[worst]:
        return ""
    return (
        f"without fixes from {since_s(run, int(before_ns[-1])):.0f} s on the robot moved {moved:.1f} m, the "
        f"estimate {ours:.1f} m: the wheels slipped {'more' if ours > moved else 'less'} than on the ground "
        "before; drive such ground with fixes, too, and keep what it shows (`replay --grounds`)"
    )


def _nees(run: Run) -> Iterator[Reason]:
    row = _row(run, "position")
    if row is not None and row.mean > SIGMA_RATIO**2 * row.high:
        yield doubtful(
            f"position errors are {row.mean**0.5:.1f} times their sigma (NEES {row.mean:.1f} per dimension, "
            f"at most {row.high:.1f} expected): do not rely on sigma"
        )


def _worse_than_a_baseline(run: Run) -> Iterator[Reason]:
    ours, row = run.scores.ate_m, _row(run, "position")
    alone = [("plain dead reckoning", run.baselines.dead_reckoning_m)]
    if run.scores.against == "truth":  # held-out fixes are the receiver itself
        alone.append(("the receiver alone", run.baselines.gnss_m))
    for name, theirs in alone:
        if ours is None or theirs is None:
            continue
        promised = row is None or row.mean <= row.high
        ratio, more_m = (FAR_WORSE, FAR_WORSE_M) if promised else (CLEARLY_WORSE, CLEARLY_M)
        if ours > ratio * theirs and ours - theirs > more_m:
            why = (
                "within its sigma, but without good fixes slip and heading are only as usual for such robots"
                if promised
                else "a sensor or a number of the vehicle file misleads it; see `terrafusion inspect`"
            )
            yield doubtful(f"{name} has an error of {theirs:.2f} m, the estimate {ours:.2f} m: {why}")
    yield from _worse_in_outages(run)


def _worse_in_outages(run: Run) -> Iterator[Reason]:
    ends = [
        (outage.end_error_m, baseline.dead_reckoning_m)
        for outage, baseline in zip(run.scores.outages, run.baselines.outages, strict=False)
        if outage.end_error_m is not None and baseline.dead_reckoning_m is not None
    ]
    if len(ends) < LEAST_OUTAGES:
        return
    from scipy.stats import binom

    ours, theirs = np.array(ends).T
    # One-sided sign test: of n outages, k or more lost by chance.
    lost = int((ours > theirs).sum())
    chance = float(binom.sf(lost - 1, len(ends), 0.5))
    if chance < 1.0 - CONFIDENCE and np.median(ours) > CLEARLY_WORSE * np.median(theirs):
        yield doubtful(
            f"plain dead reckoning is nearer at the end of {lost} of {len(ends)} outages, "
            f"{np.median(theirs):.2f} m for {np.median(ours):.2f} m: "
            "wheels or gyro are weighted wrongly; see `terrafusion calibrate`"
        )


def _certain(run: Run) -> Iterator[Reason]:
    known, _ = known_keyframes(run.estimate)
    path = known.trajectory
    if path.covariance is None or not len(path):
        return
    sigma = np.sqrt(np.maximum(path.covariance[:, 0, 0], path.covariance[:, 1, 1]))
    k = int(np.nanargmax(sigma)) if np.isfinite(sigma).any() else 0
    limit_m = max(SIGMA_KNOWN_M, 3.0 * _fix_sigma_m(run.used))
    if sigma[k] > limit_m:
        yield doubtful(
            f"the position is known to {sigma[k]:.0f} m only (1 sigma) at "
            f"{since_s(run, int(path.t_ns[k])):.0f} s: without fixes the uncertainty grows"
        )
    yaw_sigma = float(np.sqrt(path.covariance[-1, 5, 5]))
    if yaw_sigma > YAW_SIGMA_KNOWN_RAD:
        why = "drive on" if run.used else "without fixes nothing corrects it"
        yield doubtful(f"the heading is unknown at the end: {np.degrees(yaw_sigma):.0f} deg (1 sigma); {why}")


def _innovations(run: Run) -> Iterator[Reason]:
    row, fixes = _row(run, "nis gnss"), gnss_innovations(run)
    if row is None or not fixes:
        return
    share = float(np.mean([i.nis > NIS_95 for i in fixes]))
    expected = 1.0 - CONFIDENCE
    spread = np.sqrt(expected * CONFIDENCE / max(row.effective, 1.0))
    if share > 2.0 * expected and share > expected + SIGNIFICANT_Z * spread and row.mean > row.high:
        yield doubtful(
            f"GNSS innovations are {row.mean**0.5:.1f} times what their sigmas allow, {100.0 * share:.0f} % "
            "of them beyond the 95 % bound: sigmas too small, a late receiver, or wrong wheels or IMU; "
            "try `terrafusion inspect`"
        )


def _rejections(run: Run) -> Iterator[Reason]:
    fixes = gnss_innovations(run)
    if not fixes:
        return
    rejected = [not i.accepted for i in fixes]
    share = sum(rejected) / len(fixes)
    if share > REJECTED_SHARE:
        yield (
            UNUSABLE if share > MOST_REJECTED and run.scores.against != "truth" else DOUBTFUL,
            f"{100.0 * share:.0f} % of the fixes were rejected: they contradict wheels and IMU; check "
            "sigmas, stamps and axes with `terrafusion inspect`",
        )
    # The fix that ends a run of rejected ones belongs to it where the estimate gives in to it.
    against = [
        not i.accepted or (k > 0 and rejected[k - 1] and i.nis > GATE_NIS) for k, i in enumerate(fixes)
    ]
    begins, ends = runs(np.array(against))
    spans = zip(begins.tolist(), ends.tolist(), strict=True)
    first, end = max(spans, key=lambda span: span[1] - span[0], default=(0, 0))
    if end - first < IN_A_ROW:
        yield from _followed(run, fixes)
        return
    part = fixes[first:end]
    size = float(np.median([np.hypot(*i.value[:2]) for i in part]))
    if part[-1].accepted:
        then = ", which then moved to them"
    else:
        then = f", until {since_s(run, fixes[end].t_ns):.0f} s" if end < len(fixes) else ", to the end"
    what = ": either they or the estimate are wrong there"
    if any(i.reason == JUMPED for i in part):
        what = ": they jumped there as no robot moves (a wrong ambiguity or a reflected signal, say)" + (
            "; either they are wrong after it, or those before it"
            if part[-1].accepted
            else " and were held off"
        )
    yield doubtful(
        f"{end - first} fixes in a row from {since_s(run, part[0].t_ns):.0f} s on lie {size:.1f} m off the "
        f"estimate{then}{what}"
    )


def _followed(run: Run, fixes: list[Innovation]) -> Iterator[Reason]:
    """Fixes that jumped to one side, stayed there, and were followed, with the status doubtful."""
    t_ns, status = run.estimate.trajectory.t_ns, run.estimate.status.astype(str)
    for k in range(JUMP_FIXES, len(fixes)):
        *before, one = fixes[k - JUMP_FIXES : k + 1]
        if not one.accepted or any(i.accepted for i in before):
            continue
        off = np.array([i.value[:2] for i in (*before, one)])
        size = float(np.hypot(*off.mean(axis=0)))
        after = (t_ns >= one.t_ns) & (t_ns <= one.t_ns + JUMP_NS)
        if np.hypot(*(off - off[0]).T).max() > SAME_OFFSET * size or not (status[after] == "doubtful").any():
            continue
        yield doubtful(
            f"the fixes jumped by {size:.1f} m at {since_s(run, before[0].t_ns):.0f} s, stayed there and "
            "were followed: a skid between two fixes, or a wrong fix; the log does not show which"
        )
        return


def _path_ratio(run: Run) -> Iterator[Reason]:
    found = scales(CheckContext(run.recording, run.rig))
    if not found or not is_firm(run.recording):
        return
    scale, _ = min(found, key=lambda both: both[0].high - both[0].low)
    if scale.high < SMALL:
        yield doubtful(
            f"the robot moved {scale.ratio:.2f} of the path of its wheels by the {scale.source}, on ground "
            "that is not known to be soft: check wheel radius and unit, unless it slipped"
        )


def _unchecked(run: Run) -> Iterator[Reason]:
    if run.scores.against is not None or gnss_innovations(run):
        return
    missing = _disagreement(run)
    if missing:
        yield doubtful(
            f"nothing to check the path against: no GNSS, no truth, and {missing}; record one of them"
        )


def _disagreement(run: Run) -> str:
    """Why wheels, gyro and accelerometer cannot vouch for each other; "" where they do."""
    imu, wheels = run.recording.imu, run.recording.wheels
    if imu is None or wheels is None or not imu.has_accel() or not np.isfinite(imu.gyro_radps[:, 2]).any():
        return "no complete IMU"
    if not wheels.has_sides():
        return "wheels that do not show turns"
    rows = [i for i in run.estimate.innovations if i.sensor == "wheels"]
    if not rows or np.mean([not i.accepted for i in rows]) > REJECTED_SHARE:
        return "wheels and IMU disagree"
    slipping = run.estimate.slipping
    if slipping is not None and slipping.mean() > REJECTED_SHARE:
        return f"the wheels slipped {100.0 * slipping.mean():.0f} % of the time"
    return ""


TESTS = (
    _sound, _started, _error, _outages, _five_sigma, _nees, _worse_than_a_baseline, _certain, _innovations,
    _rejections, delayed, refuted, unconfirmed_imu, unknown_wheelbase, _path_ratio, log_checks, _unchecked,
)  # fmt: skip


def _supports(run: Run) -> Iterator[str]:
    """On what a good verdict rests."""
    scores = run.scores
    row = _row(run, "position")
    if scores.ate_m is not None:
        covered = "" if row is None else f", {row.mean**0.5:.1f} times sigma"
        yield f"the position error is {scores.ate_m:.2f} m RMS against {_reference(run)}{covered}"
    elif not gnss_innovations(run):
        yield "nothing to check against but the agreement of wheels, gyro and accelerometer"
    fixes = gnss_innovations(run)
    if used := [i.nis / i.dof for i in fixes if i.accepted]:
        left_out = (
            f"; {len(fixes) - len(used)} of {len(fixes)} were rejected" if len(used) < len(fixes) else ""
        )
        yield (
            f"fixes agree with wheels and IMU: innovations are {np.mean(used) ** 0.5:.1f} times their sigma"
            f"{left_out}"
        )
        if np.mean(used) ** 0.5 < FAR_BELOW and any(NO_SIGMA in note for note in run.recording.notes):
            yield (
                f"the fixes report no sigma, and {_fix_sigma_m(run.used):g} m is taken for it: if the "
                "receiver is better, give its `gnss_sigma_m` in the vehicle file"
            )


def _error_m(run: Run) -> float | None:
    """RMS against truth; of held-out fixes, some of which may be wild, the RMS that their median implies."""
    held = run.scores.held_out
    if run.scores.against == "gnss_held_out" and held is not None:
        return held.median_m / float(np.sqrt(np.log(2.0)))  # of two equal Gaussian errors
    return run.scores.ate_m


def _reference(run: Run) -> str:
    return "the ground truth" if run.scores.against == "truth" else "the held-out fixes"


def _row(run: Run, quantity: str) -> Consistency | None:
    rows = (row for row in run.scores.consistency if row.quantity == quantity and row.terrain == ALL)
    return next(rows, None)


def _fix_sigma_m(used: Gnss | None) -> float:
    sigma = np.zeros(0) if used is None else used.sigma_enu_m[:, :2].max(axis=1)
    sigma = sigma[np.isfinite(sigma)]
    return float(np.median(sigma)) if len(sigma) else 0.0


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}{'' if text[-1] in '.?!' else '.'}"
