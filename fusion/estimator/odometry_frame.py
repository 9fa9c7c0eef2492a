"""The continuous frame of REP-105: the motion from keyframe to keyframe added up, which no fix makes jump.

The estimate in `map` jumps where fixes correct it. In `odom` each step is the one estimated before the
fixes at its end are used; the path drifts, but it is continuous.
"""

import dataclasses

import gtsam
import numpy as np

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.fusion.estimate.estimate import State
from terrafusion.fusion.estimator.key_states import key_state_of
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.key_state import POSE, quaternion_of
from terrafusion.fusion.graph.triangular import back_substitute_before


def in_map(frame: str) -> bool:
    """Whether a frame is "map" and not "odom".

    Raises:
        ConfigError: it is neither.
    """
    if frame not in ("map", "odom"):
        raise ConfigError(f"frame '{frame}' is neither 'map' nor 'odom'", remedy="give one of them")
    return frame == "map"


class OdometryFrame:
    """Pose of the newest keyframe in a frame that begins where `map` has the robot at its start."""

    def __init__(self) -> None:
        self._pose: gtsam.Pose3 | None = None

    def step(self, chain: Chain) -> None:
        """Take the newest keyframe, solved without the fixes that came with it."""
        before = _smoothed_before(chain)
        begin = before if self._pose is None else self._pose
        self._pose = begin.compose(before.between(chain.state(chain.last).pose))

    def of(self, keyframe: State, now: State) -> State:
        """The state `now`, carried on from the newest `keyframe`, in this frame; both are in `map`.

        The covariance of its pose is unknown (NaN), that of the twist stays. The velocity and its covariance
        have the axes of this frame.
        """
        keyframe_pose, pose = key_state_of(keyframe).pose, key_state_of(now).pose
        assert self._pose is not None
        here = self._pose.compose(keyframe_pose.between(pose))
        turn = here.rotation().matrix() @ pose.rotation().matrix().T
        return dataclasses.replace(
            now,
            position_m=np.asarray(here.translation()),
            quaternion=quaternion_of(here),
            velocity_mps=turn @ now.velocity_mps,
            velocity_covariance=turn @ now.velocity_covariance @ turn.T,
            covariance=np.full((6, 6), np.nan),
        )


def _smoothed_before(chain: Chain) -> gtsam.Pose3:
    """Pose of the keyframe before the newest by the newest solution: `Chain.solve` moves the newest alone.

    A change of ground that is detected late moves both; their difference alone is the motion between them.
    """
    node, newest = chain.nodes[-2:]
    assert node.conditional is not None
    (delta,) = back_substitute_before([node.conditional], newest.delta)
    return node.point.pose.retract(delta[POSE])
