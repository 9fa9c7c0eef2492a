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

    Prints how long updates and odometry take, and the last state. docs/how-to/integration.md has the same
    loop as a ROS 2 node.

    Example: terrafusion live drive.bag --vehicle husky --realtime
    """
    from terrafusion.datasets.core.errors import DataError, errors_of
    from terrafusion.datasets.readers import open_recording
    from terrafusion.fusion.live import live_estimator, run

    recording = open_recording(log)
    newest: list[State] = []

    def publish(state: State) -> None:
        newest[:] = [state]

    with errors_of(log):
        taken = run(live_estimator(recording, vehicle), recording.messages(), publish, realtime)
        for line in taken.lines():
            print(line)
        if not newest:
            raise DataError("the estimator never started", remedy="see `terrafusion inspect`")
    state = newest[0]
    print(f"{state.status}: {state.position_m.round(2).tolist()} m, slip {state.slip:.2f}")
