"""Drives of the twin by many robots on many soils: `drive(seed)` draws robot, soil, commands and sensors."""

from __future__ import annotations

import dataclasses

import numpy as np

from terrafusion.datasets.core.errors import ConfigError, TerrafusionError
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.model.soil import SoilParams, load_soil
from terrafusion.twin.model.vehicle import VehicleParams, load_vehicle
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate_run

ROBOTS = ("elevate", "generic", "husky", "pathfinder", "warthog")
SOILS = ("asphalt", "gravel", "grass", "medium_sand", "loose_sand", "mud", "ploughed_soil", "snow", "ice")
SECONDS = 60.0
RATES_HZ = (20.0, 30.0, 50.0, 100.0)
WHEEL_HZ = (5.0, 10.0, 20.0, 50.0)


@dataclasses.dataclass(frozen=True, eq=False)
class PopulationDrive:
    """A simulated drive, its robot type and soil, and the odometry geometry that a user would enter."""

    seed: int
    robot: str
    soil: str
    recording: Recording
    wheel_radius_m: float
    track_m: float


def drive(seed: int) -> PopulationDrive | None:
    """The drive of a seed; None where the twin refuses it (a robot too heavy for its soil, say)."""
    rng = np.random.default_rng([seed, 71])
    robot, soil = str(rng.choice(ROBOTS)), str(rng.choice(SOILS))
    vehicle = _vehicle(robot, rng)
    scenario = _scenario(vehicle, rng)
    try:
        run = simulate_run(
            scenario, vehicle=vehicle, seed=seed, soils={"ground": _soil(soil, rng)},
            slope_deg=float(rng.choice([0.0, 0.0, rng.uniform(0.0, 8.0)])),
        )  # fmt: skip
    except (ConfigError, TerrafusionError):
        return None
    odometry = vehicle.odometry
    return PopulationDrive(seed, robot, soil, run.recording, odometry.wheel_radius_m, odometry.track_m)


def _around(rng: np.random.Generator, value: float, share: float) -> float:
    return float(value * np.exp(share * rng.normal()))


def _vehicle(name: str, rng: np.random.Generator) -> VehicleParams:
    """The library's robot with body, tyres, speed loop, sensors and odometry scattered."""
    own = load_vehicle(name)
    size = _around(rng, 1.0, 0.15)
    body = dataclasses.replace(
        own.body, mass_kg=_around(rng, own.body.mass_kg, 0.25), track_m=_around(rng, own.body.track_m, 0.15),
        wheelbase_m=_around(rng, own.body.wheelbase_m, 0.2),
        yaw_inertia_kgm2=_around(rng, own.body.yaw_inertia_kgm2, 0.3),
        cg_forward_m=own.body.cg_forward_m + 0.1 * own.body.wheelbase_m * float(rng.normal()),
    )  # fmt: skip
    wheel = dataclasses.replace(own.wheel, radius_m=own.wheel.radius_m * size)
    odometry = dataclasses.replace(
        own.odometry, wheel_radius_m=_around(rng, wheel.radius_m, 0.03), track_m=body.track_m
    )
    imu = dataclasses.replace(
        own.sensors.imu, rate_hz=float(rng.choice(RATES_HZ)),
        accel_bias_sigma_mps2=_around(rng, 0.15, 0.5), accel_noise_mps2_sqrthz=_around(rng, 0.01, 1.0),
    )  # fmt: skip
    wheels = dataclasses.replace(own.sensors.wheels, rate_hz=min(float(rng.choice(WHEEL_HZ)), imu.rate_hz))
    sensors = dataclasses.replace(own.sensors, imu=imu, wheels=wheels)
    realism = dataclasses.replace(own.realism, vibration_gain=_around(rng, own.realism.vibration_gain, 0.6))
    return dataclasses.replace(
        own, body=body, wheel=wheel, odometry=odometry, sensors=sensors, realism=realism
    )


def _soil(name: str, rng: np.random.Generator) -> SoilParams:
    """The library's soil scattered; ice is asphalt with a friction of 0.03 to 0.25."""
    own = load_soil("asphalt" if name == "ice" else name)
    pressure, shear = own.pressure, own.shear
    if name == "ice":
        cap = float(np.exp(rng.uniform(np.log(0.03), np.log(0.25))))
        shear = dataclasses.replace(shear, friction_cap=cap, cohesion_pa=0.0)
    else:
        shear = dataclasses.replace(
            shear, friction_cap=min(_around(rng, shear.friction_cap, 0.25), 2.0),
            shear_modulus_m=min(_around(rng, shear.shear_modulus_m, 0.4), 0.2),
            friction_angle_rad=min(_around(rng, shear.friction_angle_rad, 0.15), 0.9),
        )  # fmt: skip
        pressure = dataclasses.replace(
            pressure, k_phi_n_per_m_n2=_around(rng, pressure.k_phi_n_per_m_n2, 0.5),
            k_c_n_per_m_n1=_around(rng, pressure.k_c_n_per_m_n1, 0.5),
        )  # fmt: skip
    vibration = dataclasses.replace(
        own.vibration, accel_mps2_at_1mps=_around(rng, own.vibration.accel_mps2_at_1mps, 0.5),
        gyro_radps_at_1mps=_around(rng, own.vibration.gyro_radps_at_1mps, 0.5),
    )  # fmt: skip
    return dataclasses.replace(own, name="ground", pressure=pressure, shear=shear, vibration=vibration)


def _scenario(vehicle: VehicleParams, rng: np.random.Generator) -> Scenario:
    """A stand of 4 s, then pieces of random speed and turn, gentle or violent."""
    top = vehicle.drive.max_speed_mps * float(rng.uniform(0.3, 0.95))
    turns = float(rng.choice([0.15, 0.5, 1.0]))
    pieces, at = [DriveSegment(4.0)], 4.0
    while at < SECONDS:
        seconds = float(rng.uniform(2.0, 8.0))
        forward = float(rng.uniform(0.2, 1.0)) * top * float(rng.choice([1.0, 1.0, 1.0, -1.0]))
        turn = turns * float(rng.normal()) if rng.uniform() < 0.7 else 0.0
        pieces.append(DriveSegment(seconds, forward, turn))
        at += seconds
    return Scenario(
        "population", SECONDS, drive=tuple(pieces), route=(RouteLeg("ground"),),
        max_accel_mps2=float(rng.uniform(0.3, 2.5)),
    )  # fmt: skip
