"""Which sensors a running robot has: found in what it sends for a second, as in a short bag."""

import contextlib
import dataclasses
from collections import Counter, deque
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.conventions import BODY_AXES
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers.formats import Request
from terrafusion.datasets.readers.ros.arriving import (
    KINDS,
    MOST_GATHERED,
    ArrivingMessages,
    GatheredMessages,
    RawMessage,
)
from terrafusion.datasets.readers.ros.bag import chosen_topics, recording_of
from terrafusion.datasets.readers.ros.raw import BagError
from terrafusion.datasets.readers.ros.static_frames import (
    StaticFrames,
    mounting_note,
    tells_turn,
    with_mountings,
)
from terrafusion.datasets.readers.ros.topics import BagTopic

NEEDED = ("imu", "wheels")


@dataclass
class Sensors:
    """The sensors that were found.

    Attributes:
        recording: what they sent so far.
        arriving: turns their next messages into samples.
        notes: what was chosen and assumed, a sentence each.
    """

    recording: Recording
    arriving: ArrivingMessages
    notes: list[str]

    @property
    def gnss(self) -> bool:
        """Whether fixes will come."""
        return "gnss" in self.arriving.chosen


def find_sensors(
    gathered: GatheredMessages,
    request: Request,
    frames: StaticFrames,
    base: str,
    datum: tuple[float, float, float] | None,
) -> Sensors | str:
    """The sensors of a robot by the messages it has sent so far, or what is missing, in words.

    Args:
        gathered: those messages.
        request: vehicle, topics and stamps, as for a bag.
        frames: fixed transforms; where they lead to a sensor, its position and rotation are theirs.
        base: name of the robot's frame.
        datum: origin of ENU, deg and m; None for the first fix.

    Raises:
        DataError, BagError: the messages cannot be used.
    """
    chosen, notes = chosen_topics(gathered, request)
    chosen = {kind: topic for kind, topic in chosen.items() if kind in KINDS}
    missing = [kind for kind in NEEDED if kind not in chosen]
    if missing:
        return f"no topic of {' and '.join(missing)} yet; where it has another type, name it with --topic"
    mounted = {}
    for kind in ("imu", "gnss"):
        frame = _frame(gathered, chosen[kind]) if kind in chosen else ""
        found = frames.mounting(base, frame)
        if found is not None:
            mounted[kind] = found
            notes.append(mounting_note(kind, frame, found))
    turn = None
    if "imu" in mounted and tells_turn(mounted["imu"], _frame(gathered, chosen["imu"]), request.rig):
        R, request = mounted["imu"][1], _without_axes(request)
        turn = None if np.array_equal(R, np.eye(3)) else R
    # Stamps out of order are no reason to wait: only the kinds of sensors are taken from this recording.
    repairing = dataclasses.replace(request, repair_clock=True)
    try:
        recording = recording_of(gathered, repairing)
    except (DataError, BagError):
        recording = recording_of(_usable(gathered, ArrivingMessages(request, dict(chosen))), repairing)
        if recording.imu is None or recording.wheels is None:
            raise
    if recording.imu is not None and len(recording.imu) < 2:
        return f"one message of {chosen['imu'].name} yet; the next one shows how fast it is"
    overrides = with_mountings(recording.overrides, mounted, request.rig)
    recording = dataclasses.replace(recording, overrides=overrides)
    arriving = ArrivingMessages(request, chosen, datum or recording.datum, turn)
    notes = [*(f"{kind}: {topic.name} ({topic.msgtype})" for kind, topic in chosen.items()), *notes]
    return Sensors(recording, arriving, [*notes, *recording.notes])


def _usable(gathered: GatheredMessages, arriving: ArrivingMessages) -> GatheredMessages:
    """The messages but those that `arriving` refuses, and those of the IMU that lack numbers others have."""
    usable, lacking = GatheredMessages(), {}
    for message in gathered.messages:
        with contextlib.suppress(DataError, BagError):
            samples = [sample for _, kind, sample in arriving.samples(message) if kind == "imu"]
            usable.messages.append(message)
            for sample in samples:
                lacking[id(message)] = tuple(np.isnan([*sample.gyro_radps, *sample.accel_mps2]).tolist())
    if lacking:
        usual = Counter(lacking.values()).most_common(1)[0][0]
        held = [message for message in usable.messages if lacking.get(id(message), usual) == usual]
        usable.messages = deque(held, maxlen=MOST_GATHERED)
    return usable


def _frame(gathered: GatheredMessages, topic: BagTopic) -> str:
    """The frame of a topic's first message."""
    first: RawMessage = next(message for message in gathered.messages if message.topic == topic.name)
    names = first.stream(("header.frame_id",)).frame_ids
    return str(names[0]) if len(names) else ""


def _without_axes(request: Request) -> Request:
    """The request without the vehicle's IMU axes: the robot's own transforms hold."""
    if request.rig is None:
        return request
    sensors = request.rig.sensors
    sensors = dataclasses.replace(sensors, imu=dataclasses.replace(sensors.imu, axes=BODY_AXES))
    return dataclasses.replace(request, rig=dataclasses.replace(request.rig, sensors=sensors))
