"""Everything the claims are held against: one spread over the seeds for each measured quantity."""

import math
from collections.abc import Iterable, Mapping, Sequence

from tests.studies.source_study import measures
from tests.studies.source_study.batch import (
    SLIP_SLOPE_DEG,
    BatchResult,
    least_growth,
    share_of_pairs,
    slip_cost,
    steepening,
)
from tests.studies.source_study.cases import CaseRun
from tests.studies.source_study.field_drive import FieldDrive, field_measures
from tests.studies.source_study.gnss_noise import NoiseFit, NoisyRun, least_ratio
from tests.studies.source_study.published import CASES, FRICTION, platform_figures
from tests.studies.source_study.spread import Spread, spread

Runs = Mapping[str, Sequence[CaseRun]]
Quantities = dict[str, Spread]


def case_quantities(runs: Runs, flat: Runs) -> Quantities:
    """Tab. 4 and Figs. 4 to 9; keys such as `mud.odometry`."""
    found: Quantities = {}
    for terrain, of in runs.items():
        for name in ("slip", "odometry", "imu", "gnss"):
            found[f"{terrain}.{name}"] = spread(getattr(run.errors, name) for run in of)
        found |= _many(f"{terrain}.imu_drift", map(measures.imu_drift_mps, of))
        found |= _many(f"{terrain}.way", map(measures.path_errors_percent, of))
    mud, loose, medium = (runs[case.terrain] for case in CASES)
    found["mud.stopped_after"] = spread(map(measures.stopped_after_s, mud))
    found |= _many("mud.until_stop", map(measures.follows_until_stop, mud))
    found |= _many("mud.after_stop", map(measures.speed_after_stop_mps, mud))
    found["mud.slip_rise"] = spread(map(measures.slip_rise_s, mud))
    found["mud.imu_sees_stop"] = spread(map(measures.imu_sees_stop, mud))
    found["loose_sand.least_lag"] = spread(min(measures.lags_percent(run)) for run in loose)
    found["medium_sand.most_lag"] = spread(max(measures.lags_percent(run)) for run in medium)
    found["loose_sand.keeps_moving"] = spread(map(measures.keeps_moving_percent, loose))
    found |= _many("medium_sand.linearity", map(measures.linearity, medium))
    found |= _many("medium_sand.gnss_rtk", (measures.gnss_quality(run.profiles) for run in medium))
    added = [measures.slope_adds(a, b) for a, b in zip(loose, flat["loose_sand"], strict=True)]
    found |= _many("loose_sand.slope_adds", added)
    return found | _ratios(runs, added)


def uneven_quantities(uneven: Runs) -> Quantities:
    """The three runs on uneven ground: slip, the stop, stalls, and yaw rates (Figs. 6 to 8)."""
    mud, loose, medium = (uneven[case.terrain] for case in CASES)
    found: Quantities = {
        "mud.uneven.stopped_after": spread(map(measures.stopped_after_s, mud)),
        "mud.uneven.slip_swings": spread(map(measures.slip_swings, mud)),
        "loose_sand.uneven.short_stalls": spread(map(measures.short_stalls, loose)),
    }
    yaw = {terrain: [measures.yaw_rates_radps(run) for run in of] for terrain, of in uneven.items()}
    for terrain, of in uneven.items():
        found[f"{terrain}.uneven.slip"] = spread(run.errors.slip for run in of)
        found |= _many(f"{terrain}.uneven.yaw", yaw[terrain])
    driving = {terrain: [of["driving"] for of in yaw[terrain]] for terrain in yaw}
    after = [of["after"] for of in yaw["mud"]]
    found["mud.uneven.yaw.driving_over_after"] = _quotients(driving["mud"], after)
    found["sand.uneven.yaw.loose_over_medium"] = _quotients(
        driving[loose[0].case.terrain], driving[medium[0].case.terrain]
    )
    return found


