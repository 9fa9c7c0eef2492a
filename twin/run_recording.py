"""The recording of a simulated run: every sensor at its own rate, the truth, and how it was made."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.channels import Command, Terrain
from terrafusion.datasets.core.frames import matrix_to_quaternion
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.twin.model.ground import patch_share
from terrafusion.twin.model.library import assumed, assumed_soil
from terrafusion.twin.model.motion import BodyMotion, wheel_shares
from terrafusion.twin.model.vehicle import VehicleParams
from terrafusion.twin.model.vehicle_file import read_vehicle
from terrafusion.twin.physics.layout import INDEX, VEHICLE_PARAMETERS, state_slice
from terrafusion.twin.run_setup import RunSetup
from terrafusion.twin.scenario.commands import STANDING_MPS, DrivenStates
from terrafusion.twin.sensors.drive import motor_channel, steering_channel, wheels_channel
from terrafusion.twin.sensors.effects import with_sensor_effects
from terrafusion.twin.sensors.environment import barometer_channel, magnetometer_channel
from terrafusion.twin.sensors.gnss import gnss_channel
from terrafusion.twin.sensors.imu import imu_channel
from terrafusion.twin.sensors.noise import NoiseStreams, rows_at_rate

START_NS = 1_704_067_200 * 10**9
"""Simulated drives start on 2024-01-01 00:00 UTC."""
DATUM = (52.0, 8.0, 100.0)
"""ENU origin of simulated drives: latitude deg, longitude deg, height m."""
_TERRAIN_HZ = 10.0
_COMMAND_HZ = 50.0
_NOT_SIMULATED = (
    "yaw_factor",
    "wheel_scale",
    "wheel_delay_s",
    "imu_roll_rad",
    "imu_pitch_rad",
    "imu_yaw_rad",
)
"""Numbers of a robot's sensors that the twin's do not have (those of delay and gyro they have)."""
_TIPPING_ROWS = 10
"""Whether the robot tips over is checked in every so many samples."""


def record(setup: RunSetup, driven: DrivenStates, motion: BodyMotion, noise: NoiseStreams) -> Recording:
    """The channels at their own rates, all on the clock of the IMU, with the effects of the sensors."""
    scenario, vehicle, route, states = setup.scenario, setup.vehicle, setup.route, driven.states
    t_ns = START_NS + np.round(motion.t_s * 1e9).astype(np.int64)
    travel = states[:, INDEX["travel"]]
    along = route.along(motion.t_s, travel)
    patch = patch_share(setup.plant.route.field, states[:, INDEX["x"]], states[:, INDEX["y"]])
    rim = np.abs(states[:, state_slice("wheel_speed")]).mean(axis=1) * vehicle.wheel.radius_m
    parameters = dict(zip(VEHICLE_PARAMETERS, setup.plant.vehicle.tolist(), strict=True))
    command, terrain = (
        rows_at_rate(len(t_ns), vehicle.sensors.imu.rate_hz, rate) for rate in (_COMMAND_HZ, _TERRAIN_HZ)
    )
    recording = Recording(
        name=scenario.name,
        start_ns=START_NS,
        vehicle=vehicle.name,
        command=Command(t_ns[command], driven.commanded[command, 0], driven.commanded[command, 1]),
        wheels=wheels_channel(t_ns, motion, states, vehicle, noise),
        imu=imu_channel(t_ns, motion, vehicle, route.shares(along, patch), rim, noise),
        gnss=gnss_channel(t_ns, motion, travel, vehicle, scenario, noise),
        motor=motor_channel(t_ns, motion, states, parameters, vehicle, noise),
        terrain=Terrain(t_ns[terrain], route.labels(along[terrain], patch[terrain]), source="simulation"),
        barometer=barometer_channel(t_ns, motion, DATUM[2], vehicle, noise),
        magnetometer=magnetometer_channel(t_ns, motion, vehicle, noise),
        steering=steering_channel(t_ns, motion, driven.inputs, vehicle, noise),
        truth=_truth(t_ns, motion),
        datum=DATUM,
        truth_channels=("position", "yaw", "orientation", "velocity"),
        terrain_name=route.soils[0].name if len(route.soils) == 1 and not patch.any() else "mixed",
        source="terrafusion twin",
        description=_description(setup, noise),
    )
    if not setup.effects:
        return recording
    latency_s = 0.0 if noise.noiseless else vehicle.realism.gnss_latency_s
    return with_sensor_effects(recording, motion, driven, setup.plant, vehicle, setup.effects, latency_s)


def _truth(t_ns: NDArray[np.int64], motion: BodyMotion) -> Trajectory:
    zero = np.zeros((len(t_ns), 2))
    twist = np.hstack([motion.velocity_body_mps, zero, motion.yaw_rate_radps[:, None]])
    return Trajectory(t_ns, motion.position_m, matrix_to_quaternion(motion.rotation), twist)


def _terrains(setup: RunSetup) -> list[str]:
    """Names of the grounds along the route, then that of the patches."""
    patches = setup.scenario.patches
    return [*(leg.terrain for leg in setup.scenario.route), *([patches.terrain] if patches else [])]


def _description(setup: RunSetup, noise: NoiseStreams) -> str:
    scenario = setup.scenario
    grounds = ", ".join(dict.fromkeys(_terrains(setup)))
    extras = "exact sensors" if noise.noiseless else f"seed {noise.seed}"
    extras += "".join(f"; {key} = {value:g}" for key, value in setup.effects.items())
    if (varied := scenario.variation) is not None:
        grounds += f", strength varies by {varied.strength_sigma:g} over {varied.length_m:g} m"
    across = f", across {scenario.cross_slope_deg:g} deg" if scenario.cross_slope_deg else ""
    place = f" at {', '.join(f'{x:g}' for x in scenario.payload_at_m)} m" if scenario.payload_at_m else ""
    return (
        f"simulated: {scenario.description or scenario.name}; {grounds}; "
        f"slope {scenario.slope_deg:g} deg{across}; payload {scenario.payload_kg:g} kg{place}; {extras}"
    )


def run_notes(setup: RunSetup, motion: BodyMotion, vehicle: str | Path | VehicleParams) -> list[str]:
    """Sensors slower than declared, when the robot would tip over, known errors of sensors that are left out,
    commands that its drive cannot follow, and how many numbers are assumed.
    """
    sensors = setup.vehicle.sensors
    imu_hz = sensors.imu.rate_hz
    notes = [
        f"{name} at {imu_hz:g} Hz, not {spec.rate_hz:g}: the twin samples no sensor faster than the IMU"
        for name in ("wheels", "gnss", "barometer", "magnetometer")
        if (spec := getattr(sensors, name)) is not None and spec.rate_hz > imu_hz
    ]
    rows = np.arange(0, len(motion.t_s), _TIPPING_ROWS)
    shares = wheel_shares(motion.yaw_rad[rows], setup.vehicle, *setup.scenario.plane())
    tipped = rows[shares.min(axis=1) <= 0.0]
    if tipped.size:
        notes.append(
            f"from {motion.t_s[tipped[0]]:.1f} s on the robot would tip over: a wheel carries no load, "
            "and the model keeps it down"
        )
    robot = vars(setup.vehicle.robot)
    if left := [name for name in _NOT_SIMULATED if (n := robot[name]) and n.known != "assumed" and n.value]:
        notes.append(
            f"the twin's sensors do not have {', '.join(left)} of the vehicle's file, "
            "for which a replay of this log corrects all the same"
        )
    if setup.vehicle.steered() is not None and setup.scenario.drive:
        sent = setup.scenario.commanded(motion.t_s)
        turning = (np.abs(sent[:, 0]) < STANDING_MPS) & (sent[:, 1] != 0.0)
        if turning.any():
            seconds = turning.mean() * motion.t_s[-1]
            notes.append(
                f"turns on the spot, {seconds:.1f} s of the commands, are not driven: "
                f"'{setup.vehicle.name}' steers its wheels"
            )
    counts = {("terrain", name): assumed_soil(name) for name in _terrains(setup)}
    if not isinstance(vehicle, VehicleParams):
        counts = {("vehicle", str(vehicle)): assumed(read_vehicle(vehicle)[0]), **counts}
    listed = [f"{n} of {whole} of {kind} '{name}'" for (kind, name), (n, whole) in counts.items() if n]
    if listed:
        notes.append(f"assumed numbers, marked in their files: {', '.join(listed)}")
    return notes
