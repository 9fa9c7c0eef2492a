"""The estimator as a node: messages of ROS 2 in, odometry and transforms out, whatever carries them.

`terrafusion live` gives it DDS, the rclpy node of `docs/ros2` gives it ROS: both pass on CDR bytes.

    node = LiveNode(LiveOptions(vehicle="husky"), publish=bus.publish, say=print)
    node.receive("/imu/data", "sensor_msgs/msg/Imu", cdr, receipt_ns)
    node.tick(now_s)
"""

import dataclasses
import math
import re
import time
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any

from terrafusion.datasets.core.channels import Gnss
from terrafusion.datasets.core.errors import DataError, TerrafusionError
from terrafusion.datasets.core.messages import ImuSample
from terrafusion.datasets.readers.formats import Request
from terrafusion.datasets.readers.ros import topics as known
from terrafusion.datasets.readers.ros.arriving import (
    KINDS,
    LIVE,
    ArrivingMessages,
    GatheredMessages,
    RawMessage,
)
from terrafusion.datasets.readers.ros.raw import BagError
from terrafusion.datasets.readers.ros.static_frames import STATIC, StaticFrames
from terrafusion.fusion.estimate.estimate import STATUS, State
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.estimator.history import History
from terrafusion.fusion.grounds.file import read_grounds, save_grounds
from terrafusion.fusion.inputs.sample_stream import MOST_LATE_S
from terrafusion.fusion.inputs.time_jumps import (
    CONFIRMED,
    CONFIRMED_NS,
    JUMP_NS,
    ClockJumpError,
    EarlyFixes,
    Newest,
    TimeJump,
)
from terrafusion.fusion.live import published
from terrafusion.fusion.live.loop import live_estimator
from terrafusion.fusion.live.options import LiveOptions, checked_datum
from terrafusion.fusion.live.ordered import OrderedSamples
from terrafusion.fusion.live.sensors import Sensors, find_sensors
from terrafusion.twin.model.vehicle import load_vehicle

CLOCK = ("/clock", "rosgraph_msgs/msg/Clock")
COMMAND = ("/terrafusion/command", "std_msgs/msg/String")
COMMANDS = "reset, on, off, or datum LATITUDE LONGITUDE HEIGHT"
LOOK_S = 1.0
"""Messages of this long show which sensors there are."""
DIAGNOSTICS_S = 1.0
SILENT_S = 2.0
"""Without a sample of the IMU for longer the diagnostics warn (assumed)."""
MISSING_NS = 5_000_000_000
"""Messages are held for so long while a sensor is missing."""
MOST_REPORTED = 200
"""Kinds of lines that are reported; later ones are only counted."""
Say = Callable[[str], None]
Publish = Callable[[str, str, bytes], None]


