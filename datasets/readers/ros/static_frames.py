"""Fixed transforms of a robot (`/tf_static`): where its sensors are, and how they are turned."""

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.frames import quaternion_to_matrix
from terrafusion.datasets.readers.ros.arriving import RawMessage

STATIC = ("/tf_static", "tf2_msgs/msg/TFMessage")
RIGHT_ANGLE = 0.01
"""A rotation this near to one by right angles is taken for it (0.6 degrees)."""


class StaticFrames:
    """The tree of frames that a robot publishes once."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Array, Array]] = {}

    def add(self, message: RawMessage) -> None:
        """Take the transforms of a tf2_msgs/TFMessage.

        Raises:
            BagError: it does not fit its definition.
        """
        columns = message.stream(()).blocks[0].columns
        i = 0
        while (at := f"transforms.{i}.child_frame_id") in columns:
            start = f"transforms.{i}.transform"
            translation = np.array([columns[f"{start}.translation.{axis}"][0] for axis in "xyz"])
            quaternion = np.array([columns[f"{start}.rotation.{axis}"][0] for axis in "xyzw"])
            length = np.linalg.norm(quaternion)
            if np.isfinite(translation).all() and 0.9 < length < 1.1:
                parent = str(columns[f"transforms.{i}.header.frame_id"][0])
                R = quaternion_to_matrix(quaternion / length)
                self._parents[_plain(str(columns[at][0]))] = (_plain(parent), translation, R)
            i += 1

    def mounting(self, base: str, frame: str) -> tuple[tuple[float, float, float], Array] | None:
        """Position (m) of a frame in the base's axes, and rotation (3, 3) from its axes to the base's.

        None where no chain of transforms leads from one to the other.
        """
        base, frame = _plain(base), _plain(frame)
        position, R = np.zeros(3), np.eye(3)
        for _ in range(len(self._parents) + 1):
            if frame == base:
                exact = np.rint(R)
                x, y, z = position.tolist()
                return (x, y, z), exact if np.abs(R - exact).max() < RIGHT_ANGLE else R
            if frame not in self._parents:
                return None
            frame, translation, turn = self._parents[frame]
            position, R = translation + turn @ position, turn @ R
        return None


def _plain(frame: str) -> str:
    return frame.lstrip("/")
