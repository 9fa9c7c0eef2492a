"""Notes on how an estimator used its inputs, in sentences."""

from terrafusion.datasets.core.printable import counted, times
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.estimator.gnss import GnssUpdater
from terrafusion.fusion.inputs.streams import SHOCK_MPS2, SPIN_RADPS
from terrafusion.fusion.inputs.time_jumps import JUMP_NS
from terrafusion.fusion.inputs.validation import MOST_MPS, MOST_MPS2, MOST_RADPS
from terrafusion.fusion.terrain.classifier import UNKNOWN, load_terrain_model


def notes_of(estimator: Estimator) -> tuple[str, ...]:
    """Notes on fixes, heading, skidding, IMU spikes, late samples and aiding sensors of a finished run."""
    notes = _on_fixes(estimator.gnss)
    if found := estimator.weights.found_grounds():
        notes.append("grounds found while driving, with their slip: " + ", ".join(found))
    learner = estimator.weights.grounds
    if learner is not None and (memory := learner.memory).left_out:
        notes.append(
            f"the ground memory is full: {0.5 * memory.left_out:.0f} s on ground other than its "
            f"{len(memory)} were not learned"
        )
    notes += _on_policy(estimator.config)
    if level := estimator.learned.mounting.level.note():
        notes.append(level)
    return (*notes, *_on_samples(estimator), *_on_times(estimator), *estimator.aids.notes())


def _on_policy(config: EstimatorConfig) -> list[str]:
    """A policy whose grounds the detector cannot tell."""
    model = (config.terrain_model or load_terrain_model()).for_vehicle(config.vehicle)
    if config.mode != "adaptive" or not model.classes or set(model.classes) & set(config.policy.classes):
        return []
    return [
        f"'{config.policy.name}' has none of the grounds that the terrain model knows "
        f"({', '.join(model.classes)}): the noise of `{UNKNOWN}` counts on all"
    ]


def _on_fixes(gnss: GnssUpdater) -> list[str]:
    """Fixes, and what they showed of heading and skids."""
    notes = []
    if gnss.open_heading is not None:
        then = "later fixes showed it" if gnss.alignment is not None else "no later fixes showed it"
        notes.append(
            f"the first fixes ended before they showed the heading clearly: it was open at first; {then}"
        )
    elif gnss.local and not gnss.unaligned:
        came = "came in time" if gnss.too_late or gnss.waiting else "came"
        notes.append(f"no GNSS fix {came}: the path is local, its start and heading are arbitrary")
    elif gnss.local:
        fixes = counted(gnss.unaligned, "GNSS fix", "GNSS fixes")
        notes.append(
            f"{fixes} came after a start without any and did not show the heading: "
            "the path is local, its start and heading are arbitrary"
        )
    if gnss.too_late:
        fixes = "fix" if gnss.too_late == 1 else "fixes"
        notes.append(f"{gnss.too_late} GNSS {fixes} came before the start or too late for the lag")
    if gnss.turned:
        notes.append(f"the heading was wrong and was set right from the motion {times(gnss.turned)}")
    notes += gnss.plausible.notes()
    if gnss.velocities.refused:
        notes.append(f"{gnss.velocities.refused} GNSS velocities were far from what wheels and IMU allow")
    if left_out := gnss.velocities.test_of_path.left_out:
        notes.append(
            f"{counted(left_out, 'GNSS velocity', 'GNSS velocities')} left out: not the rate of the "
            "positions, which wheels fit; check their axes (east, north, up), signs and unit (m/s)"
        )
    if gnss.skid.refutations:
        notes.append(f"fixes showed {times(gnss.skid.refutations)} that the wheels skidded")
    if gnss.skid.suspicions:
        often = times(gnss.skid.suspicions)
        notes.append(
            f"fixes moved {often} faster than their receiver drifts, by chance or in a skid: the wheels "
            "counted less for seconds"
        )
    friction = gnss.skid.friction
    if friction is not None and friction.leads:
        notes.append(f"at its end the robot skidded, with a friction limit of {friction.mps2:.1f} m/s2")
    return notes


def _on_samples(estimator: Estimator) -> list[str]:
    """Samples of IMU and wheels that were replaced or left out."""
    notes = []
    if estimator.imu.spikes:
        notes.append(
            f"{counted(estimator.imu.spikes, 'IMU sample')} beyond {SPIN_RADPS:g} rad/s or {SHOCK_MPS2:g} "
            "m/s2 not believed: the mean of those before stands for each"
        )
    for name, count, what in (
        ("imu", estimator.imu.impossible, f"{MOST_RADPS:g} rad/s or {MOST_MPS2:g} m/s2"),
        ("wheels", estimator.wheels.impossible, f"{MOST_MPS:g} m/s"),
    ):
        if count:
            notes.append(f"{counted(count, 'sample')} of {name} beyond {what} left out: no robot moves so")
    if left_out := estimator.imu.left_out:
        notes.append(
            f"{counted(left_out, 'sample')} of imu left out: an axis is missing, or all forces are 0, as "
            "of a driver that has lost its sensor"
        )
    if left_out := estimator.weights.left_out:
        notes.append(
            f"{counted(left_out, 'sample')} of terrain left out: without probabilities, or with ones that "
            "are missing, negative or all 0"
        )
    if estimator.wheels.noise.out_of_step:
        notes.append(
            "wheels: the counters are read out of step with their stamps; distances follow the speeds, and "
            "over ten samples the counters"
        )
    if jumps := estimator.wheels.jumps:
        notes.append(f"wheels: the counters jumped {times(jumps)}; there the speeds gave the distance")
    if estimator.gyro.samples:
        notes.append(
            f"the gyro's yaw rate stood still for {counted(estimator.gyro.samples, 'sample')} while the "
            "wheels turned otherwise: the wheels stood in for it"
        )
    return notes


def _on_times(estimator: Estimator) -> list[str]:
    """Samples that came too late or were stamped far ahead."""
    notes = []
    for channel, ahead in estimator.newest.refused.items():
        what = "too far from the time" if channel == "terrain" else "far ahead"
        notes.append(f"{counted(ahead, 'sample')} of {channel} left out: {what} of IMU and wheels")
    if dropped := estimator.fixes.dropped:
        notes.append(
            f"{counted(dropped, 'GNSS fix', 'GNSS fixes')} left out: more than {JUMP_NS * 1e-9:g} s ahead of "
            "IMU and wheels, and of fixes that came later"
        )
    for stream in (estimator.imu.late, estimator.wheels.late):
        if stream.jump.dropped:
            notes.append(
                f"{counted(stream.jump.dropped, 'sample')} of {stream.channel} left out: more than "
                f"{JUMP_NS * 1e-9:g} s ahead of all others"
            )
        if stream.too_late:
            late = counted(stream.too_late, "sample")
            notes.append(f"{late} of {stream.channel} came too late, with the keyframe made")
    return notes