class LiveNode:
    """Finds the sensors of a running robot, and runs an estimator on them.

    No message ends it: what cannot be used is counted, reported once a kind, and left out.

    Args:
        options: settings.
        publish: sends a message: topic, type and CDR.
        say: reports in one line.
        history: collects the states of the estimator.

    Raises:
        ConfigError: an unknown vehicle, or a ground memory that cannot be read.
    """

    def __init__(
        self, options: LiveOptions, publish: Publish, say: Say, history: History | None = None
    ) -> None:
        self.options, self._publish, self._say, self._history = options, publish, say, history
        rig = load_vehicle(options.vehicle).rig() if options.vehicle else None
        self._request = Request(LIVE, rig=rig, topics=dict(options.topics), stamps=options.stamps)
        self._grounds = None if options.grounds is None else read_grounds(options.grounds)
        self._gathered, self._frames = GatheredMessages(), StaticFrames()
        self._sensors: Sensors | None = None
        self.estimator: Estimator | None = None
        self.counts: Counter[str] = Counter(received=0, refused=0)
        self._reported, self._topics = set[str](), set[str]()
        self._problem, self.running = "", True
        self._now_s = self._looked_s = self._diagnosed_s = time.monotonic()
        self._clock_ns, self._status = 0, ("waiting", self._now_s)
        self._begin_ordering()

    def wants(self, topic: str, msgtype: str) -> bool:
        """Whether a topic of the robot is to be received: one of a sensor, or one of the node's own."""
        if topic in map(self.named, published.TYPES):
            return False
        if (topic, msgtype) in (STATIC, COMMAND):
            return True
        if (topic, msgtype) == CLOCK:
            return self.options.use_sim_time
        if topic in self.options.topics.values():
            return True
        return any(msgtype in known.TYPES[kind] for kind in KINDS)

    def named(self, topic: str) -> str:
        """The name under which one of `published.TYPES` is published."""
        return topic if topic in ("/tf", "/diagnostics") else self.options.prefix + topic

    def receive(self, topic: str, msgtype: str, cdr: bytes, receipt_ns: int) -> None:
        """Take a message. Its samples are used in `tick`, or when later messages come."""
        message = RawMessage(topic, msgtype, cdr, self._clock_ns or receipt_ns)
        self.counts["received"] += 1
        try:
            if (topic, msgtype) == STATIC:
                self._frames.add(message.stream(()))
            elif (topic, msgtype) == CLOCK:
                stream = message.stream(())
                seconds, rest = stream.column("clock.sec"), stream.column("clock.nanosec")
                self._clock_ns = int(seconds[0]) * 10**9 + int(rest[0])
            elif (topic, msgtype) == COMMAND:
                self._obey(str(message.stream(()).column("data")[0]))
            elif self._sensors is None:
                message.stream(("header.stamp",))
                if not self._gathered.messages:
                    self._looked_s = self._now_s
                self._gathered.messages.append(message)
            elif self.running:
                self._pass_on(self._sensors.arriving, message)
        except (TerrafusionError, BagError) as error:
            self._refuse(topic, error)

    def tick(self, now_s: float) -> None:
        """Use what has come; call it often. `now_s` is `time.monotonic()`."""
        self._now_s = now_s
        if self._sensors is None and now_s - self._looked_s >= LOOK_S:
            self._looked_s = now_s
            self._try_to_begin()
        self._use(self._ordered.released(now_s))
        if now_s - self._diagnosed_s >= DIAGNOSTICS_S:
            self._diagnosed_s = now_s
            self._diagnose()

    def reset(self, why: str) -> None:
        """Forget the path and begin anew, with the same sensors and the same datum."""
        self._say(f"started anew: {why}")
        self.counts["resets"] += 1
        self._begin_ordering()
        if self._sensors is not None:
            self.estimator = self._new_estimator(self._sensors)

    def set_datum(self, latitude: float, longitude: float, height_m: float) -> None:
        """Move the origin of `map`, deg and m, and begin anew.

        Raises:
            ConfigError, DataError: it is not on Earth, or no numbers.
        """
        datum = checked_datum(latitude, longitude, height_m)
        self.options = dataclasses.replace(self.options, datum=datum)
        if self._sensors is not None:
            self._sensors.arriving.datum = datum
        self.reset(f"the datum is {latitude:.7f} deg, {longitude:.7f} deg, {height_m:.2f} m")

    def toggle(self, on: bool) -> None:
        """Use messages, or leave them out; begins anew when it is switched on."""
        if on and not self.running:
            self.reset("switched on")
        elif not on:
            self._say("switched off: messages are left out")
        self.running = on

    def close(self) -> None:
        """No more messages come: use what waits, and make the last keyframes."""
        self._use(self._ordered.rest())
        if self.estimator is not None:
            self.estimator.finish()
            learned = self.estimator.weights.learned_grounds()
            if self.options.grounds is not None and learned is not None:
                self._say(save_grounds(learned, self.options.grounds))

    def _begin_ordering(self) -> None:
        self._ordered = OrderedSamples(self.options.wait_s)
        self._jump, self._back = TimeJump(Newest()), 0
        self._early_fixes = EarlyFixes(self._jump.newest)
        self._received_ns = 0
        self._ahead_ns: int | None = None
        self._published_ns: int | None = None
        self._keyframe: State | None = None

    def _obey(self, command: str) -> None:
        name, *values = command.split() or [""]
        if name == "reset" and not values:
            self.reset("as commanded")
        elif name in ("on", "off") and not values:
            self.toggle(name == "on")
        elif name == "datum" and len(values) == 3 and all(map(_is_number, values)):
            self.set_datum(*map(float, values))
        else:
            raise DataError(f"unknown command '{command[:60]}'", remedy=f"send {COMMANDS}")

    def _try_to_begin(self) -> None:
        """Make the estimator, once IMU and wheels have been received."""
        options, messages = self.options, list(self._gathered.messages)
        try:
            sensors = find_sensors(
                self._gathered, self._request, self._frames, options.frames.base, options.datum
            )
            if isinstance(sensors, str):
                self._report(f"waiting: {sensors}")
                self._gathered.forget(messages[-1].receipt_ns - MISSING_NS if messages else 0)
                return
            self.estimator = estimator = self._new_estimator(sensors)
        except (TerrafusionError, BagError) as error:
            self._report(f"waiting: {error}")
            self._gathered.forget(messages[-1].receipt_ns if messages else 0)
            return
        self._sensors = sensors
        self._problem = ""
        config = estimator.config
        for line in (*sensors.notes, *config.inputs.notes(sensors.recording, config.rig)):
            self._say(line)
        self._gathered.messages.clear()
        self._topics = {message.topic for message in messages}
        for message in messages:
            self._pass_on(sensors.arriving, message)

    def _new_estimator(self, sensors: Sensors) -> Estimator:
        if self.estimator is not None:
            self._grounds = self.estimator.weights.learned_grounds()
        o = self.options
        return live_estimator(
            sensors.recording, o.vehicle, self._history, o.mode, sensors.gnss, o.terrain_model, self._grounds
        )

    def _pass_on(self, arriving: ArrivingMessages, message: RawMessage) -> None:
        """Put the samples of a message in order, or refuse it."""
        if message.topic not in self._topics:
            self._topics.add(message.topic)
            if kind := arriving.join(message.topic, message.msgtype):
                self._say(f"{kind}: {message.topic} ({message.msgtype})")
        try:
            for t_ns, kind, sample in arriving.samples(message):
                self._order(t_ns, kind, sample, message.receipt_ns)
        except ClockJumpError as error:
            self.reset(error.what)
        except (TerrafusionError, BagError) as error:
            self._refuse(message.topic, error)

    def _order(self, t_ns: int, kind: str, sample: Any, receipt_ns: int) -> None:
        newest_ns = self._jump.newest.t_ns
        if kind == "gnss":
            self._jump.newest.fix(t_ns)
            for one in self._early_fixes.in_order(t_ns, sample):
                self._ordered.add(one[0], kind, one[1])
            return
        if kind != "imu":
            if kind == "wheels" and not self._jump.newest.is_jump(t_ns):
                self._jump.newest.used_count += 1  # an IMU that jumps alone is not followed
                self._ahead_ns = None
            self._ordered.add(t_ns, kind, sample)
            return
        if newest_ns is not None and newest_ns - t_ns > MOST_LATE_S * 1e9:
            self._back += 1
            if self._back < CONFIRMED:
                self.counts["refused"] += 1
                return
            self.reset(f"the stamps of the IMU went back by {(newest_ns - t_ns) * 1e-9:.1f} s")
        self._back = 0
        if self._is_ahead(t_ns, receipt_ns):
            self.counts["refused"] += 1
            return
        for one in self._jump.admitted((t_ns, sample)):
            self._ordered.add(one[0], kind, one[1])
        for one in self._early_fixes.reached():
            self._ordered.add(one[0], "gnss", one[1])

    def _is_ahead(self, t_ns: int, receipt_ns: int) -> bool:
        """Whether the stamps of the IMU jump ahead of the time of this computer; begins anew where they stay.

        A bag that is played has stamps of the past.
        """
        newest_ns = self._jump.newest.t_ns
        before_ns = t_ns if newest_ns is None else newest_ns
        if t_ns - receipt_ns > JUMP_NS >= before_ns - self._received_ns and self._jump.newest.is_jump(t_ns):
            if self._ahead_ns is None:
                self._ahead_ns = t_ns
            if t_ns - self._ahead_ns < CONFIRMED_NS:
                return True
            self.reset(f"the stamps of the IMU went ahead by {(t_ns - before_ns) * 1e-9:.1f} s")
        self._received_ns, self._ahead_ns = receipt_ns, None
        return False

    def _use(self, samples: Iterable[Any]) -> None:
        for sample in samples:
            estimator, sensors = self.estimator, self._sensors
            if estimator is None or sensors is None:
                return
            message = sensors.arriving.with_velocity(sample) if isinstance(sample, Gnss) else sample
            try:
                estimator.add(message)
            except ClockJumpError as error:
                self.reset(error.what)
                return
            except TerrafusionError as error:
                self._refuse(type(message).__name__, error)
            except (ArithmeticError, ValueError, RuntimeError) as error:  # a defect must not end the node
                self.reset(f"the estimator failed: {error}")
                return
            if isinstance(message, ImuSample):
                complete = math.isfinite(sum(message.gyro_radps.tolist()) + sum(message.accel_mps2.tolist()))
                if estimator.config.inputs.imu == "six_axis" and not complete:
                    self._refuse("imu", DataError(f"a sample lacks numbers: {message[1:]}"))
                self._publish_state(estimator)

    def _publish_state(self, estimator: Estimator) -> None:
        newest = estimator.latest()
        if newest is None:
            return
        t_ns = estimator.imu.t_ns[-1]
        step_ns = 1e9 / self.options.frequency
        if self._published_ns is not None and 0 <= t_ns - self._published_ns < 0.99 * step_ns:
            return
        self._published_ns = t_ns
        in_map, in_odom = estimator.odometry("map"), estimator.odometry("odom")
        assert in_map is not None
        assert in_odom is not None
        frames = self.options.frames
        out = [
            published.odometry("/odometry", in_odom, frames.odom, frames.base),
            published.odometry("/odometry/map", in_map, frames.map, frames.base),
        ]
        if newest is not self._keyframe:
            self._keyframe = newest
            out += published.ground(newest)
        if self.options.publish_tf:
            out += published.transforms(in_map, in_odom, frames)
        for one in out:
            self._publish(self.named(one.topic), one.msgtype, one.cdr)
            self.counts["published"] += 1

    def _diagnose(self) -> None:
        status = "waiting" if self.estimator is None else self.estimator.status
        if status != self._status[0]:
            self._say(f"{status}: {STATUS[status]}")
            self._status = status, self._now_s
        silent_s = self._ordered.silent_s(self._now_s)
        if self.estimator is not None and self.running and silent_s > SILENT_S:
            self._report(f"no sample of the IMU for {silent_s:.0f} s: nothing is estimated")
        newest = None if self.estimator is None else self.estimator.latest()
        t_ns = self._clock_ns or (newest.t_ns if newest else 0) or time.time_ns()
        lasted_s = self._now_s - self._status[1]
        self._publish(*published.diagnostics(t_ns, self.estimator, lasted_s, self.counts, self._problem))
        self._problem = ""

    def _refuse(self, where: str, error: Exception) -> None:
        self.counts["refused"] += 1
        self._report(f"refused: {where}: {error}")

    def _report(self, line: str) -> None:
        """Say a line once; what differs in its numbers alone is the same."""
        self._problem = line
        pattern = re.sub(r"[\d.+-]+", "#", line)
        if pattern not in self._reported and len(self._reported) < MOST_REPORTED:
            self._reported.add(pattern)
            self._say(line)


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
