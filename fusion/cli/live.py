"""`terrafusion live`: the estimator on a running robot over DDS, or a recording through the same loop."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from terrafusion.datasets.core.errors import DataError, errors_of
from terrafusion.fusion.cli import common
from terrafusion.fusion.cli.command import Result
from terrafusion.fusion.cli.usage import refuse_options

if TYPE_CHECKING:
    from terrafusion.fusion.estimate.estimate import State
    from terrafusion.fusion.live.node import LiveNode
    from terrafusion.fusion.live.options import LiveOptions

LogArgument = Annotated[
    str | None,
    typer.Argument(metavar="[LOG]", help="A recording to run in place of a robot; without one, DDS is used."),
]


def live(
    log: LogArgument = None,
    vehicle: common.VehicleOption = None,
    realtime: bool = False,
    mode: common.Mode = "adaptive",
    topic: common.TopicOption = None,
    stamps: common.StampsOption = "header",
    domain: int | None = None,
    loopback: bool = False,
    reliable: bool = False,
    rate: float = 50.0,
    datum: str | None = None,
    use_sim_time: bool = False,
    namespace: str = "",
    wait: float = 0.02,
    seconds: float | None = None,
    foxglove: int | None = None,
    terrain_model: Path | None = None,
    grounds: Path | None = None,
) -> Result:
    """Run the estimator beside a ROS 2 robot, without ROS: it speaks DDS itself.

    Finds IMU, wheels and GNSS by type and name; publishes /odometry, /odometry/map, /tf, slip, ground and
    /diagnostics (docs/how-to/ros2.md). With LOG it runs a recording message by message, and prints
    computing times and the verdict.

    Example: terrafusion live --vehicle husky

    Example: terrafusion live --vehicle husky --topic wheels=/odom --domain 7 --foxglove 8765

    Example: terrafusion live drive.bag --vehicle husky --realtime

    Args:
        realtime: At the pace of the recording.
        mode: As of `replay`.
        domain: DDS domain; by default ROS_DOMAIN_ID, else 0.
        loopback: Speak to this machine only (127.0.0.1).
        reliable: Ask for lost messages again; by default as ROS 2's sensor data.
        rate: Odometry a second, at most.
        datum (LAT,LON,HEIGHT): Origin of map, instead of the first fix.
        use_sim_time: The time of the robot is /clock.
        namespace: Put before the published topics, such as /robot1.
        wait: Seconds that samples wait for others of the same time.
        seconds: Stop after so long; else Ctrl-C.
        foxglove (PORT): Show it in Foxglove at ws://localhost:PORT.
        terrain_model (FILE.yaml): Model of this robot's grounds, of `terrain train`.
        grounds (FILE.yaml): What the robot learned of its grounds: read if it is there, written at the end.
    """
    if log is not None:
        common.check_existence(log)
    from terrafusion.fusion.live.options import LiveOptions
    from terrafusion.fusion.terrain.classifier import load_terrain_model

    origin = common.parse_point(datum, "LAT,LON,HEIGHT", "--datum")
    options = LiveOptions(
        vehicle, mode, common.parse_topics(topic), stamps, frequency=rate, datum=origin,
        wait_s=wait, use_sim_time=use_sim_time, prefix=namespace.rstrip("/"),
        terrain_model=None if terrain_model is None else load_terrain_model(terrain_model), grounds=grounds,
    )  # fmt: skip
    of_a_robot = {
        "--domain": domain is not None, "--loopback": loopback, "--reliable": reliable,
        "--seconds": seconds is not None, "--foxglove": foxglove is not None,
        "--rate": rate != LiveOptions.frequency, "--wait": wait != LiveOptions.wait_s,
        "--datum": datum is not None, "--use-sim-time": use_sim_time, "--namespace": namespace != "",
    }  # fmt: skip
    if log is not None:
        refuse_options(of_a_robot, "goes with a robot, not with a LOG")
        _run_log(log, options, realtime)
    else:
        refuse_options({"--realtime": realtime}, "goes with a LOG")
        _run_robot(options, _domain(domain), loopback, reliable, seconds, foxglove)
    return Result()


def _run_robot(
    options: LiveOptions,
    domain: int,
    loopback: bool,
    reliable: bool,
    seconds: float | None,
    foxglove: int | None,
) -> None:
    from terrafusion.fusion.live.dds import DdsBus
    from terrafusion.fusion.live.foxglove import FoxgloveView
    from terrafusion.fusion.live.node import LiveNode
    from terrafusion.fusion.live.serve import serve

    bus = DdsBus(domain, loopback=loopback, reliable=reliable)
    view = FoxgloveView(foxglove) if foxglove is not None else None

    def publish(topic: str, msgtype: str, cdr: bytes) -> None:
        bus.publish(topic, msgtype, cdr)
        if view is not None:
            view.publish(topic, msgtype, cdr)

    def say(line: str) -> None:
        print(line, flush=True)

    stopped: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopped.append(1))
    node = LiveNode(options, publish, say)
    where = "this machine only" if loopback else "the network"
    say(f"on DDS domain {domain}, {where}; Ctrl-C ends it")
    begun = time.monotonic()
    serve(bus, node, lambda: bool(stopped) or (seconds is not None and time.monotonic() - begun >= seconds))
    say(_summary(node))
    bus.close()
    if view is not None:
        view.close()


def _summary(node: LiveNode) -> str:
    counts = ", ".join(f"{count} {name}" for name, count in sorted(node.counts.items()))
    state = None if node.estimator is None else node.estimator.latest()
    if state is None:
        return f"the estimator never started; {counts}"
    return f"{state.status}: {state.position_m.round(2).tolist()} m, slip {state.slip:.2f}; {counts}"


def _domain(domain: int | None) -> int:
    if domain is not None:
        return domain
    text = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not text.isdecimal():
        raise typer.BadParameter(f"ROS_DOMAIN_ID is '{text}', which is no number", param_hint="--domain")
    return int(text)


def _run_log(log: str, options: LiveOptions, realtime: bool) -> None:
    """A recording message by message, odometry after every IMU sample."""
    from terrafusion.datasets.readers import open_recording
    from terrafusion.fusion.estimator.feed import wheels_of
    from terrafusion.fusion.estimator.history import History
    from terrafusion.fusion.grounds.file import read_grounds, save_grounds
    from terrafusion.fusion.grounds.memory import after_drive, drive_mark
    from terrafusion.fusion.live.loop import live_estimator, run, verdict_of

    recording = open_recording(
        log, rig=common.load_rig(options.vehicle), topics=dict(options.topics), stamps=options.stamps
    )
    common.warn_of_log(log, [recording])
    newest: list[State] = []

    def publish(state: State) -> None:
        newest[:] = [state]

    with errors_of(log):
        history = History()
        memory = None if options.grounds is None else read_grounds(options.grounds)
        estimator = live_estimator(
            recording, options.vehicle, history, options.mode, False, options.terrain_model, memory
        )
        taken = run(estimator, recording.messages(), publish, realtime)
        if not newest:
            raise DataError("the estimator never started", remedy="see `terrafusion inspect`")
        for line in taken.lines():
            print(line)
    learned = estimator.weights.learned_grounds()
    if options.grounds is not None and learned is not None:
        print(save_grounds(after_drive(memory, learned, drive_mark(wheels_of(recording))), options.grounds))
    state = newest[0]
    print(f"{state.status}: {state.position_m.round(2).tolist()} m, slip {state.slip:.2f}")
    for line in verdict_of(estimator, history, recording).lines():
        print(line)
