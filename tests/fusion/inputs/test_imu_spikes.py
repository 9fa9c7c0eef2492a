"""IMU samples that no wheeled robot makes: held, unless most are like that."""

from __future__ import annotations

import dataclasses

import gtsam
import numpy as np
import pytest

from terrafusion.datasets.core.channels import Imu
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import ImuSpec
from terrafusion.fusion.estimate.estimate import Estimate
from terrafusion.fusion.graph.preintegration import HELD_INFLATION, Preintegrator
from terrafusion.fusion.inputs.streams import REPLACED_BY, SHOCK_MPS2, SPIN_RADPS, ImuStream
from terrafusion.fusion.noise.policy import load_policy
from terrafusion.fusion.replay import ReplayResult, replay
from terrafusion.twin.model.vehicle import load_vehicle
from tests.fusion.estimator.test_gnss import winding

STEP_NS = 10_000_000
LEVEL = np.array([0.0, 0.0, 9.8])
SPIKE = np.array([140.0, -140.0, 0.0])


def stream(spiked: dict[int, np.ndarray], count: int = 100) -> ImuStream:
    """Samples that tell their number in gyro x, with `spiked` forces added to some."""
    imu = ImuStream()
    for i in range(count):
        number = np.array([1e-3 * i, 0.0, 0.0])
        imu.add(i * STEP_NS, number, LEVEL + number + spiked.get(i, np.zeros(3)))
    return imu


def test_the_samples_before_stand_for_spikes_and_nothing_else_changes() -> None:
    plain, spiked = stream({}), stream({60: SPIKE, 61: -SPIKE})
    assert (plain.spikes, spiked.spikes) == (0, 2)
    for i in range(1, 100):
        (a,), (b,) = (s.segments((i - 1) * STEP_NS, i * STEP_NS) for s in (plain, spiked))
        if i in (60, 61):
            assert b.accel_mps2 == pytest.approx([1e-3 * (i - 0.5 - 0.5 * REPLACED_BY), *LEVEL[1:]], abs=1e-3)
        else:
            assert b.accel_mps2.tolist() == a.accel_mps2.tolist()
        assert b.gyro_radps.tolist() == a.gyro_radps.tolist()
        assert (a.accel_held, b.accel_held) == (False, i in (60, 61))
        assert not b.gyro_held


@pytest.mark.parametrize(("gyro", "beyond"), [(0.99 * SPIN_RADPS, False), (-1.01 * SPIN_RADPS, True)])
def test_a_rate_is_held_by_itself(gyro: float, beyond: bool) -> None:
    imu = stream({}, 50)
    imu.add(50 * STEP_NS, [0.0, 0.0, gyro], LEVEL + 1.0)
    assert imu.spikes == beyond
    assert imu.gyro[-1] == pytest.approx(
        [1e-3 * (49.5 - 0.5 * REPLACED_BY), 0, 0] if beyond else [0, 0, gyro]
    )
    assert imu.accel[-1].tolist() == (LEVEL + 1.0).tolist()


def test_what_most_samples_say_is_believed() -> None:
    always = dict.fromkeys(range(200), SPIKE)
    assert stream(always, 200).spikes == 0
    from_100 = stream(dict.fromkeys(range(100, 200), SPIKE), 200)
    assert 0 < from_100.spikes < 30
    assert from_100.accel[-1][0] > SHOCK_MPS2


def test_a_held_sample_makes_what_its_sensor_tells_less_certain_and_nothing_else() -> None:
    spec: ImuSpec = load_vehicle("elevate").rig().sensors.imu
    row, bias = load_policy().fixed, gtsam.imuBias.ConstantBias()

    def sigmas(spin_radps: float, force_mps2: np.ndarray) -> np.ndarray:
        """Of rotation about z and velocity along x, with one sample of ten beyond belief."""
        imu = stream({}, 60)
        for i in range(60, 100):
            extra = float(i == 60)
            imu.add(i * STEP_NS, [0.0, 0.0, extra * spin_radps], LEVEL + extra * force_mps2)
        P = Preintegrator(spec).integrate(imu.segments(55 * STEP_NS, 65 * STEP_NS), bias, row).preintMeasCov()
        return np.sqrt(np.diag(P)[[2, 6]])

    plain = sigmas(0.0, 0.0 * SPIKE)
    assert sigmas(0.0, SPIKE) == pytest.approx(plain * [1.0, HELD_INFLATION], rel=0.1)
    assert sigmas(20.0, 0.0 * SPIKE) == pytest.approx(plain * [HELD_INFLATION, 1.0], rel=0.1)


@pytest.fixture(scope="module")
def runs() -> tuple[ReplayResult, ReplayResult]:
    drive: Recording = winding()
    imu = drive.imu
    assert imu is not None
    accel = imu.accel_mps2.copy()
    accel[1500:1502, :2] += 140.0
    spiked = dataclasses.replace(drive, imu=Imu(imu.t_ns, imu.gyro_radps, accel))
    return replay(drive), replay(spiked)


def test_two_samples_of_140_mps2_hardly_move_the_state(runs: tuple[ReplayResult, ReplayResult]) -> None:
    plain, spiked = (run.estimate for run in runs)

    def moved(read: str) -> float:
        a, b = (read_of(estimate, read) for estimate in (plain, spiked))
        return float(np.linalg.norm(a - b, axis=1).max())

    assert moved("position") < 0.02
    assert moved("velocity") < 0.05


def read_of(estimate: Estimate, what: str) -> np.ndarray:
    path = estimate.trajectory
    if what == "position":
        return path.position_m
    assert path.twist_body is not None
    return path.twist_body[:, :3]


def test_the_run_says_what_it_did_not_believe(runs: tuple[ReplayResult, ReplayResult]) -> None:
    plain, spiked = (" ".join(run.estimate.notes) for run in runs)
    assert "2 IMU samples beyond" in spiked
    assert "IMU samples beyond" not in plain
