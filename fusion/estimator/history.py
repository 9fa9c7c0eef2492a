"""The states of a run, collected, smoothed, and turned into an `Estimate`."""

import dataclasses
from collections.abc import Iterable

import numpy as np

from terrafusion.datasets.core.frames import quaternion_to_matrix
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimate.estimate import Estimate, Innovation, State, WeightChange
from terrafusion.fusion.estimator.gnss import GnssUpdater
from terrafusion.fusion.estimator.key_states import key_state_of, smoothed
from terrafusion.fusion.estimator.learned_numbers import LearnedNumbers
from terrafusion.fusion.estimator.map_alignment import MapAlignment
from terrafusion.fusion.estimator.place_doubt import rounded, widened_smoothed
from terrafusion.fusion.graph.batch import BatchSmoother
from terrafusion.fusion.graph.body_twist import gyro_sigma_radps
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.key_state import LINEAR
from terrafusion.fusion.noise.policy import SensorNoise


class History:
    """States and innovations of a run; `add` and `innovations.append` are callbacks of an `Estimator`."""

    def __init__(self) -> None:
        self.states: list[State] = []
        self.noises: list[SensorNoise] = []
        self.innovations: list[Innovation] = []
        self.changes: list[WeightChange] = []
        self.found_grounds: list[str] = []

    def add(
        self, state: State, noise: SensorNoise, changes: Iterable[WeightChange] = (), found_ground: str = ""
    ) -> None:
        """A keyframe, the sensor noise it was made with, the changes of weights before it, and its ground."""
        self.found_grounds.append(found_ground)
        self.states.append(state)
        self.noises.append(noise)
        self.changes.extend(changes)

    def align(self, alignment: MapAlignment | None, batch: bool) -> tuple[str, ...]:
        """Move the local states before the first fixes onto the map; gives a note where there are any.

        Live, states of a known place and an unknown heading stay as they were given out.
        """
        if alignment is None:
            return ()
        local = [
            i
            for i, state in enumerate(self.states)
            if state.status == "no_gnss" or (batch and state.t_ns < alignment.t_ns)
        ]
        if not local:
            return ()
        for i in local:
            self.states[i] = alignment.moved(self.states[i])
        begun = (alignment.t_ns - self.states[0].t_ns) * 1e-9
        note = f"{begun:.1f} s after the start GNSS laid the path onto the map, turned by "
        note += f"{np.degrees(alignment.yaw_rad):.0f} degrees"
        return (note if batch else f"{note}; live, all before was in a local frame: it is not scored",)

    def smooth(
        self, archive: Chain, config: EstimatorConfig, gnss: GnssUpdater, learned: LearnedNumbers
    ) -> None:
        """Replace the live states by the batch solution over the whole run, which starts from them.

        Where fixes have aligned the path with the map, no state of it is local any more. The covariances hold
        what is not known of antenna and delay of the fixes at the end.
        """
        live = [key_state_of(state) for state in self.states]
        batch = BatchSmoother(archive, live)
        batch.optimise()
        keys, covariances = batch.states(), batch.covariances()
        offset = len(keys) - len(self.states)
        times_ns = np.array([state.t_ns for state in self.states])
        yaw_rates = [float(state.angular_velocity_radps[2]) for state in self.states]
        moments = learned.past_place_moments(times_ns)
        covariances = widened_smoothed(times_ns, keys[offset:], yaw_rates, covariances[offset:], moments)
        imu, t_s = config.rig.sensors.imu, times_ns * 1e-9
        apart_s = np.diff(t_s, prepend=t_s[0] - config.keyframe_s)
        pairs = zip(self.noises, apart_s, strict=True)
        sigma_radps = np.array([gyro_sigma_radps(imu, dt_s, noise) for noise, dt_s in pairs])
        self.states = smoothed(self.states, live, keys[offset:], covariances, sigma_radps)
        if gnss.alignment is not None:
            self.states = [
                dataclasses.replace(state, status="outage") if state.status == "no_gnss" else state
                for state in self.states
            ]
        elif gnss.open_heading is not None:
            self.states = [rounded(gnss.open_heading.widened(state)) for state in self.states]

    def estimate(
        self, classes: tuple[str, ...], changes: list[WeightChange], notes: tuple[str, ...], start_ns: int = 0
    ) -> Estimate:
        """All keyframes as arrays along time, of a recording that began at `start_ns`."""
        states = self.states

        def stack(name: str, width: tuple[int, ...] = ()) -> np.ndarray:
            return np.array([getattr(s, name) for s in states], dtype=float).reshape(len(states), *width)

        quaternion, velocity = stack("quaternion", (4,)), stack("velocity_mps", (3,))
        R = quaternion_to_matrix(quaternion) if len(states) else np.zeros((0, 3, 3))
        body_velocity = np.einsum("nji,nj->ni", R, velocity)
        trajectory = Trajectory(
            t_ns=np.array([s.t_ns for s in states], dtype=np.int64),
            position_m=stack("position_m", (3,)),
            quaternion=quaternion,
            twist_body=np.hstack([body_velocity, stack("angular_velocity_radps", (3,))]),
            covariance=stack("covariance", (6, 6)),
        )
        fields = [f.name for f in dataclasses.fields(SensorNoise)]
        return Estimate(
            trajectory=trajectory,
            velocity_mps=velocity,
            velocity_covariance=stack("velocity_covariance", (3, 3)),
            gyro_bias_radps=stack("gyro_bias_radps", (3,)),
            accel_bias_mps2=stack("accel_bias_mps2", (3,)),
            slip=stack("slip"),
            slip_sigma=stack("slip_sigma"),
            terrain=np.array([[s.terrain[c] for c in classes] for s in states]).reshape(
                len(states), len(classes)
            ),
            classes=classes,
            weights={name: np.array([getattr(noise, name) for noise in self.noises]) for name in fields},
            changes=tuple(changes),
            innovations=tuple(self.innovations),
            status=np.array([s.status for s in states], dtype=object),
            notes=notes,
            slipping=np.array([s.slipping for s in states], dtype=bool),
            immobilised=np.array([s.immobilised for s in states], dtype=bool),
            twist_covariance=stack("twist_covariance", (6, 6)),
            bias_sigma=stack("bias_sigma", (6,)),
            linear=stack("linear", (len(LINEAR),)),
            linear_sigma=stack("linear_sigma", (len(LINEAR),)),
            linear_names=LINEAR,
            start_ns=start_ns,
            found_ground=np.array(self.found_grounds, dtype=object),
        )
