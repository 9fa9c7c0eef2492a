"""`terrafusion live`: a recording through the live loop, with the computing time of each call."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from terrafusion.fusion.cli.common import LogArgument, VehicleOption

if TYPE_CHECKING:
    from terrafusion.fusion.estimate.estimate import State

RealtimeOption = Annotated[bool, typer.Option("--realtime", help="At the pace of the recording.")]


def live(log: LogArgument, vehicle: VehicleOption = None, realtime: RealtimeOption = False) -> None:
    """Run the estimator as on a robot: message by message, odometry after every IMU sample.

    Prints how long updates and odometry take, the last state, and the verdict on the run.
    docs/how-to/integration.md has the same
    loop as a ROS 2 node.

    Example: terrafusion live drive.bag --vehicle husky --realtime
    """
    from terrafusion.datasets.core.errors import DataError, errors_of
    from terrafusion.datasets.readers import open_recording
    from terrafusion.fusion.estimator.history import History
    from terrafusion.fusion.live import live_estimator, run, verdict_of

    recording = open_recording(log)
    newest: list[State] = []

    def publish(state: State) -> None:
        newest[:] = [state]

    with errors_of(log):
        history = History()
        estimator = live_estimator(recording, vehicle, history)
        taken = run(estimator, recording.messages(), publish, realtime)
        if not newest:
            raise DataError("the estimator never started", remedy="see `terrafusion inspect`")
        for line in taken.lines():
            print(line)
    state = newest[0]
    print(f"{state.status}: {state.position_m.round(2).tolist()} m, slip {state.slip:.2f}")
    for line in verdict_of(estimator, history, recording).lines():
        print(line)