def _ratios(runs: Runs, added: Sequence[Mapping[str, float]]) -> Quantities:
    """Quotients of two quantities, taken seed by seed."""
    _, loose, medium = (runs[case.terrain] for case in CASES)
    drifts = [measures.imu_drift_mps(run) for run in (*loose, *medium)]
    return {
        "sand.acceleration.loose_over_medium": _quotients(
            map(measures.accelerations_mps2, loose), map(measures.accelerations_mps2, medium)
        ),
        "sand.slip.loose_over_medium": _quotients(
            (run.errors.slip for run in loose), (run.errors.slip for run in medium)
        ),
        "sand.odometry.loose_over_medium": _quotients(
            (run.errors.odometry for run in loose), (run.errors.odometry for run in medium)
        ),
        "medium_sand.imu_over_odometry": _quotients(
            (run.errors.imu for run in medium), (run.errors.odometry for run in medium)
        ),
        "loose_sand.odometry_over_others": _quotients(
            (run.errors.odometry for run in loose), (max(run.errors.imu, run.errors.gnss) for run in loose)
        ),
        "loose_sand.slope_adds.falling_over_rising": _quotients(
            (of["falling"] for of in added), (of["rising"] for of in added)
        ),
        "sand.imu_drift.last_over_first": _quotients(
            (drift["last"] for drift in drifts), (drift["first"] for drift in drifts)
        ),
    }


def noise_quantities(
    fits: Sequence[NoiseFit], noisy: Mapping[str, Sequence[NoisyRun]], rate_hz: float
) -> Quantities:
    """GNSS with the one Gaussian noise that comes closest to the study's errors, at one rate."""
    fit = next(fit for fit in fits if fit.rate_hz == rate_hz)
    wanted = {case.terrain: case.gnss for case in CASES}
    found: Quantities = {"gnss.noise.worst_factor": spread([min(f.worst_factor(wanted) for f in fits)])}
    ratio = least_ratio(noisy["loose_sand"], noisy["medium_sand"], fit.common_m)
    found["gnss.noise.loose_over_medium"] = spread([ratio])
    for terrain, of in noisy.items():
        found[f"{terrain}.gnss_gaussian"] = spread(run.error(fit.common_m) for run in of)
    medium = (measures.gnss_quality(run.noisy(fit.common_m)) for run in noisy["medium_sand"])
    return found | _many("medium_sand.gnss_gaussian", medium)


def batch_quantities(batch: Sequence[BatchResult], over_slip: Sequence[BatchResult]) -> Quantities:
    """Tab. 3 and energy a metre."""
    mud = [r for r in batch if r.cell.terrain == "mud"]
    nominal = [r for r in batch if r.cell.slope_deg == SLIP_SLOPE_DEG and r.cell.payload_kg == 0.0]
    on = {(r.cell.terrain, r.cell.friction): r for r in nominal}
    medium = [r.slip for (terrain, _), r in on.items() if terrain == "medium_sand"]
    numbers = {
        "mud.not_mobile": 100.0 * sum(not r.mobile for r in mud) / len(mud),
        "medium_sand.most_slip": max(medium),
        "batch.less_friction_more_slip": share_of_pairs(batch, "friction", _less_friction_slips_more),
        "loose_sand.slip.friction_factor": _friction_factor(on, "loose_sand"),
        "energy.slope_growth": least_growth(batch, "slope_deg"),
        "energy.payload_growth": least_growth(batch, "payload_kg"),
        "energy.steepening.slip_ratio": steepening(over_slip, "slip_ratio"),
        "energy.steepening.slip": steepening(over_slip, "slip"),
        "energy.slip_cost": slip_cost(over_slip),
    }
    return {name: spread([value]) for name, value in numbers.items()}


def field_quantities(drives: Sequence[FieldDrive]) -> Quantities:
    """Figs. 11 to 15."""
    return _many("field", map(field_measures, drives))


def platform_quantities() -> Quantities:
    """Tab. 1 and 2 and the profile: how many figures differ."""
    return {"platform.differences": spread([float(sum(not figure.same for figure in platform_figures()))])}


def _friction_factor(on: Mapping[tuple[str, float], BatchResult], terrain: str) -> float:
    """Slip at the low end of a terrain's friction range over that at the high end."""
    low, high = FRICTION[terrain]
    return on[terrain, low].slip / on[terrain, high].slip


def _less_friction_slips_more(lower: BatchResult, higher: BatchResult) -> bool:
    """Whether the run with the lower friction slips more, or does not get on at all."""
    if lower.mobile != higher.mobile:
        return higher.mobile
    return not lower.mobile or lower.slip > higher.slip


def _many(prefix: str, found: Iterable[Mapping[str, float]]) -> Quantities:
    """Spreads of quantities that a function measures together."""
    each = list(found)
    return {f"{prefix}.{name}": spread(one[name] for one in each) for name in each[0]}


def _quotients(upper: Iterable[float], lower: Iterable[float]) -> Spread:
    return spread(a / b if b else math.nan for a, b in zip(upper, lower, strict=True))
