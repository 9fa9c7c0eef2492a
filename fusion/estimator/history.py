"""Collects the states of a drive into an `Estimate`."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import numpy as np

from terrafusion.datasets.core.frames import quaternion_to_matrix
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.fusion.estimate.estimate import Estimate, Innovation, State, WeightChange
from terrafusion.fusion.graph.key_state import LINEAR
from terrafusion.fusion.noise.policy import SensorNoise


class History:
    """Give `add` and `innovations.append` to an `Estimator`, then ask for the `estimate`."""

    def __init__(self) -> None:
        self.states: list[State] = []
        self.noises: list[SensorNoise] = []
        self.innovations: list[Innovation] = []
        self.changes: list[WeightChange] = []

    def add(self, state: State, noise: SensorNoise, changes: Iterable[WeightChange] = ()) -> None:
        """One more keyframe, the noise noise it was made with, and the changes of weights before it."""
        self.states.append(state)
        self.noises.append(noise)
        self.changes.extend(changes)

    def estimate(
        self, classes: tuple[str, ...], changes: list[WeightChange], notes: tuple[str, ...]
    ) -> Estimate:
        """All keyframes as arrays along time."""
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
        )
