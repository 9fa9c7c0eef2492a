"""Drives of the benchmark: paired over plants, untouched by training, the same each time."""

from __future__ import annotations

import numpy as np
import pytest

from terrafusion.fusion.benchmark.methods import METHODS
from terrafusion.fusion.benchmark.run_score import score_run
from terrafusion.fusion.benchmark.twin_runs import (
    FAMILIES,
    FIRST_SEED,
    LEAD_S,
    PLANTS,
    BenchmarkCase,
    perturbed,
    simulate_case,
    soils_of,
)
from terrafusion.fusion.terrain.external import TRUE_SOURCES
from terrafusion.fusion.training import train_detector as train
from terrafusion.fusion.training.policy_fit import default_grid
from terrafusion.fusion.training.simulated_runs import SOIL_SCATTER
from terrafusion.twin.model.soil import load_soil
from tests.studies import detector_trials as trials
from tests.studies import twin_consistency
from tests.studies.mode_tuning import DRIVES, MIXED

SHORT = BenchmarkCase("outages", "twin", FIRST_SEED + 2)


def test_no_seed_of_training_or_of_scores_while_developing_is_used() -> None:
    most = 1000  # seeds that the commands of policy and detector accept
    trained = [d.seed for d in (*DRIVES, *MIXED)] + [
        max(default_grid(most).seeds),
        train.CALIBRATION_SEED,
        train.SCORING_SEED,
    ]
    scored = [trials.MIXED_RUNS * (train.FRESH_SEED + most), twin_consistency.FIRST_SEED + most, 100_001]
    assert max(*trained, *scored) < FIRST_SEED


def test_the_same_case_gives_the_same_bits() -> None:
    one, other = simulate_case(SHORT), simulate_case(SHORT)
    assert np.array_equal(one.recording.imu.accel_mps2, other.recording.imu.accel_mps2)
    assert np.array_equal(one.recording.truth.position_m, other.recording.truth.position_m)
    assert (one.outage, one.labels) == (other.outage, other.labels)


def test_a_recording_tells_the_estimator_nothing_of_its_ground() -> None:
    terrain = simulate_case(SHORT).recording.terrain
    assert terrain.source in TRUE_SOURCES


def test_plants_drive_the_same_on_other_ground() -> None:
    drives = {plant: simulate_case(BenchmarkCase("outages", plant, FIRST_SEED + 2)) for plant in PLANTS}
    commands = [d.recording.command.v_mps for d in drives.values()]
    assert all(np.array_equal(commands[0], other) for other in commands[1:])
    assert len({d.outage for d in drives.values()}) == 1
    ends = [d.recording.truth.position_m[-1, :2] for d in drives.values()]
    assert min(np.hypot(*(ends[0] - other)) for other in ends[1:]) > 0.1


@pytest.mark.parametrize("family", FAMILIES)
def test_an_outage_follows_the_lead_and_lasts_to_the_end(family: str) -> None:
    drive = simulate_case(BenchmarkCase(family, "twin", FIRST_SEED + 2))
    assert LEAD_S[0] <= drive.outage.start_s <= LEAD_S[1]
    assert drive.outage.seconds in FAMILIES[family].outages_s
    assert drive.recording.duration_s() >= drive.outage.start_s + drive.outage.seconds
    assert set(drive.recording.terrain.label.astype(str)) <= set(FAMILIES[family].grounds)


def test_mixed_drives_change_their_ground_in_the_outage() -> None:
    drive = simulate_case(BenchmarkCase("mixed", "twin", FIRST_SEED))
    terrain = drive.recording.terrain
    inside = drive.outage.covers(terrain.t_ns, drive.recording.start_ns)
    assert len(set(terrain.label[inside].astype(str))) >= 2


def test_a_perturbed_soil_is_thirty_percent_off_in_every_number() -> None:
    soil = load_soil("loose_sand")
    off = perturbed(soil, np.random.default_rng(0))
    for section, keys in SOIL_SCATTER.items():
        for key in keys:
            own, other = (getattr(getattr(one, section), key) for one in (soil, off))
            assert abs(other / own - 1.0) == pytest.approx(0.3)


def test_soils_of_the_twin_stay_in_the_scatter_of_training() -> None:
    for name, soil in soils_of(SHORT, {"mud", "loose_sand"}).items():
        k_phi = load_soil(name).pressure.k_phi_n_per_m_n2
        assert abs(soil.pressure.k_phi_n_per_m_n2 / k_phi - 1.0) <= 0.2 + 1e-9


def test_the_oracle_of_ground_that_the_policy_never_saw_is_right_to_call_it_unknown() -> None:
    drive = simulate_case(BenchmarkCase("unseen", "twin", FIRST_SEED))
    row = score_run(drive, next(arm for arm in METHODS if arm.name == "oracle"))
    assert row is not None
    (ground,) = row.grounds
    assert ground.ground in FAMILIES["unseen"].grounds
    assert ground.recognised == 1.0
