"""States that vary from run to run: what is assumed of them where no reference shows it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.diagnose import diagnose
from terrafusion.twin.gap.rollout.residuals import OFFSET_SIGMAS, initial_state_sigma
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.simulate import simulate

CANDIDATES = Candidates.of(["accel_bias", "gyro_bias"])


@pytest.mark.parametrize("vehicle", ["elevate", "warthog", "generic"])
def test_offsets_are_at_least_what_the_vehicle_file_says(vehicle: str) -> None:
    imu = load_vehicle(vehicle).sensors.imu
    sigma = initial_state_sigma(CANDIDATES, imu)
    found = sigma[-4 - len(OFFSET_SIGMAS) : -4] * [*OFFSET_SIGMAS.values()]  # then four of the currents
    sheet = [imu.gyro_bias_sigma_radps, imu.accel_bias_sigma_mps2, imu.accel_bias_sigma_mps2]
    assert found == pytest.approx(np.maximum(sheet, [*OFFSET_SIGMAS.values()]))
    assert (sigma[-4:] == 1.0).all()


def test_without_references_an_imu_of_coarse_offsets_is_no_gap() -> None:
    runs = [
        dataclasses.replace(
            simulate("figure_eight", vehicle="warthog", terrain="grass", seed=seed), truth=None
        )
        for seed in (1, 2)
    ]
    runs = [dataclasses.replace(run, truth_channels=()) for run in runs]
    found = diagnose(runs, [], load_vehicle("warthog"), "grass", jobs=1).to_json()
    assert found["verdict"] == "no_gap"
