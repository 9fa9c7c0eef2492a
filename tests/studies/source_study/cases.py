"""The study's three runs, driven by the twin: seeds in parallel, the same arrays for each."""

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.analysis.summary import RunSummary
from terrafusion.twin.model.ground import Variation
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.scenario.file import load_scenario
from terrafusion.twin.simulate import simulate_run
from tests.studies.source_study.profiles import OTHERS, Profiles, SpeedErrors, profiles_of, speed_errors
from tests.studies.source_study.published import SCENARIO, VEHICLE, StudyCase

UNEVEN = Variation(strength_sigma=0.2, length_m=0.5)
"""Ground on which left and right wheels differ. Assumed: the study's ground was even, its contacts were not.
Strengths of natural soils vary by 10 to 50 % (Phoon and Kulhawy 1999); the length is about the track."""


@dataclass(frozen=True, eq=False)
class CaseRun:
    """One run of a case, reduced to what the study looks at.

    Attributes:
        case: ground and slope.
        seed: of the sensors' noise and of uneven ground.
        profiles: the study's common arrays.
        errors: the run's row of Tab. 4.
        other_errors: the same under each of `processing.OTHERS`; empty on uneven ground.
        summary: the twin's own account of the run.
        truth_t_s, truth_enu_m: (N,) s and (N, 2) m, true path of the body origin.
        gnss_enu_m: (K, 2) m, positions as the receiver reports them.
    """

    case: StudyCase
    seed: int
    profiles: Profiles
    errors: SpeedErrors
    other_errors: tuple[SpeedErrors, ...]
    summary: RunSummary
    truth_t_s: Array
    truth_enu_m: Array
    gnss_enu_m: Array


def run_case(case: StudyCase, seed: int, variation: Variation | None = None) -> CaseRun:
    """Drive the study's profile with the nominal robot on the case's ground, even or varying."""
    vehicle = load_vehicle(VEHICLE)
    scenario = dataclasses.replace(load_scenario(SCENARIO), variation=variation)
    run = simulate_run(scenario, vehicle=vehicle, terrain=case.terrain, slope_deg=case.slope_deg, seed=seed)
    recording = run.recording
    if recording.truth is None or recording.gnss is None:
        raise ValueError("the twin's recording lacks truth or GNSS")
    radius_m = vehicle.odometry.wheel_radius_m
    profiles = profiles_of(recording, radius_m)
    others = OTHERS if variation is None else ()
    return CaseRun(
        case=case,
        seed=seed,
        profiles=profiles,
        errors=speed_errors(profiles),
        other_errors=tuple(speed_errors(profiles_of(recording, radius_m, other)) for other in others),
        summary=run.summary,
        truth_t_s=np.asarray((recording.truth.t_ns - recording.start_ns) * 1e-9),
        truth_enu_m=recording.truth.position_m[:, :2],
        gnss_enu_m=recording.gnss.enu_m[:, :2],
    )


def set_off_s(run: CaseRun) -> float:
    """When the robot first moves, s."""
    return float(run.profiles.t_s[np.argmax(run.profiles.moving())])


def stopped_s(run: CaseRun) -> float:
    """When it stops for good, s; the end of the run where it does not."""
    at = run.summary.immobilised_at_s
    return float(run.profiles.t_s[-1]) if at is None else at


def between(run: CaseRun, start_s: float, end_s: float) -> NDArray[np.bool_]:
    """Samples (N,) of the run's arrays in [start_s, end_s)."""
    return (run.profiles.t_s >= start_s) & (run.profiles.t_s < end_s)
